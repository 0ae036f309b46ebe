"""The CPU rasteriser."""
