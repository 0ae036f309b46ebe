"""Executors of jobs (local processes or a Ray cluster), which take shards and return results in the same order."""
