"""Mutual avoidance of agents: roll-outs, velocities, routes and yielding."""
