"""Training of a robot's skills nav, pick and place."""
