"""Tasks: rules, episodes, rewards, recordings, and simulating them again."""
