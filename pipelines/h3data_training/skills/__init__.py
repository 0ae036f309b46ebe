"""Training of the skills of a robot: nav, pick and place."""
