"""Robots and people under control: the roster of agents, and how they move, reach, pick and place."""
