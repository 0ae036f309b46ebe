"""Cameras described in TOML or JSON files: fixed, mounted on a body, following, orbiting, or moving along a path.

The fields are those of `CameraFile`; h3data docs cameras explains them with examples.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import Array, heading_from_quat, pose_to_matrix, quat_from_heading
from h3data.render import (
    CONVENTIONS,
    Camera,
    camera_from_matrix,
    equirectangular,
    fisheye,
    look_at,
    orthographic,
    pinhole,
)
from h3data.render.camera import Convention, Projection
from h3data.replay.records import CameraTrack, forward_fill
from h3data.replay.replay import Replay

Point = tuple[float, float, float]


class Key(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Key frame of a camera's path."""

    time_s: float
    eye: Point
    target: Point


class Orbit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Circular path of a camera around the target, counter-clockwise seen from above."""

    radius_m: float = 3.0
    height_m: float = 1.5
    """Height of the eye above the target [m]."""
    period_s: float = 12.0
    start_deg: float = 0.0
    """Heading of the eye, seen from the target, at the start."""


class CameraFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Description of a camera: its lens, and its pose as ``eye`` and ``target``, ``pose``, ``keys`` or ``orbit``."""

    name: str = ""
    width: int = 640
    height: int = 480
    projection: Projection = "perspective"
    hfov_deg: float | None = None
    """Horizontal field of view [deg]; default 70 for perspective, 180 for fisheye cameras."""
    intrinsics: tuple[float, float, float, float] | None = None
    """Camera matrix as fx fy cx cy [px], instead of hfov_deg."""
    width_m: float | None = None
    """Width of an orthographic image [m]."""
    near: float = 0.0
    far: float = float("inf")
    hidden_layers: tuple[str, ...] = ()
    eye: Point | None = None
    target: Point | None = None
    pose: list[float | list[float]] | None = None
    """Pose as x y z qx qy qz qw, or a 4x4 matrix: camera to world (or to the body on which it is mounted), in
    ``convention``."""
    convention: Convention = "opencv"
    keys: tuple[Key, ...] = ()
    orbit: Orbit | None = None
    follow: str = ""
    """Name of an agent with whose root frame (x forward, y up, z right) the camera moves and turns."""
    turns: bool = True
    """True if the camera turns with the agent; False if it moves with the agent in a constant direction."""
    smooth_s: float = 0.0
    """Time over which the motion of the agent is smoothed [s]."""
    link: str = ""
    """Link of a robot, or joint of a person, named by ``follow``, on which the camera is mounted."""
    body: str = ""
    """Name of a recorded body on which the camera is mounted."""


def load_camera_file(path: Path) -> CameraFile:
    """Return the camera in a TOML or JSON file.

    Raises:
        InputError: there is no such file, or it does not describe a camera.
    """
    if not path.is_file():
        raise InputError(
            f"No such camera file. Expected a TOML or JSON file with eye and target: {path}", code="H3-REPLAY-001"
        )
    decoder: Any = msgspec.json if path.suffix.lower() == ".json" else msgspec.toml
    try:
        spec = decoder.decode(path.read_bytes(), type=CameraFile)
    except (msgspec.DecodeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        fields = ", ".join(CameraFile.__struct_fields__)
        kind = path.suffix.lower()[1:].upper()
        raise InputError(
            f"Not a camera: {error}. Expected {kind} with the fields {fields}: {path}", code="H3-REPLAY-011"
        ) from None
    poses = [name for name in ("eye", "pose", "keys", "orbit") if getattr(spec, name)]
    if len(poses) != 1 or (spec.eye is None) != (spec.target is None or spec.orbit is not None):
        raise InputError(
            f"A camera needs one of: eye with target, pose, keys, orbit; this one has {poses or 'none'}: {path}",
            code="H3-REPLAY-002",
        )
    return spec


def track_of_file(replay: Replay, path: Path) -> CameraTrack:
    """Return the camera described in a file, with its pose at every step of a recording.

    Raises:
        InputError: the file is not a camera, or the recording lacks the agent or body on which it is mounted.
    """
    spec = load_camera_file(path)
    try:
        camera = _lens(spec, spec.name or path.stem)
        base = _base(replay, spec)
        local = _poses(replay, spec)
    except InputError as error:
        raise InputError(f"{error} In the camera file {path}", code=error.code) from None
    poses = local if base is None else base @ local
    # at the first pose, so that a fault of the file is found before the first frame is drawn
    camera.at(poses[0]).checked()
    return CameraTrack(camera=camera, poses=poses)


def _lens(spec: CameraFile, name: str) -> Camera:
    common: dict[str, Any] = {"name": name, "hidden_layers": spec.hidden_layers}
    clip: dict[str, Any] = {"near": spec.near, "far": spec.far}
    if spec.projection == "orthographic":
        if spec.width_m is None:
            raise InputError(
                "An orthographic camera needs width_m, the width of its image in metres.", code="H3-REPLAY-012"
            )
        return orthographic(spec.width, spec.height, width_m=spec.width_m, **common, **clip)
    if spec.projection == "fisheye":
        return fisheye(spec.width, spec.height, hfov_deg=spec.hfov_deg or 180.0, **common)
    if spec.projection == "equirectangular":
        return equirectangular(spec.width, spec.height, **common)
    if spec.intrinsics is None:
        return pinhole(spec.width, spec.height, hfov_deg=spec.hfov_deg or 70.0, **common, **clip)
    if spec.hfov_deg is not None:
        raise InputError("Give either hfov_deg or intrinsics, not both.", code="H3-REPLAY-003")
    fx, fy, cx, cy = spec.intrinsics
    k = camera_from_matrix([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], spec.width, spec.height)
    return Camera(width=k.width, height=k.height, fx=fx, fy=fy, cx=cx, cy=cy, pose=np.eye(4), **common, **clip)


# --- pose relative to the world or the body ------------------------------------------------------------------------------
def _poses(replay: Replay, spec: CameraFile) -> NDArray[np.float64]:
    """Return the camera to the frame that it is given in, [1 or T, 4, 4]."""
    if spec.pose is not None:
        try:
            pose = np.array(spec.pose, np.float64)
        except ValueError:  # rows of different lengths
            pose = np.zeros(0)
        if pose.shape not in ((7,), (4, 4)) or not np.isfinite(pose).all():
            raise InputError(
                f"pose must be 7 numbers (x y z qx qy qz qw) or a 4x4 matrix, got {spec.pose}.", code="H3-REPLAY-013"
            )
        if pose.shape == (7,):
            length = float(np.linalg.norm(pose[3:]))
            if abs(length - 1) > 1e-3:
                raise InputError(
                    f"The quaternion of pose must have length 1, but its length is {length:g}.", code="H3-REPLAY-016"
                )
            pose[3:] /= length
            pose = pose_to_matrix(pose)
        # from the axes of the file's convention to those of OpenCV
        return (pose @ CONVENTIONS[spec.convention])[None]
    if spec.orbit is not None:
        return orbit_poses(_times(replay), spec.target or (0.0, 0.8, 0.0), spec.orbit)
    if spec.keys:
        times = np.array([key.time_s for key in spec.keys])
        if (np.diff(times) <= 0).any():
            raise InputError(
                f"The keys of a path must be in chronological order, got {times.tolist()} s.", code="H3-REPLAY-014"
            )
        steps = _times(replay)
        eye = smooth_path(times, np.array([key.eye for key in spec.keys]), steps)
        target = smooth_path(times, np.array([key.target for key in spec.keys]), steps)
        return np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)])
    assert spec.eye is not None
    assert spec.target is not None
    if spec.eye == spec.target:
        raise InputError(f"eye and target must be different points, both are {list(spec.eye)}.", code="H3-REPLAY-004")
    return look_at(spec.eye, spec.target)[None]


def _times(replay: Replay) -> NDArray[np.float64]:
    """Return the seconds since the recording began, shape [T]."""
    times = replay.recording.columns["time_ns"].astype(np.float64) * 1e-9
    return times - times[0] if len(times) else np.zeros(1)


def orbit_poses(times_s: Array, target: Point, orbit: Orbit) -> NDArray[np.float64]:
    """Return poses [T, 4, 4] (OpenCV camera to world) at times [T] of a camera that circles ``target`` [m]."""
    angle = np.radians(orbit.start_deg) + 2 * np.pi * np.asarray(times_s) / orbit.period_s
    # a heading turns from +X towards -Z: counter-clockwise seen from above
    outward = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], 1)
    eyes = np.array(target) + outward * orbit.radius_m + (0.0, orbit.height_m, 0.0)
    return np.stack([look_at(eye, target) for eye in eyes])


def smooth_path(key_times: Array, points: Array, times: Array) -> NDArray[np.float64]:
    """Return positions [T, 3] at ``times`` on a smooth curve through points [K, 3] at key times [K].

    The positions are constant before the first and after the last key time.
    """
    if len(points) < 3:
        return np.stack([np.interp(times, key_times, points[:, k]) for k in range(3)], axis=1)
    from scipy.interpolate import PchipInterpolator  # passes through the keys without overshooting

    # outside of the keys a cubic would run off
    path = PchipInterpolator(key_times, points, axis=0)
    return np.asarray(path(np.clip(times, key_times[0], key_times[-1])), np.float64)


# --- frame that the camera moves with --------------------------------------------------------------------------------
def _base(replay: Replay, spec: CameraFile) -> NDArray[np.float64] | None:
    """Return the world frames [T, 4, 4] that the camera moves with; None if it is given in the world."""
    if spec.body and spec.follow:
        raise InputError("Give either body or follow, not both.", code="H3-REPLAY-005")
    if spec.body:
        return body_frames(replay, spec.body)
    if not spec.follow:
        if spec.link:
            raise InputError(
                f"link {spec.link!r} needs follow, the name of the agent that has it.", code="H3-REPLAY-015"
            )
        return None
    names = [agent.name for agent in replay.recording.agents]
    if spec.follow not in names:
        raise InputError(
            f"The camera follows {spec.follow!r}, but this recording has the agents {names}.", code="H3-REPLAY-006"
        )
    agent = names.index(spec.follow)
    if spec.link:
        return link_frames(replay, agent, spec.link)
    base = forward_fill(replay.recording.agent_column(agent, "base_pose").astype(np.float64))
    if spec.smooth_s > 0:
        steps = spec.smooth_s / max(float(np.median(np.diff(_times(replay)))), 1e-6)
        from scipy.ndimage import gaussian_filter1d

        position = gaussian_filter1d(base[:, :3], steps / 2, axis=0, mode="nearest")
        # an angle can be smoothed only where it does not jump by 2 pi
        heading = gaussian_filter1d(np.unwrap(heading_from_quat(base[:, 3:])), steps / 2, mode="nearest")
        base = np.asarray(np.concatenate([position, quat_from_heading(heading)], axis=1), np.float64)
    # the base keeps its place alone, so that the camera's pose has the axes of the world
    if not spec.turns:
        base[:, 3:] = quat_from_heading(np.zeros(len(base)))
    return np.asarray(pose_to_matrix(base), np.float64)


def link_frames(replay: Replay, agent: int, name: str) -> NDArray[np.float64]:
    """Return world frames [T, 4, 4] of a robot's link (URDF axes) or a human's joint (z forward, y up, x left at rest)."""
    label = replay.recording.agents[agent].name
    if not replay.recording.agents[agent].model:
        raise InputError(
            f"Agent {label!r} has no model with links; a camera can be mounted on its bodies by name.",
            code="H3-REPLAY-007",
        )
    model = replay.model(agent)
    names = model.link_names
    if name not in names:
        raise InputError(f"Agent {label!r} has no link {name!r}. It has: {', '.join(names)}.", code="H3-REPLAY-008")
    number = names.index(name)
    if isinstance(model, Robot):
        return _rigid(replay.link_track(agent, number).astype(np.float64))
    # In blocks of 512 steps: the matrices of all joints at all steps of a long recording would not fit into memory.
    blocks = np.array_split(np.arange(len(replay)), len(replay) // 512 + 1)
    frames = [replay.joint_matrices(agent, steps)[:, number] for steps in blocks]
    return _rigid(np.concatenate(frames).astype(np.float64))


def body_frames(replay: Replay, name: str) -> NDArray[np.float64]:
    """Return the world frames [T, 4, 4] of a drawable with a name, without its scale."""
    names = [drawable.name for drawable in replay.drawables]
    if name not in names:
        similar = [n for n in names if name.lower() in n.lower()][:8] or names[:8]
        raise InputError(
            f"There is no body {name!r} among {len(names)}, for example: {', '.join(similar)}.", code="H3-REPLAY-009"
        )
    index = names.index(name)
    if replay.drawables[index].deformable:
        raise InputError(
            f"Body {name!r} is a skinned person: mount the camera with follow and link.", code="H3-REPLAY-010"
        )
    matrices = replay.matrices(index) if replay.drawables[index].moving else replay.drawables[index].matrix[None]
    return _rigid(np.asarray(matrices, np.float64))


def _rigid(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return frames [T, 4, 4] with unit axes and gaps (NaN) filled."""
    frames = forward_fill(matrices.reshape(len(matrices), 16)).reshape(-1, 4, 4)
    # a scaled body would scale what the camera sees
    frames[:, :3, :3] /= np.maximum(np.linalg.norm(frames[:, :3, :3], axis=1, keepdims=True), 1e-12)
    return frames
