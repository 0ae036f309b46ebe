"""Training environments: Gymnasium, vector, PettingZoo. Needs the extra ``env``."""
