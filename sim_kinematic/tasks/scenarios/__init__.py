"""Scenarios: the situations in which social navigation is evaluated, as cards that episodes are sampled from."""
