"""Training of a robot that drives to a goal among people."""
