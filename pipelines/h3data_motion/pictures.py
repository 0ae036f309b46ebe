"""Pictures of motions with the poses of one person side by side, and a camera that follows a moving agent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.clips import Clip
from h3data.bodies.people.humanoid import Humanoid
from h3data.geometry import quat_from_heading, quat_rotate
from h3data.render import look_at, pinhole
from h3data.render.sheets.people_sheet import STRIDE_SPACING_M, lined_up
from h3data.replay.records import CameraTrack, forward_fill
from h3data.replay.replay import Replay
from h3data_motion.clip import Motion
from h3data_motion.retarget import retarget


def motion_picture(
    motion: Motion, body: Humanoid, *, frames: int = 8, lod: bool = False, width: int = 1600
) -> NDArray[np.uint8]:
    """Render ``frames`` poses of a motion, evenly spaced from first to last, seen from the right, RGB [H, W, 3].

    The displacement along the floor is removed.
    """
    fitted = retarget(motion, body)
    quats, pelvis = fitted.pose(np.linspace(0, fitted.duration_s, frames))
    return _strip(body, quats, pelvis * (0, 1, 0), lod, width)


def clip_picture(
    clip: Clip, body: Humanoid, *, frames: int = 8, lod: bool = False, width: int = 1600
) -> NDArray[np.uint8]:
    """Render ``frames`` evenly spaced phases of a clip, seen from the right, RGB [H, W, 3]."""
    rows = np.arange(frames) * len(clip) // frames
    return _strip(body, clip.quats[rows], clip.pelvis[rows], lod, width)


def _strip(body: Humanoid, quats: NDArray, pelvis: NDArray, lod: bool, width: int) -> NDArray[np.uint8]:
    poses = [(body, quats[k : k + 1], pelvis[k : k + 1]) for k in range(len(quats))]
    return lined_up(poses, 0.0, lod, len(poses), width, spacing=STRIDE_SPACING_M)


EYE_M = (2.2, 0.5, 2.6)
"""Offset of the camera from its target: ahead of the agent, up, and to its right [m]."""
TARGET_HEIGHT_M = 0.85
SMOOTH_S = 1.0


def follow_camera(replay: Replay, agent: int = 0, *, width: int = 960, height: int = 540) -> CameraTrack:
    """Return the track of a camera that moves smoothly with an agent and does not turn.

    The camera is ahead of the agent and to its right, relative to the agent's total displacement.
    """
    position = forward_fill(replay.recording.agent_column(agent, "base_pose").astype(np.float64))[:, :3]
    displacement = position[-1] - position[0]
    reach = max(1, min(round(SMOOTH_S * len(position) / max(replay.recording.duration_s, 1e-3)), len(position) - 1))
    window = np.hanning(2 * reach + 3)[1:-1]
    padded = np.pad(position, ((reach, reach), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(padded[:, k], window / window.sum(), mode="valid") for k in range(3)], axis=1)
    target = smooth + np.array([0.0, TARGET_HEIGHT_M, 0.0])
    heading = np.arctan2(-displacement[2], displacement[0])
    eye = target + quat_rotate(quat_from_heading(heading), np.array(EYE_M))
    poses = np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)])
    return CameraTrack(camera=pinhole(width, height, hfov_deg=55.0, pose=poses[0], name="follow"), poses=poses)
