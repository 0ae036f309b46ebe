"""Parts of one pose, for people who are posed step by step: with NumPy's calls on a few numbers they took five times as long."""

from __future__ import annotations

from h3data.bodies.people.kernels.clips import write_frame
from h3data.bodies.people.kernels.tuple_math import nlerp, put, row4
from h3data.kernels import kernel


@kernel(error_model="numpy")
def blend_pose(a, b, share, out):
    """Writes the blend of rotations [J, 4] as `h3data.geometry.quat_nlerp`, by one share, to ``out`` [J, 4]."""
    for j in range(len(a)):
        put(out, j, nlerp(row4(a, j), row4(b, j), share))


@kernel(error_model="numpy")
def frame_of_joint(base, quats, pelvis, offsets, chain, frame):
    """Writes the world frame [4, 4] of the last joint of a ``chain`` [n] that leads to it from below the pelvis.

    ``base`` [7] is the agent root, and ``quats`` [55, 4] and ``pelvis`` [3] are the pose, as of `joint_frames`.
    """
    for i in range(4):
        for j in range(4):
            frame[i, j] = 1.0 if i == j else 0.0
    # in place: a row of a frame follows from the same row of its parent's
    write_frame(frame, (base[3], base[4], base[5], base[6]), base[0], base[1], base[2], frame)
    write_frame(frame, row4(quats, 0), pelvis[0], pelvis[1], pelvis[2], frame)
    for j in chain:
        write_frame(frame, row4(quats, j), offsets[j, 0], offsets[j, 1], offsets[j, 2], frame)
