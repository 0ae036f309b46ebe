"""Scripts that make the small assets shipped in `datasets/`: bodies and robots. Run by hand, results are committed."""
