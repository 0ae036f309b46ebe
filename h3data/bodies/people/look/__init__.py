"""Looks of people: skin, clothes and hair as meshes over the body.

`patches` are these meshes, over the base that every body shapes in its own form; `wardrobe` lists them; `colors` has
colours of skin, hair and cloth; `dressing` dresses a body.
"""
