"""Doors and drawers in a world: where they stand, what bars them, and how agents open them."""
