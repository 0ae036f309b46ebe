"""The paper's own benchmark protocol."""
