"""People who choose their velocities among other people, by social force or reciprocal avoidance, in one home."""
