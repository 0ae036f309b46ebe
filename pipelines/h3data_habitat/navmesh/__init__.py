"""Navigation meshes, with files and queries as in habitat-sim."""
