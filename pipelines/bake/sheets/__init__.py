"""Scripts that make pictures of the documentation."""
