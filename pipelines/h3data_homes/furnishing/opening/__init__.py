"""Furniture that opens: its records, its placement, and the pieces."""
