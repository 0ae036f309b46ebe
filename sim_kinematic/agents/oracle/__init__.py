"""Oracle skills as in Habitat, which a device can repeat step for step: `sim_kinematic.motion.spec.OracleSpec`."""
