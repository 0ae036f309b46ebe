"""What is to be done: rules, episodes, rewards, recordings, and simulating them again."""
