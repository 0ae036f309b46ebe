"""Recognition of the agents of a gfx-replay by the names of its asset files, as the format does not name them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_robot, robot_names
from h3data.bodies.people.skeleton import HUMAN_ROOT_HEIGHT_M
from h3data.geometry import IDENTITY_POSE, ground_pose, quat_rotate, quat_sign_continuous
from h3data.recording.records import Agent, AssetRef, Body
from h3data_habitat.gfx.fold import Life
from h3data_habitat.limits import MAX_AGENTS, check_count, check_size

ROBOT_BASE_HEIGHT_M = {"spot": 0.48, "fetch": 0.0}
"""Height of a robot's base link over the floor [m], habitat-lab's ``base_offset`` (spec/habitat.md 0). h3data's robots
state theirs in exports; for the rest 0 is assumed."""

PERSON_ROOT_PREFIX = "h3data_person_root_"
"""Prefix of user transforms in h3data's exports, before the number of a rig: habitat-lab's root of that person. The
instance of a rig has the pose of its root bone, which also sways and tilts."""

_ROBOT = re.compile(r"(^|/)robots?/([^/]+)/|(hab_spot_arm|hab_fetch|hab_stretch)")
_HUMAN = re.compile(r"(^|/)(humanoids?|humanoid_data)/|(^|/)(human|male|female|neutral)(_\w+)?\.\w+$")
_BASE_STEMS = {"base", "base_link", "body", "link_0", "link0"}

Kind = Literal["robot", "human"]


@dataclass(frozen=True)
class AgentInfo:
    """Recognised agent of a gfx-replay, whose ``record`` becomes part of the episode's info."""

    record: dict[str, Any]
    warnings: list[str] = field(default_factory=list)


@dataclass
class _Group:
    kind: Kind
    model: str
    bodies: list[int]


def add_agents(
    bodies: Sequence[Body],
    assets: Sequence[AssetRef],
    object_pose: NDArray[np.float32] | None,
    steps: int,
    path: Path,
    *,
    roots: Mapping[str, NDArray[np.float32]] | None = None,
) -> tuple[list[Agent], list[Body], dict[str, NDArray[Any]], list[AgentInfo]]:
    """Find the agents of a session, robots first, with their bodies, columns and the method of recognition.

    A robot is a run of bodies in the order of creation whose files lie in the same robot folder; a new run begins
    where a base link appears again. A person is one body with a humanoid's file. ``agent_<i>.base_pose`` follows
    habitat-lab (spec/habitat.md 0): a robot stands ``ROBOT_BASE_HEIGHT_M`` under its base link and faces along that
    link's x axis; a person stands `HUMAN_ROOT_HEIGHT_M` under the root and faces along its z axis. Both headings are
    projected on the floor. ``path`` appears in error texts. ``roots`` holds the roots of people (pose7 [T, 7] by body) that
    the file tells apart from their instances (`PERSON_ROOT_PREFIX`).
    """
    uris = {ref.name: ref.uri for ref in assets}
    groups = _groups([uris[b.asset] for b in bodies])
    check_count(len(groups), MAX_AGENTS, "robots and people", path)
    check_size(steps, len(groups), path)
    groups.sort(key=lambda g: g.kind != "robot")  # stable: robots first, each kind in the order of creation
    bodies = list(bodies)
    agents, infos = [], []
    columns: dict[str, NDArray[Any]] = {}
    names = agent_names([group.kind for group in groups])
    for index, (name, group) in enumerate(zip(names, groups, strict=True)):
        root, info = _root(group, [uris[bodies[b].asset] for b in group.bodies], bodies)
        track = (roots or {}).get(bodies[root].name)
        track = _track(bodies[root], object_pose, steps) if track is None else track.astype(np.float64)
        height, forward = _base_height(group.model) or 0.0, 0
        if group.kind == "human":
            height, forward = HUMAN_ROOT_HEIGHT_M, 2
        columns[f"agent_{index}.base_pose"] = _base_pose(track, forward=forward, height=height)
        agents.append(Agent(name=name, kind=group.kind, semantic_id=bodies[root].semantic_id))
        infos.append(AgentInfo({"name": name, "base_height_m": height, **info.record}, info.warnings))
        for b in group.bodies:
            bodies[b] = replace(bodies[b], agent=index)
    # of one robot and one person the distance is what their metrics read
    if [g.kind for g in groups] == ["robot", "human"]:
        robot, human = (columns[f"agent_{i}.base_pose"][:, :3].astype(np.float64) for i in (0, 1))
        columns["metrics.dist_agents"] = np.linalg.norm(robot - human, axis=1).astype(np.float32)
    return agents, bodies, columns, infos


def agent_names(kinds: Sequence[Kind]) -> list[str]:
    """Return the names of agents: their kinds, numbered from 0 where there are several of a kind."""
    return [kind if kinds.count(kind) == 1 else f"{kind}_{kinds[:k].count(kind)}" for k, kind in enumerate(kinds)]


def person_roots(
    lives: Sequence[Life], bodies: Sequence[Body], columns: dict[str, NDArray[Any]]
) -> dict[str, NDArray[np.float32]]:
    """Return the roots of people [T, 7] by the name of their body, and remove their user transforms from the columns."""
    roots = {}
    for life, body in zip(lives, bodies, strict=True):
        track = columns.get(f"user.{PERSON_ROOT_PREFIX}{life.creation.rigId}")
        if track is not None:
            # rigs are numbered anew, so a number may belong to another person before and after
            there = np.arange(len(track)) >= life.start
            there &= (np.arange(len(track)) < life.end) | (life.end < 0)
            roots[body.name] = np.where(there[:, None], track, np.float32(np.nan))
    # none is left over: such transforms are roots of people, and no cameras
    for name in [name for name in columns if name.startswith(f"user.{PERSON_ROOT_PREFIX}")]:
        del columns[name]
    return roots


def robot_model(uri: str) -> str | None:
    """Return the robot's folder name, e.g. ``hab_spot_arm``, if a recorded path is a robot link."""
    match = _ROBOT.search(uri)
    return (match.group(2) or match.group(3)) if match else None


def is_humanoid(uri: str) -> bool:
    """Return whether a recorded path is a humanoid's mesh."""
    return _HUMAN.search(uri) is not None


def _groups(uris: Sequence[str]) -> list[_Group]:
    groups: list[_Group] = []
    running: _Group | None = None
    for index, uri in enumerate(uris):
        # a person is one skinned body, and ends the run of a robot's links
        if is_humanoid(uri):
            groups.append(_Group("human", PurePosixPath(uri).stem, [index]))
            running = None
            continue
        model = robot_model(uri)
        if model is None:
            running = None
            continue
        if (
            running is None
            or running.model != model
            or (_is_base(uri) and any(_is_base(uris[b]) for b in running.bodies))
        ):
            running = _Group("robot", model, [])
            groups.append(running)
        running.bodies.append(index)
    return groups


def _is_base(uri: str) -> bool:
    return PurePosixPath(uri).stem.lower() in _BASE_STEMS


def _base_height(model: str) -> float | None:
    """Return the height of a robot's base link over the floor [m]; None if unknown."""
    if model in robot_names():
        robot = load_robot(model)
        return float(robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0, 0, 1, 3])
    return next((height for name, height in ROBOT_BASE_HEIGHT_M.items() if name in model.lower()), None)


def _root(group: _Group, uris: Sequence[str], bodies: Sequence[Body]) -> tuple[int, AgentInfo]:
    """Return the index of the body that carries the agent's frame."""
    record: dict[str, Any] = {"kind": group.kind, "found_as": group.model, "bodies": len(group.bodies)}
    warnings = []
    # links come in any order; without a base link the first one is the best guess
    position = next((i for i, uri in enumerate(uris) if _is_base(uri)), 0)
    if group.kind == "robot":
        if not _is_base(uris[position]):
            warnings.append(
                f"robot {group.model} has no link called base: {bodies[group.bodies[0]].name} is taken as its base"
            )
        if _base_height(group.model) is None:
            warnings.append(f"robot {group.model}: its base link is taken to be at the floor")
    root = group.bodies[position]
    return root, AgentInfo({**record, "root_body": bodies[root].name}, warnings)


def _track(body: Body, object_pose: NDArray[np.float32] | None, steps: int) -> NDArray[np.float64]:
    if body.moving >= 0 and object_pose is not None:
        return object_pose[:, body.moving].astype(np.float64)
    return np.broadcast_to(body.pose.astype(np.float64), (steps, 7))


def _base_pose(track: NDArray[np.float64], *, forward: Literal[0, 2], height: float) -> NDArray[np.float32]:
    """Return pose7 [T, 7] on the floor under nodes [T, 7] that face along their axis ``forward`` (0 = x, 2 = z)."""
    direction = quat_rotate(track[:, 3:], np.eye(3)[forward])
    heading = np.arctan2(-direction[:, 2], direction[:, 0])
    pose = ground_pose(track[:, [0, 2]], heading, track[:, 1] - height)
    # q and -q are one rotation, and viewers interpolate between rows
    pose[:, 3:] = quat_sign_continuous(pose[:, 3:])
    pose[np.isnan(track).any(1)] = np.nan
    return pose.astype(np.float32)
