"""Light of windows, sun and lamps, baked into the colours of the vertices of static surfaces (`h3data.render.light.bake`)."""
