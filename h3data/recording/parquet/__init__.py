"""Datasets of episodes: Parquet files in the layout of LeRobot v3."""
