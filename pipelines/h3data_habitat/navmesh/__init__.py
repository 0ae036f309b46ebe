"""Navigation meshes as habitat-sim stores and walks them."""
