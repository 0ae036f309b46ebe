"""Files that the page loads once for each home and set of agents.

They are a GLB of the home and the agents, a manifest that maps states to its parts, and the distance grid with which
the page predicts the player's own walk.
"""

from __future__ import annotations

import base64
import hashlib
import tempfile
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from h3data.bodies import Robot
from h3data.recording import RecordingHeader
from h3data.replay import Replay
from h3data.replay.rigs import joint_rigs, robot_rig
from h3data.scene import FreeSpace
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.posing import posed_parts
from h3data_play.app import App
from h3data_play.drivers import acts_of, driving_base
from h3data_play.messages import PERIOD_S
from h3data_play.plan import VERSION
from h3data_play.wire import BODY_JOINTS
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.recorder import finished
from sim_kinematic.tasks.sessions import Session

GRID_UNIT_M = 1e-3
"""Unit to which distances of the grid are rounded [m]."""


def world_glb(session: Session) -> bytes:
    """Return a GLB of the home, with robots as links and people as skins, in the pose after one step without commands."""
    names = {member.name: External() for member in session.episode.roster}
    still = Session(session.task, session.episode, names)
    still.step()
    header: RecordingHeader = still.recorder.header
    recording = finished(header, still.recorder.columns(), {}, (), ())
    # the uid of the episode is left out, so that equal worlds have equal files
    recording = _anonymous(recording)
    with tempfile.TemporaryDirectory(prefix="h3data-") as folder:
        path = Path(folder, "world.glb")
        write_gltf_animation(recording, posed_parts(Replay(recording, detail=False)), path)
        return path.read_bytes()


def _anonymous(recording: Any) -> Any:
    from dataclasses import replace

    return replace(recording, episode=replace(recording.episode, uid="", episode_id=""))


def distance_grid(session: Session) -> tuple[bytes, dict[str, Any]]:
    """Return the distances to the nearest obstacle as int16 [nx, nz], and their entry in the manifest."""
    data, entry = _grid(session.episode.free)
    return data, {**entry, "url": f"world/{digest(data)}.sdf"}


def floor_message(free: FreeSpace) -> dict[str, Any]:
    """Return the message that sends a changed distance grid to pages, with its cells as Base64 of zlib data."""
    data, entry = _grid(free)
    return {**entry, "cells": base64.b64encode(zlib.compress(data, 6)).decode()}


def _grid(free: FreeSpace) -> tuple[bytes, dict[str, Any]]:
    cells = np.clip(np.rint(np.nan_to_num(free.sdf, posinf=1e3, neginf=-1e3) / GRID_UNIT_M), -32767, 32767)
    return cells.astype("<i2").tobytes(), {
        "type": "int16",
        "unit": GRID_UNIT_M,
        "shape": list(free.sdf.shape),
        "origin": np.asarray(free.origin, np.float64).round(9).tolist(),
        "cell": float(free.cell_m),
    }


def manifest(session: Session, app: App, sdf: dict[str, Any]) -> dict[str, Any]:
    """Return the manifest with names, rigs and rules of motion of a session.

    Its entry ``me`` is -1, which the front process replaces by the number of the player's agent.
    """
    header, episode = session.recorder.header, session.episode
    names = [name for _, name in sorted((body.moving, body.name) for body in header.bodies if body.moving >= 0)]
    # things of chores, which come after the objects of the task and are no objects to pick
    brought = {thing.name for thing in session.play.things} if session.task.control.has_skills else set()
    agents = []
    for k, member in enumerate(episode.roster):
        agent: dict[str, Any] = {"name": member.name, "kind": member.kind, "drive": _drive(driving_base(session, k))}
        agent["drive"]["solid"] = member.kind == "human" and getattr(episode.spec, "solid_agents", False)
        if isinstance(member.body, Robot):
            agent |= robot_rig(member.body)
        else:
            agent |= {"bones": list(member.body.joint_names[: BODY_JOINTS + 1]), "acts": list(acts_of(session, k))}
        agents.append(agent)
    return {
        "version": VERSION,
        "me": -1,
        "agents": agents,
        "objects": [{"name": name, "label": app.label(name)} for name in names if name not in brought],
        "brought": [{"name": name} for name in names if name in brought],
        "goals": [asdict(goal) for goal in app.goals()],
        "joints": _joints(session, app, set(names)),
        "phrases": [phrase._asdict() for phrase in app.phrases()],
        "spots": [spot._asdict() for spot in app.spots()],
        "asks": bool(app.question),
        "names": app.names,
        "floor_y": float(episode.free.floor_y),
        "heights": episode.free.heights.round(6).tolist(),
        "dt": PERIOD_S,
        "sdf": sdf,
    }


def _joints(session: Session, app: App, movable: set[str]) -> list[dict[str, Any]]:
    """Return the doors and drawers, where the task has any that move."""
    openables = getattr(session.play.team, "openables", None)
    if openables is None:
        return []
    return [
        {**rig, "label": app.joint_label(rig["name"]), "passage": k in openables.doors}
        for k, rig in enumerate(joint_rigs(session.episode.scene, movable=movable))
    ]


def digest(data: bytes) -> str:
    """Return the file name for some content: its digest."""
    return hashlib.sha256(data).hexdigest()[:20]


def _drive(base: BaseSpec) -> dict[str, Any]:
    farthest = base.farthest_m(PERIOD_S)
    return {
        "speed": base.max_speed_mps,
        "turn": base.max_turn_rad_s,
        "lateral": base.max_lateral_mps,
        "backwards": base.allow_back,
        "offsets": list(base.disc_offsets_m),
        "radius": base.disc_radius_m,
        "iterations": base.slide_iterations,
        "tolerance": base.clearance_tolerance_m,
        "farthest": farthest if np.isfinite(farthest) else None,
    }
