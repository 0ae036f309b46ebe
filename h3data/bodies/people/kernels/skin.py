"""Kernels of skinning: one frame of a mesh, and the spheres that bound it."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel


@kernel(boundscheck=False)
def pose_centers(frames, joints, centers, out):
    """Fill ``out`` [N, K, 3] with points ``centers`` [K, 3] [m], each moved by one of the joint ``frames`` [N, J, 4, 4]."""
    for n in range(len(frames)):
        for k in range(len(joints)):
            frame = frames[n, joints[k]]
            for i in range(3):
                value = frame[i, 3]
                for axis in range(3):
                    value += frame[i, axis] * centers[k, axis]
                out[n, k, i] = value


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
