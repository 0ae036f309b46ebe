"""Learned skills of robots: their observations, their execution, and their names."""
