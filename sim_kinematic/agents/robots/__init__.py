"""A robot with an arm: how its base drives, what its arm reaches, and its skills."""
