"""Motion clips as recordings, for `Replay` and the renderer."""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.geometry import IDENTITY_POSE, ground_pose, heading_from_quat, quat_multiply, quat_rotate
from h3data.recording.records import STEP_NS, Agent, AssetRef, Body, Episode, Recording
from h3data_motion.clip import Motion, pelvis_heading
from h3data_motion.retarget import retarget

TILE_M = 1.0
TILE_COLORS = ((222, 224, 228), (198, 202, 208))


def motion_columns(
    motion: Motion, body: Humanoid, *, agent: int = 0, start: ArrayLike = IDENTITY_POSE, step_ns: int = STEP_NS
) -> dict[str, NDArray[Any]]:
    """Return columns of a recording in which ``body`` performs the motion from the world pose ``start`` [7] on.

    The columns are ``time_ns`` and ``agent_<i>.base_pose``, ``.root_pose``, ``.joint_quat``
    (`h3data.recording.records`). A motion of another body is fitted to this one first (`retarget`). Steps are
    ``step_ns`` apart, whatever the motion's rate.
    """
    fitted = retarget(motion, body)
    begin = np.asarray(start, np.float64)
    steps = int(fitted.duration_s * 1e9 / step_ns + 1e-6) + 1
    quats, pelvis = fitted.pose(np.arange(steps) * step_ns * 1e-9)
    root = quat_multiply(begin[3:], quats[:, 0])
    pelvis_m = begin[:3] + quat_rotate(begin[3:], pelvis)
    heading = np.unwrap(pelvis_heading(quats[:, 0]))
    base = ground_pose(pelvis_m[:, ::2], heading + heading_from_quat(begin[3:]), float(begin[1]))
    return {
        "time_ns": np.arange(steps, dtype=np.int64) * step_ns,
        f"agent_{agent}.base_pose": base.astype(np.float32),
        f"agent_{agent}.root_pose": np.concatenate([pelvis_m, root], axis=1).astype(np.float32),
        f"agent_{agent}.joint_quat": quats[:, 1:].astype(np.float32),
    }


def motion_recording(motion: Motion, body: Humanoid, *, model: str = "") -> Recording:
    """Return a recording of one person performing the motion on a tiled floor, for `Replay`, videos and datasets.

    ``model`` is the model of the body in the recording: ``humanoid/<name>`` for a built-in body, or a file (default:
    the body's name).
    """
    columns = motion_columns(motion, body)
    model = model or f"humanoid/{body.name}"
    path_xz = columns["agent_0.base_pose"][:, [0, 2]].astype(np.float64)
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid4()),
            episode_id=motion.name,
            task="motion",
            scene="",
            created_by="h3data",
            info={"motion": motion.name, "source": motion.source, "body": body.name},
        ),
        assets=tuple(
            AssetRef(name=f"tile_{k}", uri="primitive:cubeSolid", color=color) for k, color in enumerate(TILE_COLORS)
        ),
        bodies=_tiles(path_xz),
        agents=(Agent(name="person", kind="human", model=model),),
        columns=columns,
    )


def _tiles(path_xz: NDArray[np.float64], *, margin: int = 3) -> tuple[Body, ...]:
    """Return a floor of squares in two greys below and around a path [T, 2]."""
    cells = np.unique(np.floor(path_xz / TILE_M).astype(int), axis=0)
    around = np.stack(np.meshgrid(*[np.arange(-margin, margin + 1)] * 2), axis=-1).reshape(-1, 2)
    cells = np.unique((cells[:, None] + around).reshape(-1, 2), axis=0)
    return tuple(
        Body(
            name=f"floor_{i}_{j}",
            asset=f"tile_{(i + j) % 2}",
            layer="floor",
            pose=np.array([(i + 0.5) * TILE_M, -0.01, (j + 0.5) * TILE_M, 0, 0, 0, 1], np.float32),
            scale=np.array([TILE_M / 2, 0.01, TILE_M / 2], np.float32),
        )
        for i, j in cells.tolist()
    )
