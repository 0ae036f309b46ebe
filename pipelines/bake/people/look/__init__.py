"""Skin, clothes and hair of people, as patches over a base mesh that is fitted to every body.

`measures` (landmarks and coordinates on a rig) > `base` (skin, lasts, cages) > `drafts` (patches under construction) >
`skin`, `cloth`, `garments`, `hair`, `shoes` > `wardrobe` (all of it as arrays).
"""
