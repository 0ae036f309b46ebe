"""Kernels of skinning: half joints, one frame of a mesh, and the spheres that bound it."""

from __future__ import annotations

import math

import numpy as np

from h3data.kernels import kernel, kernel_part


@kernel(boundscheck=False)
def pose_centers(frames, joints, centers, out):
    """Fill ``out`` [N, K, 3] with points ``centers`` [K, 3] [m], each moved by one of the matrices ``frames`` [N, J, 4, 4]."""
    for n in range(len(frames)):
        for k in range(len(joints)):
            frame = frames[n, joints[k]]
            x, y, z = centers[k, 0], centers[k, 1], centers[k, 2]
            for i in range(3):
                out[n, k, i] = frame[i, 3] + frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z


@kernel_part(borrows=True, boundscheck=False, error_model="numpy")
def _write_half(parent, joint, rest, half):
    """Write the upper rows of the frame ``half`` of a half joint.

    ``parent`` and ``joint`` are frames, and ``rest`` is the rotation of the joint in its parent in the rest mesh.
    """
    # A, the rotation that the joint has while it is not bent
    for i in range(3):
        for j in range(3):
            half[i, j] = parent[i, 0] * rest[0, j] + parent[i, 1] * rest[1, j] + parent[i, 2] * rest[2, j]
    # of D = B A^T, with B the rotation of the joint: the trace, and the axis times twice the sine
    trace = x = y = z = 0.0
    for j in range(3):
        u, v, s = half[0, j], half[1, j], half[2, j]
        trace, x, y, z = (
            trace + joint[0, j] * u + joint[1, j] * v + joint[2, j] * s,
            x + joint[2, j] * v - joint[1, j] * s,
            y + joint[0, j] * s - joint[2, j] * u,
            z + joint[1, j] * u - joint[0, j] * v,
        )
    # D has the unit quaternion (x, w), so D = I + 2 w X + 2 X^2 with the cross product X, and half its angle is
    # I + X + X^2 / (1 + w). At 180 degrees x is 0, as no axis is known: the half joint is not bent
    w = math.sqrt(max(1.0 + trace, 1e-12)) / 2
    x, y, z, share = x / (2 * w), y / (2 * w), z / (2 * w), 0.5 / (1 + w)
    for j in range(3):
        u, v, s = half[0, j], half[1, j], half[2, j]
        half[0, j], half[1, j], half[2, j], half[j, 3] = (
            ((1 + 2 * w) * u + y * s - z * v + joint[0, j]) * share,
            ((1 + 2 * w) * v + z * u - x * s + joint[1, j]) * share,
            ((1 + 2 * w) * s + x * v - y * u + joint[2, j]) * share,
            joint[j, 3],
        )


@kernel_part(borrows=True, boundscheck=False)
def _multiply(a, b, out):
    for i in range(4):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j] + a[i, 3] * b[3, j]


@kernel(boundscheck=False, error_model="numpy")
def skin_palette(frames, joints, parents, rest, inverse_bind, out):
    """Fill the matrices from the rest mesh to the world of joints and half joints.

    Args:
        frames: frames of the joints [N, J, 4, 4].
        joints: joint of each half joint [H].
        parents: parents of these joints [H].
        rest: rotations of these joints in their parents in the rest mesh [H, 3, 3].
        inverse_bind: matrices from the rest mesh to joints and half joints [J + H, 4, 4].
        out: the matrices [N, J + H, 4, 4].
    """
    half, count = np.eye(4), frames.shape[1]
    for n in range(len(frames)):
        for k in range(count):
            _multiply(frames[n, k], inverse_bind[k], out[n, k])
        for k in range(len(joints)):
            _write_half(frames[n, parents[k]], frames[n, joints[k]], rest[k], half)
            _multiply(half, inverse_bind[count + k], out[n, count + k])


@kernel(boundscheck=False)
def frame_product(operator, palette, out):
    """Fill ``out`` [V, 3] with the product of a `FrameOperator` and ``palette`` [4J, 3].

    The sums are in SciPy's order, so that the result is the same bit for bit.
    """
    count = len(operator.rows)
    x, y, z = np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    at = 0
    for group in range(len(operator.row_starts) - 1):
        begin, end = operator.row_starts[group], operator.row_starts[group + 1]
        own_x, own_y, own_z, size = x[begin:end], y[begin:end], z[begin:end], end - begin
        for k in range(operator.column_starts[group], operator.column_starts[group + 1]):
            a, b, c = palette[operator.columns[k], 0], palette[operator.columns[k], 1], palette[operator.columns[k], 2]
            # along vertices that take the same three numbers, which the compiler turns into vector instructions
            values = operator.values[at : at + size]
            for i in range(size):
                own_x[i] += values[i] * a
                own_y[i] += values[i] * b
                own_z[i] += values[i] * c
            at += size
    # groups are sorted by their columns; only here the vertices get back to their own order
    for i in range(count):
        row = operator.rows[i]
        out[row, 0], out[row, 1], out[row, 2] = x[i], y[i], z[i]
