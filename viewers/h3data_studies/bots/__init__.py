"""Scripted players for tests and benchmarks, which need no simulator."""
