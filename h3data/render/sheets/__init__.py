"""Overview images for commands, docs and reports: people side by side, and scenes from above and at eye level."""
