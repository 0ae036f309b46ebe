"""Training environments for Gymnasium, its vector interface, and PettingZoo; they need the extra ``env``."""
