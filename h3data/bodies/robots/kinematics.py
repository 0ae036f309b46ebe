"""Forward kinematics of a tree of links: a compiled loop over time and links, and the same computation in torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

if TYPE_CHECKING:
    from torch import Tensor


FIXED, TURNS, SLIDES, BALL = 0, 1, 2, 3
"""Types of motion of a link in its joint frame."""


class JointTree(NamedTuple):
    """Links and their joints as arrays, parents first, which are the arguments of `link_frames` and described there."""

    parents: NDArray[np.int64]
    origins: NDArray[np.float64]
    kinds: NDArray[np.int64]
    axes: NDArray[np.float64]
    columns: NDArray[np.int64]
    gains: NDArray[np.float64]
    offsets: NDArray[np.float64]


@kernel(error_model="numpy")
def link_frames(
    root: NDArray[np.float64],
    positions: NDArray[np.float64],
    parents: NDArray[np.int64],
    origins: NDArray[np.float64],
    kinds: NDArray[np.int64],
    axes: NDArray[np.float64],
    columns: NDArray[np.int64],
    gains: NDArray[np.float64],
    offsets: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill ``out`` [T, L, 4, 4] with link frames in the frame of ``root`` [T, 4, 4].

    Links come parents first. Link l is attached to ``parents[l]`` (-1: the root) at ``origins[l]`` [4, 4]. By
    ``kinds[l]`` it then turns about ``axes[l]`` by gains[l] * positions[t, columns[l]] + offsets[l], or slides along it
    by as much, or takes the orientation of the quaternion (xyzw, of any length but 0) in the four columns from there.
    """
    turn = np.empty((3, 3))
    frame = np.empty((3, 4))
    for t in range(root.shape[0]):
        for link in range(parents.shape[0]):
            base = root[t] if parents[link] < 0 else out[t, parents[link]]
            origin, here = origins[link], out[t, link]
            straight = origin[0, 0] == 1 and origin[1, 1] == 1 and origin[2, 2] == 1  # most joint frames are not turned
            for i in range(3):
                a, b, c = base[i, 0], base[i, 1], base[i, 2]
                frame[i, 3] = base[i, 3] + a * origin[0, 3] + b * origin[1, 3] + c * origin[2, 3]
                if straight:
                    frame[i, 0], frame[i, 1], frame[i, 2] = a, b, c
                    continue
                for j in range(3):
                    frame[i, j] = a * origin[0, j] + b * origin[1, j] + c * origin[2, j]
            kind, column = kinds[link], columns[link]
            if kind == TURNS:
                x, y, z = axes[link, 0], axes[link, 1], axes[link, 2]
                angle = gains[link] * positions[t, column] + offsets[link]
                s, c = np.sin(angle), np.cos(angle)
                d = 1 - c
                turn[0, 0], turn[0, 1], turn[0, 2] = c + x * x * d, x * y * d - z * s, x * z * d + y * s
                turn[1, 0], turn[1, 1], turn[1, 2] = y * x * d + z * s, c + y * y * d, y * z * d - x * s
                turn[2, 0], turn[2, 1], turn[2, 2] = z * x * d - y * s, z * y * d + x * s, c + z * z * d
            elif kind == BALL:
                x, y, z, w = positions[t, column : column + 4]
                # divided by the square of its length, so the quaternion need not be of unit length
                d = 2 / (x * x + y * y + z * z + w * w)
                turn[0, 0], turn[0, 1], turn[0, 2] = 1 - d * (y * y + z * z), d * (x * y - z * w), d * (x * z + y * w)
                turn[1, 0], turn[1, 1], turn[1, 2] = d * (x * y + z * w), 1 - d * (x * x + z * z), d * (y * z - x * w)
                turn[2, 0], turn[2, 1], turn[2, 2] = d * (x * z - y * w), d * (y * z + x * w), 1 - d * (x * x + y * y)
            elif kind == SLIDES:
                way = gains[link] * positions[t, column] + offsets[link]
                x, y, z = way * axes[link, 0], way * axes[link, 1], way * axes[link, 2]
                for i in range(3):
                    frame[i, 3] += frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z
            if kind in (TURNS, BALL):
                for i in range(3):
                    a, b, c = frame[i, 0], frame[i, 1], frame[i, 2]
                    here[i, 0] = a * turn[0, 0] + b * turn[1, 0] + c * turn[2, 0]
                    here[i, 1] = a * turn[0, 1] + b * turn[1, 1] + c * turn[2, 1]
                    here[i, 2] = a * turn[0, 2] + b * turn[1, 2] + c * turn[2, 2]
                    here[i, 3] = frame[i, 3]
            else:
                for i in range(3):
                    for j in range(4):
                        here[i, j] = frame[i, j]
            here[3, 0], here[3, 1], here[3, 2], here[3, 3] = 0.0, 0.0, 0.0, 1.0


def link_frames_torch(tree: JointTree, root: Tensor, positions: Tensor) -> Tensor:
    """Return the link frames [*batch, L, 4, 4] as torch tensors, differentiable in both arguments.

    They have the device and precision of ``positions``.

    Args:
        tree: links and joints.
        root: frames of the base link as 4x4 matrices, shape [*batch, 4, 4] [m].
        positions: joint positions, shape [*batch, J] [rad or m].
    """
    import torch

    def constant(array: NDArray) -> Tensor:
        return torch.as_tensor(array, dtype=positions.dtype, device=positions.device)

    origins, axes, identity = constant(tree.origins), constant(tree.axes), constant(np.eye(3))
    start = root.to(positions)
    # a list, because autograd does not allow one tensor to be written piece by piece
    frames: list[Tensor] = []
    for link, kind in enumerate(tree.kinds.tolist()):
        parent = int(tree.parents[link])
        frame = (start if parent < 0 else frames[parent]) @ origins[link]
        column, turn = int(tree.columns[link]), None
        if kind == BALL:
            quat = torch.nn.functional.normalize(positions[..., column : column + 4], dim=-1)
            cross = _cross_matrix(quat[..., :3])
            # R = 1 + 2 w C + 2 C C, with the cross product matrix C of the vector part
            turn = identity + 2 * quat[..., 3, None, None] * cross + 2 * cross @ cross
        elif kind != FIXED:
            way = positions[..., column] * float(tree.gains[link]) + float(tree.offsets[link])
            if kind == SLIDES:
                step = torch.einsum("...ij,j->...i", frame[..., :3, :3], axes[link]) * way[..., None]
                frame = torch.cat(
                    [frame[..., :3], (frame[..., 3] + torch.nn.functional.pad(step, (0, 1)))[..., None]], -1
                )
            else:
                cross = _cross_matrix(axes[link])
                turn = identity + torch.sin(way)[..., None, None] * cross
                turn = turn + (1 - torch.cos(way))[..., None, None] * (cross @ cross)
        if turn is not None:
            frame = torch.cat([frame[..., :3] @ turn, frame[..., 3:]], -1)
        frames.append(frame)
    # links above all joints have the batch of the root alone
    return torch.stack(torch.broadcast_tensors(*frames), dim=-3)


def _cross_matrix(vector: Tensor) -> Tensor:
    """Return the matrices [..., 3, 3] that multiply as the cross product with ``vector`` [..., 3] does."""
    import torch

    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(rows, -2)
