"""Social rearrangement with oracle skills in W worlds as tensors, equivalent to `sim_kinematic.agents.oracle`."""
