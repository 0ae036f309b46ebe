"""Scene datasets of habitat-sim, with their configurations, templates and instances."""
