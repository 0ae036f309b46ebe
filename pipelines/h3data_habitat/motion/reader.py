"""Conversion of motion of Habitat's humanoids, as an entry point of the group ``h3data.motions``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from h3data.bodies.people.skeleton import JOINT_COUNT, JOINT_INDEX
from h3data.errors import FormatError
from h3data.geometry import normalized, quat_from_matrix
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS, HabitatClip
from h3data_habitat.motion.habitat_motion import motion_parts, read_habitat_motion, read_habitat_sequence
from h3data_habitat.safe_pickle import is_pickle
from h3data_motion.clip import Motion, in_start_frame
from h3data_motion.files import MotionReader, ReadOptions


def _fits(start: bytes, names: Sequence[str]) -> bool:
    return is_pickle(start) or "pose_motion" in names or "walk_motion" in names


def _read(path: Path, options: ReadOptions) -> Motion:
    """Return a Habitat sequence, or the walk of its motion file."""
    if "pose_motion" in motion_parts(path):
        clip = read_habitat_sequence(path)
    else:
        clip = read_habitat_motion(path).walk
    return habitat_clip_motion(
        clip, name=path.stem, source=options.source or f"Habitat motion file {path.name}; licence unknown"
    )


def habitat_clip_motion(clip: HabitatClip, *, name: str, source: str = "") -> Motion:
    """Return a clip of Habitat's humanoids as motion; its root frames have y up and the axes of our body frame.

    Raises:
        FormatError: a root is no rotation.
    """
    rotation = clip.roots[:, :3, :3]
    # within a hundredth, as files hold float32; a determinant below 0 is a mirror image
    if np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation).min() < 0:
        raise FormatError(
            f"transform_array: Expected rotations and places, one is sheared, scaled or mirrored: {name}",
            code="H3-BODY-048",
        )
    quats = np.empty((len(clip.joints), JOINT_COUNT, 4))
    quats[:, 0] = quat_from_matrix(rotation)
    quats[:, [JOINT_INDEX[joint] for joint in HABITAT_JOINTS]] = clip.joints
    return in_start_frame(
        Motion(name=name, fps=clip.fps, quats=normalized(quats), pelvis=clip.roots[:, :3, 3].copy(), source=source)
    )


HABITAT = MotionReader(fits=_fits, read=_read, suffixes=(".pkl", ".npz"))
