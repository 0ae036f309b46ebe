"""Jobs over many episodes."""
