"""Policies that decide for agents: scripts, planners, recorded tracks and networks."""
