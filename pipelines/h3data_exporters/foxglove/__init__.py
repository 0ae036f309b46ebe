"""Recordings as MCAP files of Foxglove messages."""
