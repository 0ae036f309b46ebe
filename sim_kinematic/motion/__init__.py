"""State, constants, step kernels and random numbers, independent of agents and tasks."""
