"""Skills nav, pick and place in W worlds on a device."""
