"""Sharing of datasets: cards that describe them, and the Hugging Face Hub."""
