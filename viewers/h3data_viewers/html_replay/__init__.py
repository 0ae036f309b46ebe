"""Recordings as one HTML file that plays them from disk, without a server: see `html_file`."""
