"""Robots and people under control: who takes part, how they move, reach, pick and place."""
