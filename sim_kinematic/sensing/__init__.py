"""Perception of agents: sensors, pictures and noise."""
