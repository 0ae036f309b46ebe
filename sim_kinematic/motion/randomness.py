"""Counter-based random numbers: the same (seed, stream, step) gives the same sample on every machine, in any order."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, stream: str, *, world: int = 0, step: int = 0) -> np.random.Generator:
    """Return a new Philox generator for one purpose (``stream``) in one world at one step.

    No state is carried from step to step, so an episode can be continued from any row of its recording.
    """
    # not `hash`, which differs from process to process
    digest = hashlib.blake2b(f"{stream}/{world}".encode(), digest_size=8).digest()
    # the step is the counter and not part of the key: streams of one seed never overlap, whatever their length
    key = np.array([seed % 2**64, int.from_bytes(digest, "little")], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=np.array([0, 0, step, 0], np.uint64)))


def episode_seed(seed: int, index: int) -> int:
    """Return the seed of episode ``index`` of a dataset with ``seed``: 63 bits, in practice never the same twice."""
    return int(generator(seed, "episode", step=index).integers(2**63))
