"""Learned skills of robots: what they are shown, how they are played, what their names mean."""
