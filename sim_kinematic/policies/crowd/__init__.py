"""Policies of the people of crowds, who move together."""
