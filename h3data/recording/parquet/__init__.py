"""The dataset: Parquet in LeRobot v3 layout."""
