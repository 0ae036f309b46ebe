"""Learned policies with memory of the upper layer of rearrangement."""
