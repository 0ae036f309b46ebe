"""Policies of the people of crowds, who are moved together."""
