"""Habitat's own formats: scene datasets with their stages, objects and lights, and episode files."""
