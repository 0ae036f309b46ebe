"""Assets of recordings: their names, the meshes that these mean, and placeholders for missing ones."""
