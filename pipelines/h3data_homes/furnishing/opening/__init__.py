"""Furniture with doors and drawers that open: its records, placement and models."""
