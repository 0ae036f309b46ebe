"""Training of recurrent policies from pictures, with batched worlds, PPO and checkpoints (h3data docs training)."""
