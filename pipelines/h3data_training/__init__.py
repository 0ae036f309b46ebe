"""Training of recurrent policies from pictures: batched worlds, networks, PPO, checkpoints (h3data docs training)."""
