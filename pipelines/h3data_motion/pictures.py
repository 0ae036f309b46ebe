"""Contact sheets of motions: poses of one person side by side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.clips import Clip
from h3data.bodies.people.humanoid import Humanoid
from h3data.render.sheets.people_sheet import STRIDE_SPACING_M, lined_up
from h3data_motion.clip import Motion
from h3data_motion.retarget import retarget


def motion_picture(
    motion: Motion, body: Humanoid, *, frames: int = 8, lod: bool = False, width: int = 1600
) -> NDArray[np.uint8]:
    """``frames`` poses of a motion, evenly spaced from first to last, seen from the right, RGB [H, W, 3].

    The displacement along the floor is removed.
    """
    fitted = retarget(motion, body)
    quats, pelvis = fitted.pose(np.linspace(0, fitted.duration_s, frames))
    return _strip(body, quats, pelvis * (0, 1, 0), lod, width)


def clip_picture(
    clip: Clip, body: Humanoid, *, frames: int = 8, lod: bool = False, width: int = 1600
) -> NDArray[np.uint8]:
    """``frames`` evenly spaced phases of a clip, seen from the right, RGB [H, W, 3]."""
    rows = np.arange(frames) * len(clip) // frames
    return _strip(body, clip.quats[rows], clip.pelvis[rows], lod, width)


def _strip(body: Humanoid, quats: NDArray, pelvis: NDArray, lod: bool, width: int) -> NDArray[np.uint8]:
    poses = [(body, quats[k : k + 1], pelvis[k : k + 1]) for k in range(len(quats))]
    return lined_up(poses, 0.0, lod, len(poses), width, spacing=STRIDE_SPACING_M)
