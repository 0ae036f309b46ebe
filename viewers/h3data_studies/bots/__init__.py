"""Scripted players, which need no simulator."""
