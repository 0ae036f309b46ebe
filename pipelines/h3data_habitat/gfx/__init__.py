"""gfx-replays of habitat-sim."""
