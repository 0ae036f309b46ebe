"""Datasets among people: cards that describe them, and the Hugging Face Hub that holds them."""
