"""Light of windows, sun and lamps, baked into the vertex colours of static surfaces, and a light field for moving things.

The group ``h3data.lights`` finds it, so that without this package everything is shown in flat light.
"""
