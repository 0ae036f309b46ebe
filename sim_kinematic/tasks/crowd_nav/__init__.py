"""PointGoal among people."""
