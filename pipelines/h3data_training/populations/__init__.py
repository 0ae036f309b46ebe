"""Training of rearrangement with populations of partners (h3data docs populations)."""
