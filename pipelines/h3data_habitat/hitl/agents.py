"""Distinction and posing of robots and people in a HITL log, which holds only the roots of their bodies.

Frames of the logged roots (spec/habitat.md 0): a robot's has x forward, y up, z right and is its base link; a person's is
the SMPL-X pelvis with z forward, y up, x left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_humanoid, load_robot
from h3data.bodies.people.skeleton import HUMAN_ROOT_HEIGHT_M, JOINT_NAMES
from h3data.geometry import Array, ground_pose, quat_rotate, quat_sign_continuous
from h3data.recording.records import Agent
from h3data_habitat.gfx.agents import agent_names
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS
from h3data_motion.walk_synthesis import (
    SYNTHETIC_BODY,
    fitting_body,
    floor_below,
    walk_columns,
)

AgentKind = Literal["robot", "human"]
JointOrder = Literal["habitat", "smplx"]

LEVEL_RAD = 2e-3
"""Tilt above which a root cannot belong to a robot, whose base only rotates about the vertical axis [rad]."""
_ROBOTS = {"spot": ("quad_arm", 0.48), "fetch": ("lift_arm", 0.0), "stretch": ("lift_arm", 0.0)}
"""Built-in model that stands in for each of Habitat's robots, and the height of its base link over the floor [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AgentTrack:
    """Track of one agent in a log."""

    roots: NDArray[np.float64]
    """Pose (pose7) of the root in the world, shape [T, 7]; NaN where the log has none."""
    grasp_id: NDArray[np.int64]
    """Id of the held object, -1 = none, shape [T]."""
    joints: Array | None = None
    """Local rotations [T, 54, 4] as logged, any joint order, of people with a logged posture."""
    base: Array | None = None
    """Pose (pose7) of the agent root at the floor, shape [T, 7], of people with a logged posture."""
    action: NDArray[np.float32] | None = None
    """Low-level action, shape [T, A]."""


def tilt_rad(roots: Array) -> float:
    """Return the median angle between the y axes of roots [T, 7] and the vertical; 0 without any finite root."""
    known = roots[np.isfinite(roots).all(1)]
    if not len(known):
        return 0.0
    up = quat_rotate(known[:, 3:], np.array([0.0, 1.0, 0.0]))
    return float(np.median(np.arctan2(np.hypot(up[:, 0], up[:, 2]), up[:, 1])))


def agent_kinds(tracks: Sequence[AgentTrack]) -> list[AgentKind]:
    """Return the kind of each agent: a posture or a tilted root makes a person (`LEVEL_RAD`)."""
    return ["human" if t.joints is not None or tilt_rad(t.roots) > LEVEL_RAD else "robot" for t in tracks]


def robot_named_in(*texts: str) -> str:
    """Return the first of Habitat's robots that a text names; Spot, the robot of Habitat 3.0, if it names none."""
    joined = " ".join(texts).lower()
    # the first one named is that of the configuration; others stand in lists of options
    found = [(joined.find(name), name) for name in _ROBOTS if name in joined]
    return min(found)[1] if found else "spot"


def root_height_m(kind: AgentKind, robot: str) -> float:
    """Return the height of the logged root over the floor [m]."""
    return HUMAN_ROOT_HEIGHT_M if kind == "human" else _ROBOTS[robot][1]


def add_agents(
    tracks: Sequence[AgentTrack],
    kinds: Sequence[AgentKind],
    time_ns: NDArray[np.int64],
    *,
    robot: str,
    joint_order: JointOrder | None = None,
) -> tuple[list[Agent], dict[str, NDArray[Any]], list[dict[str, Any]]]:
    """Find the agents of a session, with columns, and notes on recorded and assumed parts.

    Robots are shown by a built-in model in its resting posture. People with a logged posture keep it, on the built-in
    body whose feet come nearest to the floor with it; for the others a walk is synthesised from the path of their root.
    """
    agents: list[Agent] = []
    columns: dict[str, NDArray[Any]] = {}
    notes: list[dict[str, Any]] = []
    floors = [t.roots[:, 1] - _ROBOTS[robot][1] for t, kind in zip(tracks, kinds, strict=True) if kind == "robot"]
    for index, (name, track, kind) in enumerate(zip(agent_names(kinds), tracks, kinds, strict=True)):
        if kind == "robot":
            agent, more, note = _robot(name, track, robot)
        elif track.joints is not None and track.base is not None:
            agent, more, note = _posed_person(name, track, joint_order or infer_joint_order(track.joints))
        else:
            agent, more, note = _walking_person(name, track, time_ns, floors[0] if floors else None)
        if track.action is not None:
            more["action"] = track.action
        agents.append(agent)
        notes.append({"name": name, "kind": kind, **note})
        columns |= {f"agent_{index}.{key}": value for key, value in more.items()}
    if list(kinds) in (["robot", "human"], ["human", "robot"]):
        a, b = (columns[f"agent_{i}.base_pose"][:, :3].astype(np.float64) for i in (0, 1))
        columns["metrics.dist_agents"] = np.linalg.norm(a - b, axis=1).astype(np.float32)
    return agents, columns, notes


# --- robots -----------------------------------------------------------------------------------------------------------
def _robot(name: str, track: AgentTrack, robot: str) -> tuple[Agent, dict[str, NDArray[Any]], dict[str, Any]]:
    model, height = _ROBOTS[robot]
    body = load_robot(model)
    base = _on_floor(track.roots, forward=0, floor=track.roots[:, 1] - height)
    columns: dict[str, NDArray[Any]] = {
        "base_pose": base,
        "joint_pos": np.tile(body.rest.astype(np.float32), (len(base), 1)),
    }
    agent = Agent(name=name, kind="robot", model=f"robot/{model}", semantic_id=200, joint_names=tuple(body.joint_names))
    note = {"taken_for": robot, "base_height_m": height, "recorded": ["base"], "synthesised": ["joint_pos"]}
    return agent, columns, note


# --- people -----------------------------------------------------------------------------------------------------------
def infer_joint_order(joints: Array) -> JointOrder:
    """Return the order of joints [T, 54, 4]: depth first, as in the URDFs of Habitat's people, or that of SMPL-X.

    The file does not specify the order. All rotations are relative to the T-pose, so that in the right order the
    shoulders are rotated strongly (arms hang down), and jaw and eyes hardly.
    """
    # of rotations in either sign, over time: single postures may bend anything
    angles = np.median(2 * np.arccos(np.clip(np.abs(joints[..., 3]), 0, 1)), axis=0) if len(joints) else np.zeros(54)

    def fit(names: Sequence[str]) -> float:
        at = {name: k for k, name in enumerate(names)}
        shoulders = min(angles[at["left_shoulder"]], angles[at["right_shoulder"]])
        return float(shoulders - max(angles[at[n]] for n in ("jaw", "left_eye_smplhf", "right_eye_smplhf")))

    return "smplx" if fit(JOINT_NAMES[1:]) > fit(HABITAT_JOINTS) else "habitat"


def _posed_person(
    name: str, track: AgentTrack, order: JointOrder
) -> tuple[Agent, dict[str, NDArray[Any]], dict[str, Any]]:
    assert track.joints is not None
    assert track.base is not None
    joints = track.joints
    if order == "habitat":
        joints = joints[:, [HABITAT_JOINTS.index(joint) for joint in JOINT_NAMES[1:]]]
    joints = quat_sign_continuous(joints)
    body = fitting_body(track.roots, joints, track.base[:, 1])
    columns: dict[str, NDArray[Any]] = {
        "base_pose": _continuous(track.base),
        "root_pose": _continuous(track.roots),
        "joint_quat": joints.astype(np.float32),
    }
    note = {"joint_order": order, "recorded": ["base", "root", "joints"], "synthesised": ["body"]}
    return Agent(name=name, kind="human", model=f"humanoid/{body}", semantic_id=100), columns, note


def _walking_person(
    name: str, track: AgentTrack, time_ns: NDArray[np.int64], robot_floor: Array | None
) -> tuple[Agent, dict[str, NDArray[Any]], dict[str, Any]]:
    body = load_humanoid(SYNTHETIC_BODY)
    base = _on_floor(track.roots, forward=2, floor=floor_below(track.roots[:, 1], robot_floor))
    columns: dict[str, NDArray[Any]] = {"base_pose": base, "root_pose": _continuous(track.roots)}
    columns |= walk_columns(body, base.astype(np.float64), time_ns)
    agent = Agent(
        name=name, kind="human", model=f"humanoid/{SYNTHETIC_BODY}", semantic_id=100, motion_names=body.motion_names
    )
    return agent, columns, {"recorded": ["root"], "synthesised": ["body", "floor", "joints"]}


def _on_floor(roots: Array, *, forward: Literal[0, 2], floor: Array) -> NDArray[np.float32]:
    """Return pose7 [T, 7] of agent roots on the floor below roots [T, 7] that face along their axis ``forward``."""
    direction = quat_rotate(roots[:, 3:], np.eye(3)[forward])
    heading = np.arctan2(-direction[:, 2], direction[:, 0])
    return _continuous(ground_pose(roots[:, [0, 2]], heading, floor))


def _continuous(poses: Array) -> NDArray[np.float32]:
    out = poses.copy()
    known = np.isfinite(out).all(1)
    # signs are followed over gaps, in which there is nothing to compare with
    out[known, 3:] = quat_sign_continuous(out[known, 3:])
    out[~known] = np.nan
    return out.astype(np.float32)
