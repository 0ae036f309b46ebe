"""Machine code of h3data's kernels, in one folder for each Python, numba, system and level of processor.

`h3data.kernels.shipped` finds and loads it. `make kernels` makes it, by running what is in `build.py`.
"""
