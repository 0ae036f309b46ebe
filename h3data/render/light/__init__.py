"""Baked light: static surfaces carry the light of windows, sun and lamps in their vertex colours (`bake.lit_scene`)."""
