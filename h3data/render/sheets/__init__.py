"""People side by side, and scenes from above and at eye level, for commands, docs and reports."""
