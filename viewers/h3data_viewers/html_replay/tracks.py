"""Motion of all bodies and objects in an HTML replay, in the form that the page uses.

Robots, doors and drawers are posed by joints, people by bones, and everything else by poses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.bodies.people.skeleton import HALF_JOINTS
from h3data.geometry import Array, heading_from_quat, quat_sign_continuous
from h3data.progress import progress
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.replay.rigs import joint_rigs, robot_rig
from h3data.scene.articulation import posed
from h3data_exporters.gltf_skin import local_poses
from h3data_exporters.posed_parts import PosedPart
from h3data_viewers.html_replay.packing import Payload

POSITION_M, HEADING_RAD, JOINT, ROTATION = 5e-4, 5e-4, 2e-4, 1e-3
"""Resolution of stored positions [m], headings [rad], joints [rad or m] and components of quaternions. Live play has
the same resolution of joints, and steps of 1.4e-3 for rotations."""
_STILL = 1e-4
"""Least change of a coordinate of a pose by which a thing or a bone counts as moving."""


def add_tracks(payload: Payload, replay: Replay, parts: list[PosedPart], rows: NDArray[np.integer]) -> dict[str, Any]:
    """Add the states of a recording at ``rows``, and return the agents, objects and joints for the page's manifest.

    ``parts`` are posed at ``rows`` (`h3data_exporters.posing.posed_parts`).
    """
    agents = [_agent(payload, replay, parts, k, rows) for k in range(len(replay.recording.agents))]
    joints = _joints(payload, replay, rows)
    turned = {name for joint in joints for name in joint["nodes"]}
    rigged = {f"{agent['name']}/{link['name']}" for agent in agents for link in agent.get("links", ())}
    things: list[dict[str, Any]] = []
    for part in progress(parts, desc="write tracks", unit="thing", delay=1.0, leave=False):
        # doors follow their joints, robots and people the tracks of their agent
        posed_elsewhere = part.body is None and (part.skeleton is not None or part.name in rigged)
        if not len(part.mesh.faces) or part.name in turned or posed_elsewhere:
            continue
        if part.skeleton is not None:
            for joint, name in enumerate(part.skeleton.names):
                _add_thing(payload, things, f"{part.name}/{name}", part.skeleton.poses[:, joint])
        elif len(part.poses) > 1:
            _add_thing(payload, things, part.name, part.poses)
    return {"agents": agents, "objects": things, "joints": joints}


def _joints(payload: Payload, replay: Replay, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    """Add the positions of doors and drawers; return their rigs, at rest where the first row, and so the home, has them."""
    recording = replay.recording
    positions = recording.columns.get(JOINTS)
    if replay.scene is None or positions is None or not positions.shape[1] or not np.isfinite(positions[rows]).all():
        return []
    payload.add_array("joints", positions[rows], JOINT)
    movable = {body.name for body in recording.bodies if body.moving >= 0}
    # the home's GLB has the pose of the first row, so the page turns doors from there
    return joint_rigs(posed(replay.scene, positions[rows[0]]), movable=movable)


def _add_thing(payload: Payload, things: list[dict[str, Any]], name: str, poses: Array) -> None:
    moves = float(np.ptp(poses, axis=0).max()) > _STILL if np.isfinite(poses).all() else True
    track = _add_poses(payload, f"thing_{len(things)}", poses) if moves else ""
    if track:
        things.append({"name": name, "track": track})


def _agent(
    payload: Payload, replay: Replay, parts: list[PosedPart], k: int, rows: NDArray[np.integer]
) -> dict[str, Any]:
    agent = replay.recording.agents[k]
    pose = replay.recording.agent_column(k, "base_pose")[rows].astype(np.float64)
    payload.add_array(f"agent_{k}.base", pose[:, :3], POSITION_M)
    heading = np.array(heading_from_quat(pose[:, 3:]), np.float64)
    known = np.isfinite(heading)
    # the page goes straight from one row to the next: a jump of 2 pi would spin the agent once around
    heading[known] = np.unwrap(heading[known])
    payload.add_array(f"agent_{k}.heading", heading, HEADING_RAD)
    # heights [m] at which names hang above the agents
    entry: dict[str, Any] = {
        "name": agent.name,
        "kind": agent.kind,
        "height": {"robot": 0.95, "human": 1.95}[agent.kind],
    }
    model = replay.model(k) if agent.model else None
    if isinstance(model, Robot):
        payload.add_array(f"agent_{k}.joints", replay.robot_joints(k, model)[rows], JOINT)
        return {**entry, **robot_rig(model)}
    skin = next((p for p in parts if p.agent == k and p.body is None and p.skeleton is not None), None)
    if skin is None or skin.skeleton is None:
        return entry
    local = local_poses(np.nan_to_num(skin.skeleton.poses), skin.skeleton.parents)
    # q and -q are one rotation; the page interpolates components, which must not change their sign between rows
    local[..., 3:] = quat_sign_continuous(local[..., 3:])
    there = np.isfinite(skin.skeleton.poses).all((1, 2))
    local[~there] = np.nan
    varied = np.ptp(local[there, :, 3:], axis=0).max(-1) > _STILL if there.any() else np.zeros(local.shape[1], np.bool_)
    # bones that never bend keep the pose that the home's GLB gives them, and the page turns half joints by their joints
    bent = [j for j, name in enumerate(skin.skeleton.names) if j and varied[j] and name not in HALF_JOINTS]
    _add_poses(payload, f"agent_{k}.root", local[:, 0])
    payload.add_array(f"agent_{k}.quats", local[:, bent, 3:].reshape(len(local), -1), ROTATION)
    return {**entry, "bones": [skin.skeleton.names[j] for j in (0, *bent)]}


def _add_poses(payload: Payload, name: str, poses: Array) -> str:
    """Add pose7 [T, 7] as two arrays: ``<name>.position`` and ``<name>.rotation``."""
    payload.add_array(f"{name}.position", poses[:, :3], POSITION_M)
    payload.add_array(f"{name}.rotation", quat_sign_continuous(np.asarray(poses[:, 3:], np.float64)), ROTATION)
    return name
