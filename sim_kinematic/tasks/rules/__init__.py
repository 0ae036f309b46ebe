"""Rewards, predicates and the oracle of the built-in tasks."""
