"""Executors of jobs: processes of this machine, or a Ray cluster. They take shards and return results in the same order."""
