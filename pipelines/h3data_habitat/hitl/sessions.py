"""Reading of habitat-lab's ``rearrange_v2`` HITL sessions, and PARTNR's in the same format (spec/habitat.md 5.3)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.formats import SourceFile
from h3data.geometry import normalized, pose_from_matrix, quat_rotate, quat_sign_continuous
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.records import STEP_NS, Event, Recording
from h3data_habitat.episodes.partnr import partnr_result
from h3data_habitat.hitl.agents import AgentTrack, agent_kinds, robot_named_in
from h3data_habitat.hitl.episode import (
    HitlEpisode,
    Id,
    Number,
    PoseTracks,
    Quat,
    Vec3,
    decoded,
    held,
    unit_rotations,
)
from h3data_habitat.hitl.outcomes import logged_outcomes, max_steps
from h3data_habitat.hitl.scenes import find_place
from h3data_habitat.hitl.users import participation, without_user_ids
from h3data_habitat.limits import MAX_TRACK_VALUES, check_size

Order = Literal["xyzw", "wxyz"]
_LAST_UNIX_S = 9e9
_SELECTIONS = ("held_object", "hovered_object", "selected_object")


class CameraTransform(msgspec.Struct):
    """Columns of the camera-to-world matrix."""

    right: Vec3
    up: Vec3
    backward: Vec3
    translation: Vec3


class User(msgspec.Struct):
    """State of a user: camera, selected and held objects, and events."""

    camera_transform: CameraTransform | None = None
    finished_episode: bool | None = None
    held_object: Id | None = None
    hovered_object: Id | None = None
    selected_object: Id | None = None
    events: list[dict[str, Any]] = []


class ObjectState(msgspec.Struct):
    """Pose of an object."""

    object_handle: str
    position: Vec3
    rotation: Quat
    object_id: Id | None = None
    states: dict[str, Any] | None = None


class AgentState(msgspec.Struct):
    """Pose of an agent's root, and the object that it holds."""

    position: Vec3
    rotation: Quat
    grasp_mgr_snap_idx: Id | None = None


class Frame(msgspec.Struct):
    """Frame of a session."""

    t: Number | None = None
    users: list[User] = []
    object_states: list[ObjectState] = []
    agent_states: list[AgentState] = []
    task_percent_complete: Number | None = None


class File(msgspec.Struct):
    """Content of a session file."""

    frames: list[Frame]
    episode: dict[str, Any] = {}
    session: dict[str, Any] = {}
    users: list[Any] = []
    metrics: Any = None


def read_hitl_episode(
    path: str | os.PathLike[str], *, assets: AssetLibrary | None = None, quaternion_order: Order | None = None
) -> Recording:
    """Read the recording in an ``{episode_index}.json(.gz)`` of a ``rearrange_v2`` session.

    The file logs the roots of agents and objects, no joints. So:

    - ``time_ns`` counts from the first stamp; ``info["t0_unix_ns"]`` is the wall clock there, to a second. A frame in which
      nobody was active is ``{}``: it repeats the state before it, its time lies between its neighbours', and the column
      ``recorded`` is False there.
    - Robots are shown by a built-in model at rest; people get a synthesised walk along their path
      (`h3data_motion.walk_synthesis`); ``info["synthesised"]`` states this. ``agent_<i>.root_pose`` keeps the root of
      people as logged.
    - ``user.user_<u>_camera`` [T, 7] is the view of user ``u`` in Habitat's camera frame (looks along -z), NaN where
      absent; ``input.user_<u>.held_object`` (``hovered_``, ``selected_``) the object ids, -1 = none; ``info["object_ids"]``
      has the id of each body.
    - Actions of users (pick, place, open, close, state_change, ...) are events; ``detail`` has the rest of each as JSON.
    - ``object_state.<name>`` int8 [T, N]: 1 yes, 0 no, -1 unknown, per object.
    - ``metrics.success`` follows from the logged progress; contacts and goals are not in the file. User ids become
      pseudonyms (`h3data.pseudonyms`), of which ``info["participant"]`` is that of the user who controls the person.

    Args:
        path: the file.
        assets: Asset folders in which the scene is searched; without them, or if the scene is not found, a marked floor
            is used.
        quaternion_order: Order of the components of quaternions of agents and objects; habitat-lab writes xyzw. None
            infers it from the agents, who stand upright.

    Raises:
        FormatError: the file is something else, truncated or damaged.
    """
    source = SourceFile.of(path)
    path, data = source.path, source.data
    file = decoded(data, File, path, expected="hitl_episode")
    if not file.frames:
        raise FormatError(f"An episode without frames: {path}", code="H3-HABITAT-074")
    frames, steps = file.frames, len(file.frames)
    check_size(steps, max(len(f.agent_states) for f in frames) + max(len(f.users) for f in frames), path)
    # the tool writes `{}` for a frame in which nobody was active
    known = np.array([bool(f.agent_states or f.object_states or f.users or f.t is not None) for f in frames])
    roots, ids = _agents(frames, path)
    order = quaternion_order or upright_order(roots)
    if order == "wxyz":
        roots = [r[:, [0, 1, 2, 4, 5, 6, 3]] for r in roots]
    objects, object_of_id = _objects(frames, order)
    time_ns, t0_s, warnings = _times(frames)
    episode, config = file.episode, file.session.get("config")
    session, users = without_user_ids(file.session), without_user_ids(file.users)
    result = partnr_result(path)
    tracks = [
        AgentTrack(roots=held(r, known), grasp_id=held(i, known).astype(np.int64))
        for r, i in zip(roots, ids, strict=True)
    ]
    people = [k for k, kind in enumerate(agent_kinds(tracks)) if kind == "human"]
    columns = _columns(frames, known, objects.names, path)
    log = HitlEpisode(
        path=path,
        data=data,
        form="hitl_episode",
        episode_id=str(episode.get("episode_id", "")),
        created_by="habitat-lab HITL rearrange_v2",
        dt_ns=_nominal_step_ns(config),
        time_ns=time_ns,
        tracks=tracks,
        object_names=objects.names,
        object_tracks=[held(track, known) for track in objects.arrays(path)],
        object_of_id=object_of_id,
        robot=robot_named_in(json.dumps(episode.get("episode_info")), json.dumps(config)),
        columns=columns | logged_outcomes(columns),
        events=_events(frames, episode),
        warnings=warnings,
        info={
            "generation": 2,
            "quaternion_order": order,
            "t0_s": t0_s,
            **_wall_clock(episode, t0_s),
            "empty_frames": int(steps - known.sum()),
            "episode": episode,
            "session": session,
            "users": users,
            "metrics": file.metrics,
            **max_steps(config),
            **participation(users, episode.get("user_index_to_agent_index_map"), people),
            **({"partnr": result} if result else {}),
        },
    )
    return log.recording(find_place(str(episode.get("scene_id") or ""), assets, floor_y=log.floor_y()))


def upright_order(roots: Sequence[NDArray[np.float64]]) -> Order:
    """Return the order of the quaternions of agents' roots [T, 7] in which agents stand upright."""
    tracks = [r[np.isfinite(r).all(1), 3:] for r in roots]
    quats = normalized(np.concatenate(tracks)) if tracks else np.zeros((0, 4))
    if not len(quats):
        return "xyzw"
    up = np.array([0.0, 1.0, 0.0])
    # the median, since people bend and lie now and then
    given, turned = (np.median(quat_rotate(q, up)[:, 1]) for q in (quats, quats[:, [1, 2, 3, 0]]))
    return "wxyz" if turned > given else "xyzw"


def _agents(frames: Sequence[Frame], path: Path) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Return roots [T, 7] in the file's order of quaternions, NaN where absent, and held ids [T] of each agent."""
    agents = max(len(f.agent_states) for f in frames)
    roots = [np.full((len(frames), 7), np.nan) for _ in range(agents)]
    ids = [np.full(len(frames), -1.0) for _ in range(agents)]
    for step, frame in enumerate(frames):
        for k, state in enumerate(frame.agent_states):
            roots[k][step] = (*state.position, *state.rotation)
            ids[k][step] = -1 if state.grasp_mgr_snap_idx is None else state.grasp_mgr_snap_idx
    return [unit_rotations(r, f"agent {k}", path) for k, r in enumerate(roots)], ids


def _objects(frames: Sequence[Frame], order: Order) -> tuple[PoseTracks, dict[int, str]]:
    tracks, object_of_id = PoseTracks(len(frames)), {}
    for step, frame in enumerate(frames):
        for state in frame.object_states:
            a, b, c, d = state.rotation
            tracks.add(state.object_handle, step, state.position, (a, b, c, d) if order == "xyzw" else (b, c, d, a))
            if state.object_id is not None:
                object_of_id[state.object_id] = state.object_handle
    return tracks, object_of_id


def _times(frames: Sequence[Frame]) -> tuple[NDArray[np.int64], float, list[str]]:
    """Return the times since the first stamp [T] [ns], that stamp [s], and warnings.

    Frames without a stamp are spread evenly between those with one; before and after them they follow at the usual step.
    """
    stamped = np.array([k for k, f in enumerate(frames) if f.t is not None])
    stamps = np.array([f.t for f in frames if f.t is not None], np.float64)
    # per frame, as frames without a stamp lie in between
    gaps = np.diff(stamps) / np.diff(stamped) if len(stamped) > 1 else np.zeros(0)
    usual = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else STEP_NS * 1e-9
    steps = np.arange(len(frames))
    if not len(stamped):
        seconds, t0 = steps * usual, 0.0
    else:
        seconds = np.interp(steps, stamped, stamps)
        seconds -= np.maximum(stamped[0] - steps, 0) * usual
        seconds += np.maximum(steps - stamped[-1], 0) * usual
        t0 = float(seconds[0])
    nanoseconds = np.round((seconds - t0) * 1e9).astype(np.int64)
    # a recording needs times that increase strictly
    rising = np.maximum.accumulate(nanoseconds - steps) + steps  # at least 1 ns apart
    late = int((rising != nanoseconds).sum())
    warnings = [f"{late} time stamps do not increase; these steps are put 1 ns after the ones before"] if late else []
    return rising, t0, warnings


def _wall_clock(episode: Mapping[str, Any], t0_s: float) -> dict[str, int]:
    """Return ``t0_unix_ns``: wall clock at the first row, if the episode says when it began (whole seconds as text)."""
    start = episode.get("start_timestamp")
    if not isinstance(start, str) or not re.fullmatch(r"\d{1,10}(\.\d{1,9})?", start):
        return {}
    return {"t0_unix_ns": round((float(start) + t0_s) * 1e9)} if 0 <= float(start) + t0_s < _LAST_UNIX_S else {}


def _nominal_step_ns(config: Any) -> int:
    """Return the tool's target step (``habitat_hitl.target_sps``); 1/30 s if the file has none."""
    tool = config.get("habitat_hitl") if isinstance(config, dict) else None
    rate = tool.get("target_sps") if isinstance(tool, dict) else None
    if isinstance(rate, (int, float)) and 1 <= rate <= 1000 and rate != 30:
        return round(1e9 / rate)
    return STEP_NS


def _columns(
    frames: Sequence[Frame], known: NDArray[np.bool_], names: Sequence[str], path: Path
) -> dict[str, NDArray[Any]]:
    steps = len(frames)
    columns: dict[str, NDArray[Any]] = {"recorded": known}
    for u in range(max(len(f.users) for f in frames)):
        users = [f.users[u] if u < len(f.users) else None for f in frames]
        columns[f"user.user_{u}_camera"] = _cameras(users)
        for name in _SELECTIONS:
            ids = [None if user is None else getattr(user, name) for user in users]
            columns[f"input.user_{u}.{name}"] = np.array([-1 if i is None else i for i in ids], np.int64)
        columns[f"input.user_{u}.finished_episode"] = np.array([bool(x and x.finished_episode) for x in users])
    done = np.array([np.nan if f.task_percent_complete is None else f.task_percent_complete for f in frames])
    columns["metrics.task_percent_complete"] = held(done, np.isfinite(done)).astype(np.float32)
    index = {name: k for k, name in enumerate(names)}
    states = sorted(
        {s for f in frames for o in f.object_states for s, v in (o.states or {}).items() if type(v) is bool}
    )
    if steps * len(states) * len(names) > MAX_TRACK_VALUES:
        raise FormatError(
            f"{len(states)} states of {len(names)} objects are more than can be read: {path}", code="H3-HABITAT-075"
        )
    for state in states:
        values = np.full((steps, len(names)), -1, np.int8)
        for step, frame in enumerate(frames):
            for o in frame.object_states:
                value = (o.states or {}).get(state)
                # states of other types are no yes or no
                if type(value) is bool:
                    values[step, index[o.object_handle]] = value
        columns[f"object_state.{state}"] = held(values, known).astype(np.int8)
    return columns


def _cameras(users: Sequence[User | None]) -> NDArray[np.float32]:
    """Return pose7 [T, 7] of one user's view."""
    poses = np.full((len(users), 7), np.nan)
    seen = [(k, u.camera_transform) for k, u in enumerate(users) if u is not None and u.camera_transform is not None]
    if seen:
        matrix = np.array([[c.right, c.up, c.backward, c.translation] for _, c in seen]).transpose(0, 2, 1)
        found = pose_from_matrix(matrix)
        found[:, 3:] = quat_sign_continuous(normalized(found[:, 3:]))
        # a matrix of zeros is no view
        found[np.linalg.norm(found[:, 3:], axis=1) < 0.5] = np.nan
        poses[[k for k, _ in seen]] = found
    return poses.astype(np.float32)


def _events(frames: Sequence[Frame], episode: Mapping[str, Any]) -> list[Event]:
    owners = episode.get("user_index_to_agent_index_map")
    owners = owners if isinstance(owners, dict) else {}
    events = []
    for step, frame in enumerate(frames):
        for u, user in enumerate(frame.users):
            # JSON has texts as keys
            agent = owners.get(str(u), -1)
            for event in user.events:
                rest = {k: v for k, v in event.items() if k not in ("type", "obj_handle")}
                events.append(
                    Event(
                        step=step,
                        agent=agent if type(agent) is int and -1 <= agent < 2**31 else -1,
                        kind=str(event.get("type", "")),
                        target=str(event.get("obj_handle", "")),
                        detail=json.dumps({"user": u, **rest}),
                    )
                )
    return events
