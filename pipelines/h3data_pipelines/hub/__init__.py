"""Sharing of datasets on the Hugging Face Hub, with cards that describe them."""
