"""Compiled kernels for parts of one pose, up to five times as fast as NumPy for people who are posed step by step."""

from __future__ import annotations

import math

from h3data.bodies.people.kernels.clips import write_frame
from h3data.bodies.people.kernels.tuple_math import multiply, nlerp, normalized, put, row4, turned
from h3data.kernels import kernel, kernel_part


@kernel(error_model="numpy")
def blend_pose(a, b, share, out):
    """Write the blend of rotations [J, 4] by one share to ``out`` [J, 4], computed as `h3data.geometry.quat_nlerp` does."""
    for j in range(len(a)):
        put(out, j, nlerp(row4(a, j), row4(b, j), share))


@kernel(error_model="numpy")
def frame_of_joint(base, quats, pelvis, offsets, chain, frame):
    """Write the world frame [4, 4] of the last joint of a ``chain`` [n] that leads to it from below the pelvis.

    ``base`` [7] is the agent root, and ``quats`` [55, 4] and ``pelvis`` [3] are the pose, as in `joint_frames`.
    """
    for i in range(4):
        for j in range(4):
            frame[i, j] = 1.0 if i == j else 0.0
    # in place: a row of a frame follows from the same row of its parent's
    write_frame(frame, (base[3], base[4], base[5], base[6]), base[0], base[1], base[2], frame)
    write_frame(frame, row4(quats, 0), pelvis[0], pelvis[1], pelvis[2], frame)
    for j in chain:
        write_frame(frame, row4(quats, j), offsets[j, 0], offsets[j, 1], offsets[j, 2], frame)


@kernel(error_model="numpy")
def hold(frame, place, grip, heading, stood, tilt, out):
    """Write the pose7 of a held object to ``out`` [7].

    The object moves rigidly with a palm, except that its rotation is blended.

    Args:
        frame: frame of the wrist [4, 4].
        place: position of the palm in the frame of the wrist [3] [m].
        grip: pose7 of the object in the palm's frame [7].
        heading: heading of the person [rad].
        stood: rotation [4] of the object relative to the heading while it stays upright.
        tilt: share of the palm's own rotation, 0 to 1.
        out: the result [7].
    """
    turn = _rotation(frame)
    x, y, z = turned(turn, (grip[0], grip[1], grip[2]))
    out[0], out[1], out[2] = place[0] + x, place[1] + y, place[2] + z
    own = multiply(turn, (grip[3], grip[4], grip[5], grip[6]))
    facing = (0.0, math.sin(heading / 2), 0.0, math.cos(heading / 2))
    out[3], out[4], out[5], out[6] = nlerp(multiply(facing, row4(stood.reshape(1, 4), 0)), own, tilt)


@kernel_part()
def _rotation(m):
    """Return the rotation [4] of a frame [4, 4], as `h3data.geometry.quat_from_matrix`."""
    xx, yy = 1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2]
    zz, ww = 1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + m[0, 0] + m[1, 1] + m[2, 2]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    xw, yw, zw = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    most = max(xx, yy, zz, ww)
    if xx == most:
        q = (xx, xy, xz, xw)
    elif yy == most:
        q = (xy, yy, yz, yw)
    elif zz == most:
        q = (xz, yz, zz, zw)
    else:
        q = (xw, yw, zw, ww)
    x, y, z, w = normalized(q)
    return (-x, -y, -z, -w) if w < 0 else (x, y, z, w)
