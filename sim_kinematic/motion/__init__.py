"""State, constants, step kernels and random numbers: know no agents and no task."""
