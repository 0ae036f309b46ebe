"""Furniture that opens: its records and how it is placed, and the pieces."""
