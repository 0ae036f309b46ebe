"""Compiled kernels of motion clips and the joint tree: sampling of clips, folding of arms, and frames of joints."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.kernels.legs import KNEES, LegMeasures, settle, stand_on, write_legs
from h3data.bodies.people.kernels.tuple_math import inverse, multiply, nlerp, normalized, put, row3, row4, turned
from h3data.geometry import Array
from h3data.kernels import kernel, kernel_part


class ClipArrays(NamedTuple):
    """Arrays of a `h3data.bodies.people.clips.ClipTable` for kernels, with the frames of all clips of a body in sequence."""

    legs: LegMeasures
    first: NDArray[np.int64]
    frames: NDArray[np.int64]
    quats: Array
    pelvis: Array
    ankle: Array
    foot: Array
    stand: tuple[Array, Array, Array, Array]
    """Standing pose in the body frame: quats [55, 4], pelvis [3] [m], ankles [2, 3] [m] and angles of the feet [2, 3]
    [deg]."""
    to_root: Array
    """Rotation from the body frame to the agent root frame as a quaternion xyzw, shape [4]."""


@kernel_part()
def _mix(low, high, share):
    return low + share * (high - low)


@kernel(error_model="numpy")
def sample_all(table, motion, phase, blend, ground, quats, pelvis):
    """Sample poses [T] of clips at their phases into ``quats`` [T, 55, 4] and ``pelvis`` [T, 3] [m].

    Where ``blend`` is below 1, a pose is blended towards the standing pose.

    ``ground`` holds heights of the floor under both feet relative to the root, [T, 2] [m], or has shape [0, 2] if the
    floor is flat.
    """
    ankle, foot, angles = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    to_root = (table.to_root[0], table.to_root[1], table.to_root[2], table.to_root[3])
    for t in range(len(quats)):
        clip = motion[t]
        count = table.frames[clip]
        place = (phase[t] - math.floor(phase[t])) * count
        index = math.floor(place)
        share = place - index
        low = table.first[clip] + int(index) % count
        # the last frame is followed by the first one of the same clip
        high = table.first[clip] + (int(index) % count + 1) % count
        # neighbouring frames share a hemisphere, so a plain mix and one normalisation are enough
        for j in range(quats.shape[1]):
            a, b = row4(table.quats[low], j), row4(table.quats[high], j)
            mixed = (_mix(a[0], b[0], share), _mix(a[1], b[1], share), _mix(a[2], b[2], share), _mix(a[3], b[3], share))
            put(quats[t], j, normalized(mixed))
        for i in range(3):
            pelvis[t, i] = _mix(table.pelvis[low, i], table.pelvis[high, i], share)
        # the clip as it is: its legs were solved when it was made
        if blend[t] >= 1 and not len(ground):
            continue
        for k in range(2):
            for i in range(3):
                ankle[k, i] = _mix(table.ankle[low, k, i], table.ankle[high, k, i], share)
                foot[k, i] = _mix(table.foot[low, k, i], table.foot[high, k, i], share)
        # legs are solved in the body frame, and poses are kept in that of the agent root
        put(quats[t], 0, multiply(inverse(to_root), row4(quats[t], 0)))
        pelvis[t, 0], pelvis[t, 1], pelvis[t, 2] = turned(inverse(to_root), row3(pelvis, t))
        settle(table.legs, table.stand, quats[t], pelvis[t], ankle, foot, phase[t], min(max(blend[t], 0.0), 1.0))
        if len(ground):
            stand_on(table.legs, quats[t], pelvis[t], ankle, ground[t])
        write_legs(table.legs, quats[t], pelvis[t], ankle, foot, KNEES, angles)
        put(quats[t], 0, multiply(to_root, row4(quats[t], 0)))
        pelvis[t, 0], pelvis[t, 1], pelvis[t, 2] = turned(to_root, row3(pelvis, t))


@kernel(error_model="numpy")
def tuck_all(quats, shares, joints, tucked):
    """Blend one joint of both arms in poses [T, 55, 4] with its rotations ``tucked`` [2, 4], in place.

    ``shares`` [T, 2] are the weights of the rotations, 0..1. Returns False, and changes nothing, if any of them is not
    finite.
    """
    # all of them before the first change
    for t in range(len(quats)):
        if not (math.isfinite(shares[t, 0]) and math.isfinite(shares[t, 1])):
            return False
    for t in range(len(quats)):
        if shares[t, 0] != 0.0 or shares[t, 1] != 0.0:
            for k in range(2):
                share = min(max(shares[t, k], 0.0), 1.0)
                put(quats[t], joints[k], nlerp(row4(quats[t], joints[k]), row4(tucked, k), share))
    return True


@kernel_part()
def write_frame(parent, q, x, y, z, frame):
    """Write the frame [4, 4] of a joint, from the frame of its parent, its local rotation and its position in that frame."""
    i, j, k, w = q
    # written out: products of small arrays would be allocated and called through BLAS
    a, b, c = 1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)
    d, e, f = 2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)
    g, h, m = 2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)
    for r in range(3):
        u, v, s = parent[r, 0], parent[r, 1], parent[r, 2]
        frame[r, 0], frame[r, 1], frame[r, 2] = u * a + v * d + s * g, u * b + v * e + s * h, u * c + v * f + s * m
        frame[r, 3] = u * x + v * y + s * z + parent[r, 3]
    frame[3, 0] = frame[3, 1] = frame[3, 2] = 0.0
    frame[3, 3] = 1.0


@kernel_part()
def _write_tree(quats, offsets, parents, frames):
    """Fill the frames [55, 4, 4] of all joints below the pelvis, whose frame is given, from ``quats`` [54, 4]."""
    for j in range(1, len(parents)):
        x, y, z = row3(offsets, j)
        write_frame(frames[parents[j]], row4(quats, j - 1), x, y, z, frames[j])


@kernel(error_model="numpy")
def joint_frames(base, quats, pelvis, offsets, parents, frames):
    """Fill ``frames`` [T, 55, 4, 4] with the world frames of all joints.

    ``base`` [T or 1, 7] holds the agent roots, ``quats`` [T, 55, 4] the local rotations, ``pelvis`` [T, 3] the
    positions of the pelvis in the agent root frame [m].
    """
    unit, world = np.eye(4), np.empty((4, 4))
    for t in range(len(quats)):
        root = base[t if len(base) > 1 else 0]
        write_frame(unit, (root[3], root[4], root[5], root[6]), root[0], root[1], root[2], world)
        write_frame(world, row4(quats[t], 0), pelvis[t, 0], pelvis[t, 1], pelvis[t, 2], frames[t, 0])
        _write_tree(quats[t, 1:], offsets, parents, frames[t])


@kernel(error_model="numpy")
def free_joint_frames(root, quats, offsets, parents, frames):
    """Fill ``frames`` [T, 55, 4, 4] with the world frames of all joints in a free-form pose.

    ``root`` are the frames of the pelvis in the world [T, 7], ``quats`` the local rotations of the other joints [T, 54,
    4].
    """
    world = np.eye(4)
    for t in range(len(quats)):
        p = root[t]
        write_frame(world, (p[3], p[4], p[5], p[6]), p[0], p[1], p[2], frames[t, 0])
        _write_tree(quats[t], offsets, parents, frames[t])
