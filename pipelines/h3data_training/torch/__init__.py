"""Social navigation by tensors, on a CPU or a GPU."""
