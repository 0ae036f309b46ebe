"""The Rerun file."""
