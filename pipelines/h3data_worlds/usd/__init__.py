"""Scenes as USD: `writing` makes stages for Isaac, Blender and Omniverse, and `reading` makes scenes from any stage."""
