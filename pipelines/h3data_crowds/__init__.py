"""Tasks of a robot among several people: to a goal, situations from cards; baselines that drive it there."""
