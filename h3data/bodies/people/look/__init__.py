"""Appearance of people: skin, clothes and hair as meshes over the body.

`patches` defines these meshes, which lie over a base mesh that all bodies share. `wardrobe` lists them, `colors` has
the colours of skin, hair and cloth, and `dressing` dresses a body.
"""
