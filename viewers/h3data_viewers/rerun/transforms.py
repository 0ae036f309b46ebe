"""Moving frames in a Rerun file: 4x4 matrices as Rerun transforms, logged only where they change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import quat_from_matrix, quat_sign_continuous
from h3data_viewers.rerun.sink import Sink

BLOCK_STEPS = 4096
"""Number of steps whose poses are computed and logged together; it limits the memory for a long recording."""


def decompose(
    matrices: NDArray[np.floating],
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Decompose 4x4 matrices [T, 4, 4] into positions [T, 3], quaternions [T, 4] and scales [T, 3].

    A mirroring matrix gets a negative x scale.
    """
    linear = matrices[:, :3, :3]
    scale = np.linalg.norm(linear, axis=1)
    # a quaternion cannot mirror
    scale[np.linalg.det(linear) < 0, 0] *= -1
    rotation = linear / np.where(scale == 0, 1, scale)[:, None, :]
    return matrices[:, :3, 3], quat_from_matrix(rotation), scale


def step_blocks(steps: int) -> list[NDArray[np.intp]]:
    """Split ``steps`` into consecutive blocks of at most `BLOCK_STEPS`, as index arrays."""
    return [np.arange(start, min(start + BLOCK_STEPS, steps)) for start in range(0, steps, BLOCK_STEPS)]


class LoggedTrack:
    """Pose track of one entity, logged block by block and only at steps where the pose changes."""

    def __init__(self, sink: Sink, entity: str) -> None:
        self.entity = entity
        self.scale: NDArray[np.floating] = np.ones(3)
        """Scale of the first pose, [3]. Logged transforms omit it; the entity's mesh carries it instead."""
        self._sink = sink
        self._last = np.eye(4)
        self._last_quat = np.array([[0.0, 0, 0, 1]])
        self._last_rounded = np.full((1, 8), np.nan)
        self._has_scale = self._logs_visibility = False

    def log(self, steps: NDArray[np.integer], matrices: NDArray[np.floating]) -> None:
        """Log poses [n, 4, 4] at the next ``steps`` [n], n >= 1; NaN while the entity is not in the world."""
        import rerun as rr

        present = np.asarray(np.isfinite(matrices).reshape(len(matrices), 16).all(axis=1))
        # where the entity is absent, its last pose goes on, so that it does not fly back from the origin
        last_present = np.maximum.accumulate(np.where(present, np.arange(1, len(present) + 1), 0))
        position, quat, scale = decompose(np.concatenate([self._last[None], matrices])[last_present])
        quat = quat_sign_continuous(np.concatenate([self._last_quat, quat]))[1:]
        if present.any():
            if not self._has_scale:
                self._has_scale, self.scale = True, scale[np.argmax(present)]
            self._last, self._last_quat = matrices[np.flatnonzero(present)[-1]], quat[-1:]
        # Compared on a grid of 20 µm: rounding noise of an object at rest adds no rows, while slow motion crosses a
        # border of the grid sooner or later and is logged then, so the error stays below one cell.
        rounded = np.concatenate([np.round(np.concatenate([position, quat], 1) / 2e-5), present[:, None]], axis=1)
        changed = np.flatnonzero(np.any(np.diff(np.concatenate([self._last_rounded, rounded]), axis=0) != 0, axis=1))
        self._last_rounded = rounded[-1:]
        if not len(changed):
            return
        # Visibility is logged from the first block in which the entity vanishes: most entities never do.
        self._logs_visibility |= not present.all()
        # an entity that is not in the world is a millionth of its size: Rerun reports scales of 0 and NaN as errors
        visible = np.where(present[changed, None], 1.0, 1e-6) * np.ones(3) if self._logs_visibility else None
        columns = rr.Transform3D.columns(translation=position[changed], quaternion=quat[changed], scale=visible)
        self._sink.columns(self.entity, steps[changed], columns)
