"""Training of recurrent policies from pictures, with batched worlds, PPO and checkpoints (h3data docs training)."""

import h3data  # noqa: F401 - from then on, imports of modules that have moved say where they are
