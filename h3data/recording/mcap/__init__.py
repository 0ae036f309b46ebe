"""The session log: MCAP files that survive a crash."""
