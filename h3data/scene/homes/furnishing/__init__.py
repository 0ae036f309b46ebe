"""Furniture, clutter, and where they stand in a room."""
