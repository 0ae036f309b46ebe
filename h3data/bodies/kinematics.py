"""Forward kinematics of a tree of links: one compiled loop over time and links."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

FIXED, TURNS, SLIDES = 0, 1, 2
"""How a link moves in its joint frame."""


@kernel()
def link_frames(
    root: NDArray[np.float64],
    positions: NDArray[np.float64],
    parents: NDArray[np.int64],
    origins: NDArray[np.float64],
    kinds: NDArray[np.int64],
    axes: NDArray[np.float64],
    joints: NDArray[np.int64],
    out: NDArray[np.float64],
) -> None:
    """Fill ``out`` [T, L, 4, 4] with link frames in the frame of ``root`` [T, 4, 4].

    Links come parents first. Link l hangs on ``parents[l]`` (-1: the root) by ``origins[l]`` [4, 4]; it then turns by
    positions[t, joints[l]] about ``axes[l]``, or slides along it, by ``kinds[l]``.
    """
    local = np.empty((4, 4))
    for t in range(root.shape[0]):
        for link in range(parents.shape[0]):
            base = root[t] if parents[link] < 0 else out[t, parents[link]]
            for i in range(4):
                for j in range(4):
                    local[i, j] = origins[link, i, j]
            x, y, z = axes[link, 0], axes[link, 1], axes[link, 2]
            if kinds[link] == TURNS:
                angle = positions[t, joints[link]]
                s, c = np.sin(angle), np.cos(angle)
                d = 1 - c
                r00, r01, r02 = c + x * x * d, x * y * d - z * s, x * z * d + y * s
                r10, r11, r12 = y * x * d + z * s, c + y * y * d, y * z * d - x * s
                r20, r21, r22 = z * x * d - y * s, z * y * d + x * s, c + z * z * d
                for i in range(3):
                    a, b, e = origins[link, i, 0], origins[link, i, 1], origins[link, i, 2]
                    local[i, 0] = a * r00 + b * r10 + e * r20
                    local[i, 1] = a * r01 + b * r11 + e * r21
                    local[i, 2] = a * r02 + b * r12 + e * r22
            elif kinds[link] == SLIDES:
                way = positions[t, joints[link]]
                for i in range(3):
                    along = origins[link, i, 0] * x + origins[link, i, 1] * y + origins[link, i, 2] * z
                    local[i, 3] += way * along
            for i in range(4):
                for j in range(4):
                    total = 0.0
                    for k in range(4):
                        total += base[i, k] * local[k, j]
                    out[t, link, i, j] = total
