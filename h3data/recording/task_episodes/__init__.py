"""Start states, goals and identities of episodes of the built-in tasks, from any kind of file."""
