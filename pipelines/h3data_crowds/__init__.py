"""Tasks of a robot that drives to a goal or meets situations from cards among several people, with baselines."""
