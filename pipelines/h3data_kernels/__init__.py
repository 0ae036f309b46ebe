"""Machine code of h3data's kernels, with one folder for each combination of Python, numba, system and processor level.

`h3data.kernels.shipped` finds and loads the machine code. `make kernels` builds it by running `build.py`.
"""
