"""Learned policies of the upper layer of rearrangement that remember."""
