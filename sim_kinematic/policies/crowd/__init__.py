"""Policies of people in crowds, who move together."""
