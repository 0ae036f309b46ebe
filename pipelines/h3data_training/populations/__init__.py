"""Rearrangement learned beside populations of partners (docs/populations.md)."""
