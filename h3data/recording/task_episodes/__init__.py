"""Start states, goals and identities of episodes of the built-in tasks, whatever file they come from."""
