"""Reading of habitat-sim's gfx-replay files."""
