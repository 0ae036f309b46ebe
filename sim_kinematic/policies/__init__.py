"""Policies, which decide for an agent: scripts, planners, recorded tracks, networks."""
