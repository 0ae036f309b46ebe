"""People driven from outside, step by step."""
