"""Scenes as USD: `writing` makes stages that Isaac, Blender and Omniverse open, `reading` makes scenes from any stage."""
