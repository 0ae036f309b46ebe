"""World poses of a robot's links, computed in blocks of steps: those of a long recording would not fit into memory."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.bodies.robots.trot import legs_are_posed, trot

BLOCK_STEPS = 256
BLOCKS_KEPT = 16


class LinkPoses:
    """World matrices of one robot's links along a recording. Thread-safe."""

    def __init__(
        self, robot: Robot, base_pose: NDArray[np.floating], joint_pos: NDArray[np.floating], *, stepping: bool
    ) -> None:
        """Takes ``base_pose`` [T, 7] and ``joint_pos`` [T, J]; ``stepping`` makes legs trot that were recorded at rest."""
        self.robot, self._base = robot, base_pose
        trots = stepping and legs_are_posed(robot, joint_pos)
        self._joints = trot(robot, base_pose, joint_pos) if trots else joint_pos
        self._block = lru_cache(maxsize=BLOCKS_KEPT)(self._pose_block)

    def at(self, steps: NDArray[np.integer] | None, link: int | slice) -> NDArray[np.float32]:
        """Matrices at ``steps`` (default all) of one link, [T, 4, 4], or of a slice of links, [T, L, 4, 4]."""
        rows = np.arange(len(self._base)) if steps is None else np.arange(len(self._base))[steps]
        blocks = rows // BLOCK_STEPS
        numbers = np.unique(blocks)
        if len(numbers) == 1:
            return self._block(int(numbers[0]))[rows % BLOCK_STEPS, link]
        out = np.empty((len(rows), *np.empty(len(self.robot.links))[link].shape, 4, 4), np.float32)
        for number in numbers:
            chosen = blocks == number
            out[chosen] = self._block(int(number))[rows[chosen] % BLOCK_STEPS, link]
        return out

    def _pose_block(self, number: int) -> NDArray[np.float32]:
        rows = slice(number * BLOCK_STEPS, (number + 1) * BLOCK_STEPS)
        return self.robot.link_matrices(self._base[rows], self._joints[rows]).astype(np.float32)
