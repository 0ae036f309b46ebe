"""Perception of agents: sensors, pictures, noise."""
