"""Networks of policies that are evaluated by PyTorch."""
