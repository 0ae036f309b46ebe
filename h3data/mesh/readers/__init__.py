"""Readers of mesh files that are not glTF: Collada, and OBJ, PLY and STL through trimesh."""
