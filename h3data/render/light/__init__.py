"""Light sources of a scene. The group ``h3data.lights`` provides functions that bake their light (`h3data_light`)."""
