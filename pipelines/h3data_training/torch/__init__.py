"""Tasks and skills in many worlds as tensors, on a CPU or a GPU."""
