"""Tasks: rules, episodes, rewards, recordings, and the simulation of recordings."""
