"""Oracle skills as in Habitat, which a device can reproduce step for step (`sim_kinematic.motion.spec.OracleSpec`)."""
