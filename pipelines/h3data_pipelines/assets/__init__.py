"""Commands about scenes, bodies, robots and motion."""
