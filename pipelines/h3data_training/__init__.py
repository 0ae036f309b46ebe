"""Training of recurrent policies from pictures: batched worlds, networks, PPO, checkpoints (docs/training.md)."""
