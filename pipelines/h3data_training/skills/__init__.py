"""Learning the skills of a robot: nav, pick and place."""
