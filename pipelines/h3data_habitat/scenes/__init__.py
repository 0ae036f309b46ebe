"""Scene datasets of habitat-sim: configurations, templates, instances."""
