"""A camera that goes with one agent: for recordings of people or robots who are not in a home."""

from __future__ import annotations

import numpy as np

from h3data.geometry import quat_from_heading, quat_rotate
from h3data.render import look_at, pinhole
from h3data.replay.chase import held
from h3data.replay.records import CameraTrack
from h3data.replay.replay import Replay

EYE_M = (2.2, 0.5, 2.6)
"""Of the camera from what it looks at: ahead of the agent, above, to its right."""
TARGET_HEIGHT_M = 0.85
SMOOTH_S = 1.0


def follow_camera(replay: Replay, agent: int = 0, *, width: int = 960, height: int = 540) -> CameraTrack:
    """A camera ahead of an agent and to its right, seen along its whole way; it moves smoothly and does not turn."""
    place = held(replay.recording.agent_column(agent, "base_pose").astype(np.float64))[:, :3]
    way = place[-1] - place[0]
    reach = max(1, min(round(SMOOTH_S * len(place) / max(replay.recording.duration_s, 1e-3)), len(place) - 1))
    window = np.hanning(2 * reach + 3)[1:-1]
    wide = np.pad(place, ((reach, reach), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(wide[:, k], window / window.sum(), mode="valid") for k in range(3)], axis=1)
    target = smooth + np.array([0.0, TARGET_HEIGHT_M, 0.0])
    eye = target + quat_rotate(quat_from_heading(np.arctan2(-way[2], way[0])), np.array(EYE_M))
    poses = np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)])
    return CameraTrack(camera=pinhole(width, height, hfov_deg=55.0, pose=poses[0], name="follow"), poses=poses)
