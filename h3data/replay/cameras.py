"""Cameras of a recording by name: mounted on robots and people, following them, or above the home."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.errors import InputError, suggest
from h3data.geometry import pose_to_matrix, transform_points
from h3data.render import OPENGL_TO_OPENCV, Camera, look_at, orthographic, pinhole
from h3data.replay.camera_files import Orbit, link_frames, orbit_poses, track_of_file
from h3data.replay.records import CameraTrack, forward_fill
from h3data.replay.replay import Replay
from h3data.replay.third_person import default_leader, third_person, third_person_at

THIRD_PERSON = "third_person"
MAX_SIDE_PX = 8192
"""Largest width and height of a picture [px]."""


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``"1280x720"`` as width and height [px].

    Raises:
        InputError: the text is not a size, or a side is 0 or above `MAX_SIDE_PX`.
    """
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(side) for side in sides.groups()) if sides else (0, 0)
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise InputError(
            f"Expected a size such as 1280x720, of at most {MAX_SIDE_PX} pixels a side, got {text!r}.",
            code="H3-RENDER-085",
        )
    return width, height


def split_size(name_or_file: str) -> tuple[str, tuple[int, int] | None]:
    """Split ``robot_arm@224x224`` into the camera and its size [px]; the size is None where the text has none.

    Raises:
        InputError: a side is 0 or above `MAX_SIDE_PX`.
    """
    sized = re.fullmatch(r"(.+)@(\d+x\d+)", name_or_file)
    return (sized[1], parse_size(sized[2])) if sized else (name_or_file, None)


def camera_names(replay: Replay) -> list[str]:
    """Return the names of all cameras that a recording offers."""
    names = ["top_down", "top_down_orthographic", "orbit"]
    if replay.recording.agents:
        names.append(THIRD_PERSON)
    for index, agent in enumerate(replay.recording.agents):
        model = replay.model(index) if agent.model else None
        mounted = model.camera_names if model else ()
        # the first agent with such a camera has its plain name, the others have theirs before it
        names += [name if name not in names else f"{agent.name}/{name}" for name in mounted]
        if index != default_leader(replay):
            names.append(f"{agent.name}/{THIRD_PERSON}")
    return names + [c for c in replay.recording.columns if c.startswith("user.")]


def camera_track(replay: Replay, name_or_file: str) -> CameraTrack:
    """Return the camera with a name (`camera_names`), or the one described in a TOML or JSON file (h3data docs cameras).

    ``agent/name`` selects the camera of one agent if several have a camera of that name. ``name@WIDTHxHEIGHT`` gives its
    pictures another size and keeps the field of view (`CameraTrack.resized`).

    Raises:
        InputError: there is no such camera (the message lists those that exist), or the file or the size is invalid.
    """
    name_or_file, size = split_size(name_or_file)
    if size is not None:
        return camera_track(replay, name_or_file).resized(*size)
    if name_or_file.lower().endswith((".toml", ".json")):
        return track_of_file(replay, Path(name_or_file))
    names = camera_names(replay)
    # cameras that are computed from the recording as a whole
    virtual = {
        "top_down": top_down,
        "top_down_orthographic": top_down_orthographic,
        "orbit": orbit,
    }
    if name_or_file in names and name_or_file in virtual:
        return virtual[name_or_file](replay)
    if (leader := _followed(replay, name_or_file)) is not None:
        track = third_person(replay, leader)
        return replace(track, camera=replace(track.camera, name=name_or_file.replace("/", ".")))
    if name_or_file in names and name_or_file.startswith("user."):
        # the pose is a column of the recording, in Habitat's convention: looking along -z, y up
        poses = (
            pose_to_matrix(forward_fill(replay.recording.columns[name_or_file].astype(np.float64))) @ OPENGL_TO_OPENCV
        )
        return CameraTrack(camera=pinhole(640, 480, hfov_deg=90, name=name_or_file), poses=poses)
    mounted = _mounted(replay, name_or_file) if name_or_file in names or "/" in name_or_file else None
    if mounted is None:
        raise InputError(
            f"Unknown camera {name_or_file!r}."
            f"{suggest(name_or_file, names, lead='This recording offers', more='; or give a .toml or .json file')}",
            code="H3-REPLAY-017",
        )
    return mounted


def camera_at(replay: Replay, name_or_file: str, step: int) -> Camera:
    """Return the camera with a name at one step, which for ``third_person`` is much faster than `camera_track`.

    Negative steps count from the end.
    """
    row, (name_or_file, size) = replay.row(step), split_size(name_or_file)
    if size is not None:
        track = camera_track(replay, name_or_file)
        return camera_at(replay, name_or_file, row).resized(*size, crop=track.crops)
    if (leader := _followed(replay, name_or_file)) is not None:
        return replace(third_person_at(replay, row, leader), name=name_or_file.replace("/", "."))
    return camera_track(replay, name_or_file).at(row)


def _followed(replay: Replay, name: str) -> int | None:
    """Return the number of the agent that ``third_person`` or ``agent/third_person`` follows, None for any other camera."""
    owner, _, camera_name = name.rpartition("/")
    agents = replay.recording.agents
    if camera_name != THIRD_PERSON or not agents:
        return None
    return next((k for k, agent in enumerate(agents) if agent.name == owner), None) if owner else default_leader(replay)


def carrier_of(replay: Replay, name: str) -> int | None:
    """Return the number of the first agent that carries a camera of this name, or of the agent in ``agent/name``.

    The result is None if no agent carries such a camera.
    """
    owner, _, camera_name = name.rpartition("/")
    for index, agent in enumerate(replay.recording.agents):
        model = replay.model(index) if agent.model and owner in ("", agent.name) else None
        if model is not None and camera_name in model.camera_names:
            return index
    return None


def _mounted(replay: Replay, name: str) -> CameraTrack | None:
    """Return the camera that an agent carries (`carrier_of`); None if no agent carries it."""
    # names of videos are names of files, so that `agent/name` becomes `agent.name`
    index, camera_name = carrier_of(replay, name), name.rpartition("/")[2]
    if index is None:
        return None
    model, label = replay.model(index), name.replace("/", ".")
    mounted = model.camera(camera_name)
    camera = pinhole(mounted.width, mounted.height, hfov_deg=mounted.hfov_deg, name=label, near=mounted.near_m)
    if isinstance(model, Robot):
        frames = replay.link_track(index, mounted.link).astype(np.float64)
    else:
        frames = link_frames(replay, index, model.link_names[mounted.link])
    return CameraTrack(camera=camera, poses=frames @ mounted.pose)


# --- from above ---------------------------------------------------------------------------------------------------------
TOP_DOWN_PIXELS = 480_000
CUT_M = 2.2
"""Height above the floor at which views from above cut a home that has no layer ``ceiling``, such as a stage of one mesh
[m]."""


def top_down(replay: Replay, *, margin_m: float = 0.4) -> CameraTrack:
    """Return a static view of the whole home from high above, without ceilings and with -Z at the top."""
    lo, hi = _extent(replay, margin_m)
    span_x, span_z = hi[0] - lo[0], hi[2] - lo[2]
    shape = float(np.clip(span_z / span_x, 1 / 3, 3 / 2))
    # even sides, as videos need them
    width = int(np.sqrt(TOP_DOWN_PIXELS / shape)) // 2 * 2
    height = int(width * shape) // 2 * 2
    hfov_deg = 16.0  # narrow: nearly orthographic, so that walls do not hide the floor
    tan = np.tan(np.radians(hfov_deg) / 2)
    # far enough for both sides of the home
    distance = max(span_x / 2 / tan, span_z / 2 / (tan * height / width))
    middle = (lo + hi) / 2
    eye = np.array([middle[0], hi[1] + distance, middle[2]])
    # the view is along -Y, so that up cannot be +Y
    pose = look_at(eye, np.array([middle[0], lo[1], middle[2]]), up=(0.0, 0.0, -1.0))
    near = _ceiling_cut(replay, float(eye[1]), lowest=float(lo[1]) + margin_m)
    camera = pinhole(
        width, height, hfov_deg=hfov_deg, name="top_down", pose=pose, hidden_layers=("ceiling",), near=near
    )
    return CameraTrack(camera=camera, poses=pose[None], crops=False)


def top_down_orthographic(replay: Replay, *, margin_m: float = 0.4) -> CameraTrack:
    """Return an orthographic view of the whole home from above, without ceilings and with -Z at the top."""
    lo, hi = _extent(replay, margin_m)
    span_x, span_z = hi[0] - lo[0], hi[2] - lo[2]
    scale = np.sqrt(TOP_DOWN_PIXELS / (span_x * span_z))
    width, height = (max(int(span * scale) // 2 * 2, 2) for span in (span_x, span_z))
    eye = np.array([(lo[0] + hi[0]) / 2, hi[1] + 1.0, (lo[2] + hi[2]) / 2])
    pose = look_at(eye, eye - (0.0, 1.0, 0.0), up=(0.0, 0.0, -1.0))
    camera = orthographic(
        width,
        height,
        width_m=width / scale,
        name="top_down_orthographic",
        pose=pose,
        hidden_layers=("ceiling",),
        near=_ceiling_cut(replay, float(eye[1]), lowest=float(lo[1]) + margin_m),
    )
    return CameraTrack(camera=camera, poses=pose[None], crops=False)


def _ceiling_cut(replay: Replay, eye_y: float, *, lowest: float) -> float:
    """Return near plane of a camera at height ``eye_y`` that looks straight down and must see below the ceiling [m].

    It cuts the scene `CUT_M` above the highest floor that an agent walks on, or above ``lowest`` without agents. It is
    0 if ceilings can be hidden by their layer, or if no static part of the scene is that high.
    """
    if any(drawable.layer == "ceiling" for drawable in replay.drawables):
        return 0.0
    agents = range(len(replay.recording.agents))
    heights = np.concatenate([[-np.inf], *(replay.recording.agent_column(i, "base_pose")[:, 1] for i in agents)])
    floor = float(np.max(heights[~np.isnan(heights)]))
    cut = (floor if np.isfinite(floor) else lowest) + CUT_M
    static = [d for d in replay.drawables if not d.moving and not d.placeholder and len(d.mesh.vertices)]
    tops = (transform_points(d.matrix, d.mesh.vertices)[:, 1].max() for d in static)
    return max(eye_y - cut, 0.0) if max(tops, default=-np.inf) > cut else 0.0


def orbit(replay: Replay) -> CameraTrack:
    """Return a camera that circles the whole home from above, without ceilings, once per recording."""
    lo, hi = _extent(replay)
    middle, reach = (lo + hi) / 2, float(np.hypot(hi[0] - lo[0], hi[2] - lo[2])) / 2
    times = replay.recording.columns["time_ns"].astype(np.float64) * 1e-9
    # at least 12 s for a round: a short recording would make the viewer dizzy
    around = Orbit(radius_m=2.3 * reach, height_m=2.0 * reach, period_s=max(replay.recording.duration_s, 12.0))
    target = (float(middle[0]), float(lo[1]) + 0.5, float(middle[2]))
    poses = orbit_poses(times, target, around) if len(times) else np.eye(4)[None]
    camera = pinhole(960, 540, hfov_deg=50, name="orbit", pose=poses[0], hidden_layers=("ceiling",))
    return CameraTrack(camera=camera, poses=poses, crops=False)


def _extent(replay: Replay, margin_m: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return minimum and maximum corner of the home, or of all recorded things, with a margin [m]."""
    if replay.scene is not None and replay.scene.rooms:
        rectangles = np.concatenate([room.rectangles for room in replay.scene.rooms])
        top = float(replay.scene.bounds[1, 1])
        return (
            np.array([rectangles[:, 0].min(), replay.scene.rooms[0].floor_y, rectangles[:, 1].min()]) - margin_m,
            np.array([rectangles[:, 2].max(), top, rectangles[:, 3].max()]) + margin_m,
        )
    corners = []
    for index, drawable in enumerate(replay.drawables):
        lo, hi = drawable.mesh.bounds
        if drawable.placeholder and np.max(hi - lo) > 10.0:
            continue  # the placeholder of a missing building does not have its size
        box = np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])
        # 32 moments are enough for the box of a moving thing, and cheap for people
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
    # a single point would make a camera without a distance
    return lo - margin_m, np.maximum(hi, lo + 1.0) + margin_m
