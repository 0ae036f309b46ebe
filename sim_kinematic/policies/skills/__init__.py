"""Learned skills of robots, with their observations, their execution and their names."""
