"""Commands that make, convert and measure recordings."""
