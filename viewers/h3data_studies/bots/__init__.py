"""Scripted players: no simulator is needed for them."""
