"""What agents perceive: sensors, pictures, noise."""
