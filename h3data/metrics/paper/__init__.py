"""Metrics as the Habitat 3.0 paper defines them."""
