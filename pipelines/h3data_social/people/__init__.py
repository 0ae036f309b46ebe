"""The profile ``social``: what papers and simulators of social navigation report, over every person of an episode."""
