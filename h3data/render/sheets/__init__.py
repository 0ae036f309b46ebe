"""Contact sheets of people, motions and robots, and maps of scenes, for docs and commands."""
