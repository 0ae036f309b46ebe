"""The built-in robots: ``python -m bake.robots`` writes `datasets/robots/`, one design per module, built from `links`
and `solids`."""
