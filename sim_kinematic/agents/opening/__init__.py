"""Doors and drawers in a world: their positions, what blocks them, and how agents open them."""
