"""Profile ``social``: metrics of papers and simulators of social navigation, over all people of an episode."""
