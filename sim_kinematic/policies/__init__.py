"""What decides for an agent: scripts, planners, recorded tracks, networks."""
