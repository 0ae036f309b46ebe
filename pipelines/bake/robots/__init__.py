"""The built-in robots: ``python -m bake.robots`` writes `datasets/robots/`.

There is one design per module, built from `links` and `solids`.
"""
