"""Motions of people from other sources (AMASS, BVH, Habitat): files, retargeting, cycles, walks; ``h3data motion``."""
