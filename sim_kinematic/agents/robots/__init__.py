"""A robot with an arm: driving of its base, reaching of its arm, and its skills."""
