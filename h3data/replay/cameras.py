"""Named cameras of a recording: the robot's own, one that trails the robot, one from above, and the user's own files."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import pose_to_matrix
from h3data.render import OPENGL_TO_OPENCV, Camera, look_at, pinhole
from h3data.replay.chase import held, third_person
from h3data.replay.replay import CameraTrack, Replay


class CameraFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera in a TOML file: where it stands and what it looks at, in the world or in an agent's root frame."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    name: str = ""
    width: int = 640
    height: int = 480
    hfov_deg: float = 70.0
    follow: str = ""
    """Name of an agent: ``eye`` and ``target`` are then in its root frame (x forward, y up, z right)."""
    hidden_layers: tuple[str, ...] = ()


def camera_names(replay: Replay) -> list[str]:
    """Every camera that this recording offers by name."""
    names = ["top_down"]
    if replay.recording.agents:
        names.append("third_person")
    for index, agent in enumerate(replay.recording.agents):
        model = replay.model(index) if agent.model else None
        if isinstance(model, Robot):
            names += [c.name for c in model.cameras if c.name not in names]
    return names + [c for c in replay.recording.columns if c.startswith("user.")]


def camera_track(replay: Replay, name_or_file: str) -> CameraTrack:
    """The camera called ``name_or_file``, or the one described in that TOML file.

    Raises:
        InputError: there is no such camera (the message lists them) or the file is not a camera.
    """
    if name_or_file.endswith(".toml"):
        return _from_file(replay, Path(name_or_file))
    names = camera_names(replay)
    if name_or_file not in names:
        raise InputError(
            f"Unknown camera {name_or_file!r}. This recording offers: {', '.join(names)}; or give a .toml file."
        )
    if name_or_file == "top_down":
        return top_down(replay)
    if name_or_file == "third_person":
        return third_person(replay)
    if name_or_file.startswith("user."):
        return _user(replay, name_or_file)
    return _mounted(replay, name_or_file)


def _mounted(replay: Replay, name: str) -> CameraTrack:
    """A camera of the first robot that has one of that name."""
    for index, agent in enumerate(replay.recording.agents):
        model = replay.model(index) if agent.model else None
        if not isinstance(model, Robot):
            continue
        for mounted in model.cameras:
            if mounted.name == name:
                camera = pinhole(mounted.width, mounted.height, hfov_deg=mounted.hfov_deg, name=name)
                poses = model.camera_poses(name, replay.link_matrices(index).astype(np.float64))
                return CameraTrack(camera=camera, poses=poses)
    raise InputError(f"No robot of this recording has a camera {name!r}.")


def _user(replay: Replay, column: str) -> CameraTrack:
    """A camera pose that the recording carries (Habitat's convention: looks along -z, y up)."""
    poses = pose_to_matrix(held(replay.recording.columns[column].astype(np.float64))) @ OPENGL_TO_OPENCV
    return CameraTrack(camera=pinhole(640, 480, hfov_deg=90, name=column), poses=poses)


# --- from above ---------------------------------------------------------------------------------------------------------
TOP_DOWN_PIXELS = 480_000


def top_down(replay: Replay, *, margin_m: float = 0.4) -> CameraTrack:
    """The whole home from high above, without ceilings; the picture's upper edge is -Z. Stands still."""
    lo, hi = _extent(replay)
    lo, hi = lo - margin_m, hi + margin_m
    span_x, span_z = hi[0] - lo[0], hi[2] - lo[2]
    shape = float(np.clip(span_z / span_x, 1 / 3, 3 / 2))
    width = int(np.sqrt(TOP_DOWN_PIXELS / shape)) // 2 * 2
    height = int(width * shape) // 2 * 2
    hfov_deg = 16.0  # narrow: nearly orthographic, so that walls do not hide the floor
    tan = np.tan(np.radians(hfov_deg) / 2)
    distance = max(span_x / 2 / tan, span_z / 2 / (tan * height / width))
    middle = (lo + hi) / 2
    eye = np.array([middle[0], hi[1] + distance, middle[2]])
    pose = look_at(eye, np.array([middle[0], lo[1], middle[2]]), up=(0.0, 0.0, -1.0))
    camera = pinhole(width, height, hfov_deg=hfov_deg, name="top_down", pose=pose, hidden_layers=("ceiling",))
    return CameraTrack(camera=camera, poses=pose[None])


PLACEHOLDER_STAGE_M = 10.0


def _extent(replay: Replay) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest corner of what was there, over the whole recording [m]."""
    if replay.scene is not None and replay.scene.rooms:
        rectangles = np.concatenate([room.rectangles for room in replay.scene.rooms])
        top = float(replay.scene.bounds[1, 1])
        return (
            np.array([rectangles[:, 0].min(), replay.scene.rooms[0].floor_y, rectangles[:, 1].min()]),
            np.array([rectangles[:, 2].max(), top, rectangles[:, 3].max()]),
        )
    corners = []
    for index, drawable in enumerate(replay.drawables):
        lo, hi = drawable.mesh.bounds
        if drawable.placeholder and np.max(hi - lo) > PLACEHOLDER_STAGE_M:
            continue  # the slab that stands for a missing building says nothing about its size
        box = np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])
        steps = np.unique(np.linspace(0, len(replay) - 1, 32).astype(int)) if drawable.moving else None
        if drawable.deformable and steps is not None:
            points = replay.vertices(index, steps).reshape(-1, 3).astype(np.float64)
            corners.append(points[np.isfinite(points).all(-1)])
        else:
            matrices = replay.matrices(index, steps) if drawable.moving else drawable.matrix[None]
            points = np.einsum("tij,nj->tni", matrices[:, :3, :3], box) + matrices[:, None, :3, 3]
            corners.append(points[np.isfinite(points).all(-1)])
    points = np.concatenate([c.reshape(-1, 3) for c in corners]) if corners else np.zeros((1, 3))
    lo, hi = points.min(0), points.max(0)
    return lo, np.maximum(hi, lo + 1.0)


# --- from a file --------------------------------------------------------------------------------------------------------
def _from_file(replay: Replay, path: Path) -> CameraTrack:
    if not path.is_file():
        raise InputError(f"No camera file there. Expected a TOML file with eye and target: {path}")
    try:
        spec = msgspec.toml.decode(path.read_bytes(), type=CameraFile)
    except msgspec.DecodeError as error:
        fields = ", ".join(CameraFile.__struct_fields__)
        raise InputError(f"Not a camera: {error}. Expected TOML with the fields {fields}: {path}") from None
    pose = look_at(spec.eye, spec.target)
    camera: Camera = pinhole(
        spec.width, spec.height, hfov_deg=spec.hfov_deg, name=spec.name or path.stem, hidden_layers=spec.hidden_layers
    )
    if not spec.follow:
        return CameraTrack(camera=camera, poses=pose[None])
    names = [agent.name for agent in replay.recording.agents]
    if spec.follow not in names:
        raise InputError(f"The camera follows {spec.follow!r}; this recording has the agents {names}: {path}")
    base = held(replay.recording.agent_column(names.index(spec.follow), "base_pose").astype(np.float64))
    return CameraTrack(camera=camera, poses=pose_to_matrix(base) @ pose)
