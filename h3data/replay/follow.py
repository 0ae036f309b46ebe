"""A camera that moves with one agent, for recordings of people or robots without a home."""

from __future__ import annotations

import numpy as np

from h3data.geometry import quat_from_heading, quat_rotate
from h3data.render import look_at, pinhole
from h3data.replay.records import CameraTrack, forward_fill
from h3data.replay.replay import Replay

EYE_M = (2.2, 0.5, 2.6)
"""Offset of the eye from the target: ahead of the agent, up, to its right."""
TARGET_HEIGHT_M = 0.85
SMOOTH_S = 1.0


def follow_camera(replay: Replay, agent: int = 0, *, width: int = 960, height: int = 540) -> CameraTrack:
    """A camera ahead and to the right of an agent, relative to its overall displacement; moves smoothly, never turns."""
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
