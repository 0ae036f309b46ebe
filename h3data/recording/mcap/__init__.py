"""Session logs: MCAP files that stay readable after a crash."""
