"""Import of human motion from other sources (AMASS, BVH, Habitat): files, retargeting, cycles and walks.

The commands are ``h3data motion``.
"""
