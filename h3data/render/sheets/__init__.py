"""Pictures of bodies, robots, motions and maps for docs and commands."""
