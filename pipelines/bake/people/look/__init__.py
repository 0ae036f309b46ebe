"""Skin, clothes and hair of people, as patches over a base that every body has its own shape of.

`measures` (landmarks and coordinates on a rig) > `base` (skin, lasts, cages) > `drafts` (patches in the making) > `skin`,
`cloth`, `garments`, `hair`, `shoes` > `wardrobe` (all of it as arrays).
"""
