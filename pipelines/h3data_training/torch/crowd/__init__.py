"""People of crowds on a device: the rules of `sim_kinematic.crowd` as tensor operations."""
