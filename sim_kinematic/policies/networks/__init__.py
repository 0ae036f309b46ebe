"""Networks of policies that PyTorch evaluates."""
