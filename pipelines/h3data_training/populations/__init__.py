"""Rearrangement learned beside populations of partners (h3data docs populations)."""
