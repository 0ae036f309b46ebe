"""Reading of logs of the paper's HITL tool: habitat-lab's ``siro_sandbox``, later ``rearrange`` (spec/habitat.md 5.2)."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skeleton import HUMAN_ROOT_HEIGHT_M
from h3data.errors import FormatError
from h3data.formats import SourceFile
from h3data.geometry import Array, ground_pose
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.records import STEP_NS, Event, Recording
from h3data_habitat.hitl.agents import AgentTrack, JointOrder, robot_named_in, tilt_rad
from h3data_habitat.hitl.episode import (
    MAX_FLOAT,
    HitlEpisode,
    Id,
    PoseTracks,
    Quat,
    Vec3,
    decoded,
    held,
    scalar_columns,
    unit_rotations,
)
from h3data_habitat.hitl.outcomes import AT_GOAL_M, at_goal, logged_outcomes
from h3data_habitat.hitl.pickled_logs import json_of_pickled_log
from h3data_habitat.hitl.scenes import find_place
from h3data_habitat.limits import MAX_TRACK_VALUES, check_size
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS
from h3data_habitat.safe_pickle import is_pickle

JOINT_VALUES = 4 * len(HABITAT_JOINTS)
PERSON_VALUES = JOINT_VALUES + 32
"""Number of values of a person's action: 54 quaternions xyzw, then two 4x4 matrices, column by column: offset and
base."""


class AgentState(msgspec.Struct):
    """Pose of an agent's root, and the object that it holds."""

    position: Vec3
    rotation_xyzw: Quat
    grasp_mgr_snap_idx: Id | None = None


class Step(msgspec.Struct):
    """Step of a log."""

    agent_states: list[AgentState] = []
    action: Any = None
    gui_humanoid: dict[str, Any] | None = None
    target_object_positions: list[Vec3] | None = None
    metrics: dict[str, Any] | None = None


class Log(msgspec.Struct):
    """Log of one episode."""

    steps: list[Step]
    episode_id: str | int | None = None
    scene_id: str | None = None
    start_time: str | None = None
    dataset: Any = None
    target_obj_ids: list[Id] | None = None
    goal_positions: Any = None


def read_hitl_log(
    path: str | os.PathLike[str],
    *,
    fps: float = 30.0,
    assets: AssetLibrary | None = None,
    joint_order: JointOrder | None = None,
) -> Recording:
    """Read the recording in a ``<session>.<n>.json.gz`` or ``.pkl.gz`` of the paper's HITL tool.

    - The log has no time stamps: row k is step k at ``fps`` steps per second.
    - A person's whole posture is in the action vector (spec/habitat-findings.md 9): ``agent_<i>.joint_quat`` holds it,
      ``root_pose`` the logged pelvis. ``joint_order`` of the vector is that of the person's URDF, which the log does not
      name; None infers it from the posture (`h3data_habitat.hitl.agents.infer_joint_order`).
    - The rest of the vector is the robot's ``agent_<i>.action``.
    - Of the objects only the positions of the targets are logged: their rotations are the identity.
    - ``input.user_0.<name>`` holds the input at the keyboard (``hint_walk_dir`` [T, 3], ``cam_yaw``, ...; NaN where
      absent); picking and placing are events.
    - ``metrics.*`` are the logged numbers, with ``metrics.success``, ``metrics.collision`` and ``metrics.at_goal`` for the
      metrics of social rearrangement (`h3data_habitat.hitl.outcomes`).

    Raises:
        FormatError: the file is something else, truncated or damaged, or a pickle that asks for code (which is named).
    """
    file = SourceFile.of(path)
    path, data = file.path, file.data
    log = _log(data, path)
    if not log.steps:
        raise FormatError(f"A log without steps: {path}", code="H3-HABITAT-071")
    steps = log.steps
    check_size(len(steps), max(len(s.agent_states) for s in steps), path)
    tracks, warnings = _tracks(steps, path)
    names = [
        f"object_{i}" for i in log.target_obj_ids or range(max(len(s.target_object_positions or ()) for s in steps))
    ]
    objects = PoseTracks(len(steps))
    for k, step in enumerate(steps):
        # not strict: a step may log fewer objects than the episode has
        for name, position in zip(names, step.target_object_positions or (), strict=False):
            objects.add(name, k, position, (0.0, 0.0, 0.0, 1.0))
    metrics, more = scalar_columns([s.metrics for s in steps], "metrics.")
    metrics |= logged_outcomes(metrics)
    object_tracks = objects.arrays(path)
    placed, unused = at_goal(log.goal_positions, object_tracks)
    if placed is not None:
        metrics["metrics.at_goal"] = placed
    dt_ns = STEP_NS if fps == 30 else round(1e9 / fps)
    episode = HitlEpisode(
        path=path,
        data=data,
        form="hitl_log",
        episode_id=str(log.episode_id or ""),
        created_by="habitat-lab HITL rearrange",
        dt_ns=dt_ns,
        time_ns=np.arange(len(steps), dtype=np.int64) * dt_ns,
        tracks=tracks,
        object_names=objects.names,
        object_tracks=object_tracks,
        object_of_id={i: f"object_{i}" for i in log.target_obj_ids or ()},
        robot=robot_named_in(json.dumps(log.dataset)),
        joint_order=joint_order,
        columns=metrics | _input_columns(steps),
        events=_events(steps, tracks),
        warnings=[*warnings, *more, *unused],
        info={
            "generation": 1,
            "nominal_fps": fps,
            "start_time": log.start_time,
            "dataset": log.dataset,
            "scene_id": log.scene_id,
            "target_obj_ids": log.target_obj_ids,
            "goal_positions": log.goal_positions,
            **({"goal_objects": list(range(len(object_tracks))), "at_goal_m": AT_GOAL_M} if placed is not None else {}),
            "object_rotations": "not recorded: the identity",
        },
    )
    return episode.recording(find_place(log.scene_id or "", assets, floor_y=episode.floor_y()))


def _log(data: bytes, path: Path) -> Log:
    return decoded(json_of_pickled_log(data, path) if is_pickle(data) else data, Log, path, expected="hitl_log")


# --- agents -----------------------------------------------------------------------------------------------------------
def _tracks(steps: Sequence[Step], path: Path) -> tuple[list[AgentTrack], list[str]]:
    count = max(len(s.agent_states) for s in steps)
    roots = [np.full((len(steps), 7), np.nan) for _ in range(count)]
    ids = [np.full(len(steps), -1, np.int64) for _ in range(count)]
    for k, step in enumerate(steps):
        for i, state in enumerate(step.agent_states):
            roots[i][k] = (*state.position, *state.rotation_xyzw)
            ids[i][k] = -1 if state.grasp_mgr_snap_idx is None else state.grasp_mgr_snap_idx
    roots = [unit_rotations(r, f"agent {i}", path) for i, r in enumerate(roots)]
    actions, warnings = _actions(steps, path)
    people = _people(actions, roots)
    # what is no posture is the action of the robot, if there is one robot only
    rest = np.ones(actions.shape[1], bool)
    for start in people.values():
        rest[start : start + PERSON_VALUES] = False
    others = [i for i in range(count) if i not in people]
    tracks = []
    for i in range(count):
        if i in people:
            part = actions[:, people[i] : people[i] + PERSON_VALUES]
            joints, base = _posture(part)
            tracks.append(AgentTrack(roots=roots[i], grasp_id=ids[i], joints=joints, base=base))
        else:
            mine = actions[:, rest].astype(np.float32) if len(others) == 1 and rest.any() else None
            tracks.append(AgentTrack(roots=roots[i], grasp_id=ids[i], action=mine))
    return tracks, warnings


def _actions(steps: Sequence[Step], path: Path) -> tuple[NDArray[np.float64], list[str]]:
    """Return the action vectors [T, A], NaN where a step has none, and warnings; [T, 0] if no step has one."""
    vectors = [_vector(step.action) for step in steps]
    lengths = [len(v) for v in vectors if v is not None]
    # the most frequent length: some steps log a shorter vector or none
    width = max(set(lengths), key=lengths.count, default=0) if lengths else 0
    out = np.full((len(steps), width), np.nan)
    if len(steps) * width > MAX_TRACK_VALUES:
        raise FormatError(
            f"Actions of {width} values over {len(steps)} steps are more than can be read: {path}",
            code="H3-HABITAT-072",
        )
    for k, vector in enumerate(vectors):
        if vector is not None and len(vector) == width:
            out[k] = np.clip(vector, -1e9, 1e9)
    odd = sum(v is None or len(v) != width for v in vectors)
    return out, [f"{odd} steps have no action vector of {width} values"] if odd else []


def _vector(action: Any) -> list[float] | None:
    """Return the flat numbers of an action: a list, or an object whose arguments hold a person's joints."""
    if isinstance(action, dict):
        args = action.get("action_args")
        found = [v for k, v in args.items() if k.endswith("human_joints_trans")] if isinstance(args, dict) else []
        action = found[0] if found else None
    if not isinstance(action, list) or not all(type(v) in (int, float) and abs(v) < 2**1000 for v in action):
        return None
    return action


def _people(actions: Array, roots: Sequence[Array]) -> dict[int, int]:
    """Return the agents that are people with a posture in the action vector, and where in it the posture begins.

    The vector follows the order of the agents, so a person's part is the first or the last of it.
    """
    found: dict[int, int] = {}
    width, count = actions.shape[1], len(roots)
    for agent, start in ((count - 1, width - PERSON_VALUES), (0, 0)):
        overlaps = any(abs(start - other) < PERSON_VALUES for other in found.values())
        if count and start >= 0 and width >= PERSON_VALUES and agent not in found and not overlaps:
            part = actions[:, start : start + PERSON_VALUES]
            # most rows, as single ones are missing in real logs
            if _is_posture(part).mean() > 0.5:
                found[agent] = start
    if len(found) == 1 and count == 2 and width == PERSON_VALUES:  # no robot's part tells which agent it belongs to
        agent = int(np.argmax([tilt_rad(r) for r in roots]))
        found = {agent: 0}
    return found


def _is_posture(part: Array) -> NDArray[np.bool_]:
    """Return rows [T] of a person's part [T, 248] that are quaternions and two rigid matrices."""
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(part[:, :JOINT_VALUES].reshape(len(part), -1, 4), axis=2)
        base = part[:, -16:].reshape(-1, 4, 4)  # [column, row]
        rigid = np.abs(base[:, :, 3] - (0, 0, 0, 1)).max(1) < 1e-3
        straight = np.abs(np.linalg.norm(base[:, :3, :3], axis=2) - 1).max(1) < 1e-2
        return np.isfinite(part).all(1) & (np.abs(length - 1) < 1e-2).all(1) & rigid & straight


def _posture(part: Array) -> tuple[Array, Array]:
    """Return local rotations [T, 54, 4] and pose7 [T, 7] of the agent root; steps without them keep the last values."""
    part = held(part, _is_posture(part))
    joints = part[:, :JOINT_VALUES].reshape(len(part), -1, 4)
    base = part[:, -16:].reshape(-1, 4, 4)
    # matrices are logged column by column: the first is the x axis, the last the place
    forward, place = base[:, 0, :3], base[:, 3, :3]
    heading = np.arctan2(-forward[:, 2], forward[:, 0])
    return joints / np.linalg.norm(joints, axis=2, keepdims=True), ground_pose(
        place[:, [0, 2]], heading, place[:, 1] - HUMAN_ROOT_HEIGHT_M
    )


# --- input ------------------------------------------------------------------------------------------------------------
_EVENTS = {"grasp_object_id": "pick", "drop_pos": "place"}


def _input_columns(steps: Sequence[Step]) -> dict[str, NDArray[Any]]:
    """Return the columns ``input.user_0.<name>``, float32 [T] or [T, n], NaN where a step lacks it."""
    rows: list[Mapping[str, Any]] = [s.gui_humanoid or {} for s in steps]
    columns, _ = scalar_columns([{k: v for k, v in row.items() if k not in _EVENTS} for row in rows], "input.user_0.")
    vectors: dict[str, NDArray[np.float32]] = {}
    for k, row in enumerate(rows):
        for name, value in row.items():
            if name in _EVENTS or not _numbers(value):
                continue
            key = f"input.user_0.{name}"
            # limits, since the names come from the file
            if key not in vectors and key not in columns and len(vectors) < 32 and 0 < len(value) <= 16:
                vectors[key] = np.full((len(steps), len(value)), np.nan, np.float32)
            if key in vectors and vectors[key].shape[1] == len(value):
                vectors[key][k] = np.clip(value, -MAX_FLOAT, MAX_FLOAT)
    return columns | vectors


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(type(v) in (int, float) and abs(v) < 2**1000 for v in value)


def _events(steps: Sequence[Step], tracks: Sequence[AgentTrack]) -> list[Event]:
    """Return the places at which the person at the keyboard picks and places."""
    person = next((i for i, t in enumerate(tracks) if t.joints is not None), -1)
    events = []
    for k, step in enumerate(steps):
        for key, kind in _EVENTS.items():
            value = (step.gui_humanoid or {}).get(key)
            if value is not None:
                target = f"object_{value}" if kind == "pick" else ""
                events.append(
                    Event(step=k, agent=person, kind=kind, target=target, detail=json.dumps({"user": 0, key: value}))
                )
    return events
