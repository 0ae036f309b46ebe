"""The commands that make, convert and measure recordings."""
