"""Navigation meshes: files and queries as in habitat-sim."""
