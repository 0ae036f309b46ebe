"""Bodies: ``python -m bake.people.humanoid`` writes `datasets/bodies/`, ``python -m bake.people.reach`` the reach table.

`anny_shape` > `rig` > `look` (skin, clothes, hair) > `humanoid`; `capsules` and `gait` are fitted to the rig. `designs` lists
the people that ship, `smplx` makes a body from the user's own SMPL-X file.
"""
