"""Light sources of a scene. Their light is baked by what the group ``h3data.lights`` offers (`h3data_light`)."""
