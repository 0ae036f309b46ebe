"""Assets of recordings: their names, the corresponding meshes, and placeholders for missing ones."""
