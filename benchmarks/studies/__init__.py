"""Studies: scripts whose result is a table in docs, and no figure of speed."""
