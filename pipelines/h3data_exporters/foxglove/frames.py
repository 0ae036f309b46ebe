"""Tree of the frames of a recording: their parents, and which of them moved since they were last published."""

from __future__ import annotations

import numpy as np

from h3data.geometry import Array, pose_inverse, pose_multiply, quat_from_axis_angle

ROOT, WORLD = "map", "world"
"""Names of the root frame, which has +Z up as these viewers expect, and of the recording's world below it, with +Y up."""
_WORLD_IN_ROOT = np.concatenate([np.zeros(3), quat_from_axis_angle([1.0, 0, 0], np.pi / 2)])
_MOVED = 1e-6
"""Least difference of a coordinate [m] or quaternion component after which a frame is sent again."""
_WHOLE_NS = 1_000_000_000
"""Interval at which all frames are sent again, so that viewers who jump in time soon see them."""


class FrameTree:
    """Tree of frames by index, each in the world or in an earlier frame."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._parents: list[int] = []
        self._told = np.zeros((0, 7))
        self._whole_ns: int | None = None

    def add(self, name: str, parent: int = -1) -> int:
        """Add a frame and return its index; parent -1 is the world, and a name that is taken gets a number."""
        taken, unique, number = {ROOT, WORLD, *self.names}, name, 1
        while unique in taken:
            number += 1
            unique = f"{name}_{number}"
        self.names.append(unique)
        self._parents.append(parent)
        return len(self.names) - 1

    def local(self, world: Array) -> Array:
        """Return the poses of all frames in their parents, from world poses; both are [T, F, 7], NaN while absent."""
        out, parents = world.copy(), np.array(self._parents, np.intp)
        hung = np.flatnonzero(parents >= 0)
        out[:, hung] = pose_multiply(pose_inverse(world[:, parents[hung]]), world[:, hung])
        return out

    def news(self, time_ns: int, local: Array) -> tuple[list[tuple[str, str, Array]], bool]:
        """Return frames to publish at a step, and whether all of them are published.

        All frames that exist are published at the first call and once a second; otherwise only those that have moved
        since they were last published.

        Args:
            time_ns: time of the step [ns].
            local: poses of all frames in their parents [F, 7].

        Returns:
            ``(parent, child, pose7)`` of each frame to publish, and whether this is a full set.
        """
        there = np.isfinite(local).all(1)
        whole = self._whole_ns is None or time_ns - self._whole_ns >= _WHOLE_NS
        if whole:
            self._whole_ns = time_ns
            self._told = np.full(local.shape, np.nan)
        # written as not at most: a difference with NaN, of a frame that was not told of, counts as moved
        with np.errstate(invalid="ignore"):
            moved = there & ~(np.abs(local - self._told) <= _MOVED).all(1)
        self._told[moved] = local[moved]
        found = [(ROOT, WORLD, _WORLD_IN_ROOT)] if whole else []
        for k in np.flatnonzero(moved).tolist():
            parent = self._parents[k]
            found.append((WORLD if parent < 0 else self.names[parent], self.names[k], local[k]))
        return found, whole
