"""Skills as Habitat's oracle ones, which a device can repeat step for step: `sim_kinematic.motion.spec.OracleSpec`."""
