"""Light of windows, sun and lamps, baked into the colours of the vertices of static surfaces, and a field of it for what moves.

The group ``h3data.lights`` finds it, so that without this package everything is shown in flat light.
"""
