"""Benchmarks, which are named and versioned sets of episodes with rules and metrics, whose results can be verified."""
