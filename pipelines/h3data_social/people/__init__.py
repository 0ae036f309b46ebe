"""Profile ``social``: metrics of papers and simulators of social navigation, over every person of an episode."""
