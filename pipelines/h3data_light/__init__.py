"""Light of windows, sun and lamps: baked into vertex colours for static surfaces, and a light field for moving ones.

The package is an entry point of the group ``h3data.lights``. Without it, pictures have flat light.
"""
