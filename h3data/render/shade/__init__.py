"""Colours from the visibility buffer: light, textures, occlusion."""
