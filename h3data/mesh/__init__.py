"""Triangle meshes, textures, and the files that hold them."""
