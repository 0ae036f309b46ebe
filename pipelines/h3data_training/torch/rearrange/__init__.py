"""Social rearrangement with oracle skills in W worlds as tensors: `sim_kinematic.agents.oracle`, line by line."""
