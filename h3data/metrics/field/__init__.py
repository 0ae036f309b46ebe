"""Metrics that papers on social navigation report."""
