"""World poses of the rigid parts of an agent, computed in blocks of steps.

The poses of a whole long recording would not fit into memory.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

BLOCK_STEPS = 256
"""Number of steps whose poses are computed together."""
BLOCKS_KEPT = 16


class LinkPoses:
    """World matrices of one agent's links along a recording, computed on demand by any thread."""

    def __init__(self, pose: Callable[[NDArray[np.integer]], NDArray[np.floating]], steps: int, links: int) -> None:
        """Compute poses by the function ``pose``, which returns the matrices [t, L, 4, 4] at steps [t]."""
        self._pose, self._steps, self._links = pose, steps, links
        # threads render neighbouring steps, which lie in few blocks
        self._block = lru_cache(maxsize=BLOCKS_KEPT)(self._pose_block)

    def at(self, steps: NDArray[np.integer] | None, link: int | slice) -> NDArray[np.float32]:
        """Return world matrices at ``steps`` (default all) of one link, [T, 4, 4], or of a slice of links, [T, L, 4, 4]."""
        rows = np.arange(self._steps) if steps is None else np.arange(self._steps)[steps]
        blocks = rows // BLOCK_STEPS
        numbers = np.unique(blocks)
        if len(numbers) == 1:
            return self._block(int(numbers[0]))[rows % BLOCK_STEPS, link]
        out = np.empty((len(rows), *np.empty(self._links)[link].shape, 4, 4), np.float32)
        for number in numbers:
            chosen = blocks == number
            out[chosen] = self._block(int(number))[rows[chosen] % BLOCK_STEPS, link]
        return out

    def _pose_block(self, number: int) -> NDArray[np.float32]:
        rows = np.arange(number * BLOCK_STEPS, min((number + 1) * BLOCK_STEPS, self._steps))
        return self._pose(rows).astype(np.float32)
