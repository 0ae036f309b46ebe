"""Detection of faults of a recording in columns, time, values, rotations, hash, jumps, feet, walls and asset files.

Errors never occur in a valid recording. Warnings may occur in one, but its user should know about them: a teleport, a
sliding foot, or an asset that was not found.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from shapely import intersects, linestrings, union_all

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.planted_gait import pose_planted
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.bodies.people.soles import LEG_JOINTS, runs, sole_points
from h3data.errors import H3DataError
from h3data.recording import Agent, AssetRef, Body, Recording, state_hash
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.records import JOINTS
from h3data.replay.posed_recording import PosedRecording
from h3data.scene import FreeSpace, Scene, load_scene
from h3data.scene.articulation import joints_of
from h3data.scene.floor_heights import floor_heights
from h3data.scene.passages import outlines, passages

Check = Literal[
    "unreadable", "schema", "time", "values", "quaternions", "hash", "jumps", "penetration", "feet", "assets", "video"
]
Severity = Literal["error", "warning"]

GAP_STEPS = 1.5
"""Duration above which a step counts as a gap, in multiples of the usual step."""
UNIT_WARNING, UNIT_ERROR = 1e-3, 1e-2
"""Limits of a quaternion's deviation from unit length; files that round to five digits are off by 1e-5."""
AGENT_MPS, OBJECT_MPS = 10.0, 25.0
"""Largest plausible speeds of agents and carried objects [m/s]; anything faster was teleported."""
TURN_RAD, JOINT_RAD = 2.1, 1.6
"""Largest rotation of an object or agent, and of a joint, from one step to the next [rad]."""
LIMIT_SLACK = 1e-4
"""Tolerated distance of a door or drawer from the limits of its joint [rad or m]."""
WALL_M = 0.02
"""Tolerated depth of an agent's root inside an obstacle: the error of the distance grid [m]."""
APART_M = 0.15
"""Distance between the roots of two agents below which they count as overlapping [m]."""
SINK_M = 0.05
"""Depth of the soles below the height of the root above which they count as being in the floor [m]."""
LOW_M, SLIDE_MPS, SLIDE_S, SLIDE_SHARE = 0.02, 0.3, 0.15, 0.10
"""Limits for sliding feet. Feet within LOW_M [m] of the floor can carry the body. They slide if all of them are faster
than SLIDE_MPS [m/s] for at least SLIDE_S [s]; shorter times occur when a foot lands or in the flight phase of a jog.
Sliding is reported if it occurs in at least SLIDE_SHARE of the steps.
"""
_FEET_CHUNK = 512
_SCENES_KEPT = 8

_AGENT = re.compile(r"agent_(\d+)\.(\w+)$")
_POSES = ("base_pose", "root_pose")
_HEAD = JOINT_INDEX["head"]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Fault in a recording."""

    check: Check
    severity: Severity
    subject: str
    """Name of the column, body, agent or file."""
    text: str
    """Description of the fault, with numbers."""
    step: int = -1
    """First step with the fault; -1 = not tied to a step."""
    count: int = 1
    """Number of steps with the fault."""

    def __str__(self) -> str:
        step = f", step {self.step}" if self.step >= 0 else ""
        count = f" ({self.count} steps)" if self.count > 1 else ""
        return f"{self.severity:<7} {self.check:<11} {self.subject}{step}: {self.text}{count}"


def validate_recording(recording: Recording, *, assets: AssetLibrary | None = None) -> list[Finding]:
    """Return all faults of a recording, errors first; a recording without errors is valid.

    ``assets`` is the library in which the files of imported recordings are searched.
    """
    with np.errstate(all="ignore"):  # invalid values, which are what is searched for
        findings = [*_schema(recording), *_time(recording), *_values(recording), *_hash(recording)]
        if not any(f.severity == "error" and f.check in ("schema", "values") for f in findings):  # else it has no poses
            findings += [*_jumps(recording), *_posed(recording, assets or AssetLibrary())]
    return sorted(findings, key=lambda f: f.severity != "error")


# --- names and types --------------------------------------------------------------------------------------------------
def _schema(rec: Recording) -> Iterator[Finding]:
    wrong = partial(_error, "schema")
    moving = len(rec.moving_bodies)
    for name, kind, shape in (("object_pose", "float32", (moving, 7)), ("state_hash", "uint64", ())):
        if name in rec.columns and not _is(rec.columns[name], kind, shape):
            yield wrong(name, _expected(rec.columns[name], kind, shape))
    yield from _joints(rec)
    for name, array in rec.columns.items():
        match = _AGENT.match(name)
        if match is None:
            continue
        if int(match[1]) >= len(rec.agents):
            yield wrong(name, f"refers to agent {match[1]}, but there are {len(rec.agents)} agents")
            continue
        agent = rec.agents[int(match[1])]
        kind, shape, limits = _KINDS.get(match[2], (array.dtype, array.shape[1:], None))
        names = {"joint_pos": agent.joint_names, "action": agent.action_names}.get(match[2], ())
        shape = (len(names),) if names else shape
        of = {"grasp_body": rec.bodies, "skill": agent.skill_names, "motion_id": agent.motion_names}.get(match[2])
        limits = limits if of is None else (-1, len(of) - 1)
        if not _is(array, kind, shape):
            yield wrong(name, _expected(array, kind, shape))
        elif limits is not None and len(array) and (outside := (array < limits[0]) | (array > limits[1])).any():
            yield wrong(name, f"{array[np.argmax(outside)]} is not in {limits[0]}..{limits[1]}", at=outside)
    numbers = [array for body in rec.bodies for array in (body.pose, body.scale)]
    finite = not numbers or np.isfinite(np.concatenate(numbers)).all()  # of all bodies at once: there are a hundred
    for body in rec.bodies:
        if not finite and not (np.isfinite(body.scale).all() and (np.isfinite(body.pose).all() or body.moving >= 0)):
            yield wrong(body.name, f"pose {body.pose.tolist()} and scale {body.scale.tolist()} must be finite")
        if not -1 <= body.agent < len(rec.agents):
            yield wrong(body.name, f"belongs to agent {body.agent}, but there are {len(rec.agents)} agents")
    last = len(rec) - 1
    for event in rec.events:
        if not (0 <= event.step <= last and -1 <= event.agent < len(rec.agents)):
            yield wrong(f"event {event.kind}", f"step {event.step} of agent {event.agent} is not in this recording")
    for event in rec.inputs:
        if event.payload and not _is_json(event.payload):
            yield wrong(f"input {event.kind}", f"expected a JSON payload, got {event.payload[:40]!r}")
    for span in rec.skills:
        if not (0 <= span.start_step <= span.end_step <= last and 0 <= span.agent < len(rec.agents)):
            yield wrong(
                f"skill {span.name}",
                f"steps {span.start_step} to {span.end_step} of agent {span.agent} are not in this recording",
            )


def _joints(rec: Recording) -> Iterator[Finding]:
    """Yield findings about positions of doors and drawers that do not fit the attached scene."""
    array = rec.columns.get(JOINTS)
    if array is None:
        return
    if "scene.glb" not in rec.attachments:
        yield _error("schema", JOINTS, "there is no attached scene whose joints these are")
        return
    try:
        joints = joints_of(_scene_of(bytes(rec.attachments["scene.glb"])))
    except H3DataError:
        return  # reported where the scene is
    if not _is(array, "float32", (len(joints),)):
        yield _error("schema", JOINTS, _expected(array, "float32", (len(joints),)))
        return
    low, high = (np.array([getattr(part.joint, side) for _, part in joints.parts]) for side in ("lower", "upper"))
    beyond = (array < low - LIMIT_SLACK) | (array > high + LIMIT_SLACK)
    for k in np.flatnonzero(beyond.any(0)).tolist():
        text = f"{array[np.argmax(beyond[:, k]), k]:.3f} is beyond its limits {low[k]:.3f} to {high[k]:.3f}"
        yield _warning("values", joints.names[k], text, at=beyond[:, k])


def _is_json(text: str) -> bool:
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


_POSE: tuple[DTypeLike, tuple[int | None, ...], None] = (np.dtype("float32"), (7,), None)
_KINDS: dict[str, tuple[DTypeLike, tuple[int | None, ...], tuple[float, float] | None]] = {
    "base_pose": _POSE,
    "root_pose": _POSE,
    "joint_quat": (np.dtype("float32"), (54, 4), None),
    "joint_pos": (np.dtype("float32"), (None,), None),
    "action": (np.dtype("float32"), (None,), None),
    "grasp_body": (np.dtype("int32"), (), None),
    "skill": (np.dtype("int32"), (), None),
    "motion_id": (np.dtype("int32"), (), None),
    "motion_phase": (np.dtype("float32"), (), (0, 1)),
    "motion_blend": (np.dtype("float32"), (), (0, 1)),
    "motion_arms": (np.dtype("float32"), (2,), (0, 1)),
    "motion_seat": (np.dtype("float32"), (2,), (0, 2)),
    "motion_hands": (np.dtype("float32"), (4, 4), None),
}
"""Type, shape of a row, and limits of each column of an agent, as far as they are the same for all agents."""


def _is(array: NDArray[Any], kind: DTypeLike, shape: tuple[int | None, ...]) -> bool:
    return (
        array.dtype == kind
        and len(array.shape) == len(shape) + 1
        and all(n in (None, m) for n, m in zip(shape, array.shape[1:], strict=True))
    )


def _expected(array: NDArray[Any], kind: DTypeLike, shape: tuple[int | None, ...]) -> str:
    rows = ", ".join(["T", *("any" if n is None else str(n) for n in shape)])
    return f"expected {kind} [{rows}], got {array.dtype} {list(array.shape)}"


# --- time and numbers -------------------------------------------------------------------------------------------------
def _time(rec: Recording) -> Iterator[Finding]:
    """Yield findings about gaps in time, and about a time step that differs from the one in the header.

    Opening a recording already checks that time increases.
    """
    steps = np.diff(rec.columns["time_ns"])
    if not len(steps):
        return
    usual = float(np.median(steps))
    gaps = steps > GAP_STEPS * usual
    if gaps.any():
        text = f"{steps[np.argmax(gaps)] * 1e-9:.3f} s to the previous step, usually {usual * 1e-9:.3f} s"
        yield _warning("time", "time_ns", text, at=np.append(False, gaps))
    if abs(usual - rec.episode.dt_ns) > 0.05 * rec.episode.dt_ns:
        yield _warning("time", "dt_ns", f"is {rec.episode.dt_ns} ns, but rows are {usual:.0f} ns apart")


def _values(rec: Recording) -> Iterator[Finding]:
    for name, array in rec.columns.items():
        if array.dtype.kind != "f" or not array.size:
            continue
        match = _AGENT.match(name)
        rows = array.reshape(len(array), -1)
        poses = rows.reshape(len(rows), -1, 7) if _holds_poses(name, array) else None
        finite = bool(np.isfinite(rows).all())
        infinite = np.isinf(rows).any(axis=1) & (not finite and not name.startswith("metrics."))
        if infinite.any():
            yield _error("values", name, "is infinite", at=infinite)
        if poses is not None and finite:
            yield from _unit(name, poses[..., 3:])
        elif poses is not None:
            missing = np.isnan(poses)
            partial_nan = np.any(missing.any(axis=2) & ~missing.all(axis=2), axis=1)
            if partial_nan.any():
                text = "a pose is partly NaN; poses of absent objects must be NaN throughout"
                yield _error("values", name, text, at=partial_nan)
            yield from _unit(name, poses[..., 3:])
        elif match is not None and not finite and np.isnan(rows).any():
            yield _error("values", name, "is NaN", at=np.isnan(rows).any(axis=1))
        if match is not None and match[2] == "joint_quat" and array.ndim == 3:
            yield from _unit(name, array)
    quats = np.array([body.pose[3:] for body in rec.bodies if body.pose.shape == (7,)], np.float64).reshape(-1, 4)
    if len(quats) == len(rec.bodies) and (np.abs(np.linalg.norm(quats, axis=1) - 1) < UNIT_ERROR / 2).all():
        return
    for body in rec.bodies:
        length = float(np.linalg.norm(body.pose[3:].astype(np.float64)))
        if np.isfinite(body.pose).all() and abs(length - 1) > UNIT_ERROR:
            yield _error("quaternions", body.name, f"its quaternion has length {length:.4f}")


def _holds_poses(name: str, array: NDArray[Any]) -> bool:
    match = _AGENT.match(name)
    is_pose = name == "object_pose" or name.startswith("rig.") or (match is not None and match[2] in _POSES)
    return is_pose and array.ndim > 1 and array.shape[-1] == 7


def _unit(name: str, quats: NDArray[Any]) -> Iterator[Finding]:
    """Yield findings about quaternions [T, ..., 4] that are not of unit length; NaN marks absent objects."""
    if (np.abs(np.einsum("...i,...i", quats, quats) - 1) < UNIT_WARNING).all():  # the length is off by half of that
        return
    off = np.abs(np.linalg.norm(quats.astype(np.float64), axis=-1) - 1).reshape(len(quats), -1)
    worst = np.nan_to_num(off).max(axis=1, initial=0.0)
    if (worst > UNIT_WARNING).any():
        report, limit = (_error, UNIT_ERROR) if (worst > UNIT_ERROR).any() else (_warning, UNIT_WARNING)
        yield report("quaternions", name, f"a quaternion's length is off by {worst.max():.2g}", at=worst > limit)


def _hash(rec: Recording) -> Iterator[Finding]:
    stored = rec.columns.get("state_hash")
    if stored is None or stored.dtype != np.uint64 or stored.ndim != 1:
        return
    differ = state_hash(rec.columns) != stored
    if differ.any():
        text = "the state differs from the one that was hashed: it was modified, or the previous row is missing"
        yield _error("hash", "state_hash", text, at=differ)


# --- motion -----------------------------------------------------------------------------------------------------------
def _jumps(rec: Recording) -> Iterator[Finding]:
    seconds = np.diff(rec.columns["time_ns"]) * 1e-9
    if not len(seconds):
        return
    tracks = [(b.name, rec.columns["object_pose"][:, b.moving], OBJECT_MPS) for b in rec.moving_bodies]
    tracks += [(a.name, rec.agent_column(i, "base_pose"), AGENT_MPS) for i, a in enumerate(rec.agents)]
    for name, pose, limit in tracks:
        distance = np.linalg.norm(np.diff(pose[:, :3].astype(np.float64), axis=0), axis=1)
        speed, turned = distance / seconds, _angles(pose[:, 3:]) > TURN_RAD
        fast = speed > limit
        if fast.any():
            text = f"moves {distance[np.argmax(fast)]:.2f} m in one step, {speed[np.argmax(fast)]:.0f} m/s"
            yield _warning("jumps", name, text, at=np.append(False, fast))
        if turned.any():
            text = f"turns {np.degrees(_angles(pose[:, 3:])[np.argmax(turned)]):.0f} degrees in one step"
            yield _warning("jumps", name, text, at=np.append(False, turned))
    for i in range(len(rec.agents)):
        for column, change in (("joint_pos", lambda a: np.abs(np.diff(a, axis=0))), ("joint_quat", _angles)):
            array = rec.columns.get(f"agent_{i}.{column}")
            if array is None or not array.size:
                continue
            most = change(array.astype(np.float64)).max(axis=1)
            if (most > JOINT_RAD).any():
                text = f"a joint moves {most[np.argmax(most > JOINT_RAD)]:.2f} rad or m in one step"
                yield _warning("jumps", f"agent_{i}.{column}", text, at=np.append(False, most > JOINT_RAD))


def _angles(quats: NDArray[Any]) -> NDArray[np.float64]:
    """Return angles [T-1, ...] [rad] between consecutive rotations [T, ..., 4]."""
    q = quats.astype(np.float64)
    return 2 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=-1)), 0, 1))


# --- bodies, walls, files ---------------------------------------------------------------------------------------------
def _posed(rec: Recording, assets: AssetLibrary) -> Iterator[Finding]:
    """Yield findings that need the posed bodies, the scene or the asset files."""
    try:
        replay = _Poses(rec, assets=assets)
    except H3DataError as fault:
        yield _error("assets", "recording", f"it cannot be posed: {fault}")
        return
    for uri, bodies in sorted(replay.missing.items()):
        yield _warning("assets", uri, f"not found; {bodies} bodies are replaced by placeholders")
    if not len(rec):
        return
    if replay.scene is not None and len(replay.scene.instances):
        yield from _in_walls(rec, replay)
    roots = [rec.agent_column(i, "base_pose")[:, :3].astype(np.float64) for i in range(len(rec.agents))]
    # whoever plays live may walk into others, which is measured as contact; a simulated agent must not
    finding = _warning if "hitl" in rec.episode.info else _error
    for i, j in itertools.combinations(range(len(roots)), 2):
        distance = np.linalg.norm(roots[i] - roots[j], axis=1)
        if (distance < APART_M).any():
            text = f"their roots are {distance[np.argmax(distance < APART_M)]:.2f} m apart"
            yield finding("penetration", f"{rec.agents[i].name}, {rec.agents[j].name}", text, at=distance < APART_M)
    for i, agent in enumerate(rec.agents):
        if agent.model and isinstance(replay.model(i), Humanoid):
            yield from _feet(replay, i)


class _Poses(PosedRecording):
    """The poses of what is checked, without the drawables, which would take half of the time."""

    def _read_scene(self, glb: bytes) -> Scene:
        return _scene_of(glb)

    def _add_body(self, body: Body, ref: AssetRef) -> None:
        kind, _, name = ref.uri.partition(":")
        if kind == "scene" and ref.color is None and self.scene is not None and name in self.scene.assets:
            return  # as are most bodies
        if ref.name not in self._assets:
            self._assets[ref.name] = self.library.mesh(ref)
        if self._assets[ref.name] is None:
            self.missing[ref.uri] = self.missing.get(ref.uri, 0) + 1

    def leg_frames(self, agent: int, body: Humanoid, steps: NDArray[np.integer]) -> NDArray[np.floating]:
        """Return the world matrices of the joints of a person's legs, shape [T, 2, 4, 4, 4]; see `LEG_JOINTS`."""
        planted = not any(f"agent_{agent}.{name}" in self.recording.columns for name in ("joint_quat", "motion_seat"))
        if not planted or self._gestures_of(agent) is not None:
            return self.joint_matrices(agent, steps)[:, LEG_JOINTS]
        tables, states = self._gait_of(agent, body)  # arms, which may be drawn in, do not move legs
        quats, pelvis = pose_planted(tables, states[steps], joints=_HEAD + 1)
        return body.joint_matrices(self.recording.agent_column(agent, "base_pose")[steps], quats, pelvis)[:, LEG_JOINTS]

    def _add_agent(self, index: int, agent: Agent) -> None:
        model = self.model(index)
        self._require_motion(index, model)
        if isinstance(model, Robot) and len(self):  # raises what does not fit
            model.link_matrices(*(self.recording.agent_column(index, name)[:1] for name in ("base_pose", "joint_pos")))


@lru_cache(maxsize=_SCENES_KEPT)
def _scene_of(glb: bytes) -> Scene:
    """Return a home, which the episodes of a dataset often have in common."""
    return load_scene(glb)


@lru_cache(maxsize=_SCENES_KEPT)
def _free_space_of(glb: bytes) -> FreeSpace:
    return FreeSpace.from_scene(_scene_of(glb))


def _in_walls(rec: Recording, replay: _Poses) -> Iterator[Finding]:
    assert replay.scene is not None
    try:
        free = _free_space_of(bytes(rec.attachments["scene.glb"]))
    except H3DataError as fault:
        yield _warning("penetration", "scene.glb", f"walls are not checked: {fault}")
        return
    for i, agent in enumerate(rec.agents):
        root = rec.agent_column(i, "base_pose")[:, :3].astype(np.float64)
        on_storey = np.isfinite(root).all(axis=1) & (np.abs(root[:, 1] - free.height_at(root[:, [0, 2]])) < 0.5)
        if f"agent_{i}.motion_seat" in rec.columns:  # who lies is on a bed, with the root among the legs
            on_storey &= rec.columns[f"agent_{i}.motion_seat"][:, 1] <= 1
        depth = np.full(len(root), -np.inf)
        depth[on_storey] = -free.signed_distance(root[on_storey][:, [0, 2]])
        if (depth > WALL_M).any():
            text = f"its root is {depth.max():.2f} m inside an obstacle or off the floor"
            yield _error("penetration", agent.name, text, at=depth > WALL_M)
    if JOINTS in rec.columns:
        yield from _through_doors(rec, replay.scene, free)


def _through_doors(rec: Recording, scene: Scene, free: FreeSpace) -> Iterator[Finding]:
    """Yield findings about agents whose roots cross the leaf of a door between rooms, wherever that leaf is."""
    joints, recorded = joints_of(scene), rec.columns[JOINTS].astype(np.float64)
    roots = [rec.agent_column(i, "base_pose")[:, [0, 2]].astype(np.float64) for i in range(len(rec.agents))]
    steps = [linestrings(np.stack([xz[:-1], xz[1:]], axis=1)) for xz in roots]
    for k in passages(scene, free):
        # of a step, the position at its end: who opens a door stands still
        places, which = np.unique(recorded[1:, k], return_inverse=True)
        leaves = []
        for place in places:
            positions = joints.rest.copy()
            positions[k] = place
            leaves.append(union_all(outlines(scene, k, positions)))
        leaf = np.array(leaves, object)[which]
        for agent, ways in zip(rec.agents, steps, strict=True):
            crosses = np.append(False, intersects(leaf, ways))
            if crosses.any():
                text = f"its root goes through {joints.names[k]}, a door, where it stands"
                yield _error("penetration", agent.name, text, at=crosses)


def _feet(replay: _Poses, agent: int) -> Iterator[Finding]:
    """Yield findings about soles below the floor, and about feet that slide while they carry weight.

    The floor is at the height of the root, or of the tread below the foot.
    """
    rec, body = replay.recording, replay.model(agent)
    assert isinstance(body, Humanoid)
    parts = []
    for start in range(0, len(rec), _FEET_CHUNK):
        steps = np.arange(start, min(start + _FEET_CHUNK, len(rec)))
        parts.append(sole_points(body, replay.leg_frames(agent, body, steps)))
    points = np.concatenate(parts)  # [T, 2 feet, 3 points, xyz]
    if len(replay.heights):
        points[..., 1] -= floor_heights(replay.heights, 0.0, points[..., ::2], treads=True)
    else:
        points[..., 1] -= rec.agent_column(agent, "base_pose")[:, 1, None, None]
    lowest = points[..., 1].min(axis=(1, 2))
    name = rec.agents[agent].name
    if (lowest < -SINK_M).any():
        text = f"a sole is {-np.nanmin(lowest):.2f} m below the {'tread' if len(replay.heights) else 'root'}"
        yield _warning("penetration", name, text, at=lowest < -SINK_M)
    if len(rec) < 2:
        return
    pivot = np.argmin(points[1:, ..., 1] + points[:-1, ..., 1], axis=2)[..., None]
    distance = np.take_along_axis(np.linalg.norm(np.diff(points[..., ::2], axis=0), axis=-1), pivot, axis=2)[..., 0]
    height = np.take_along_axis(np.maximum(points[1:, ..., 1], points[:-1, ..., 1]), pivot, axis=2)[..., 0]
    speed = np.where(height < LOW_M, distance, np.inf).min(axis=1) / (np.diff(rec.columns["time_ns"]) * 1e-9)
    slides = np.isfinite(speed) & (speed > SLIDE_MPS)
    for start, end in runs(slides):
        slides[start:end] &= (rec.columns["time_ns"][end] - rec.columns["time_ns"][start]) * 1e-9 > SLIDE_S * 0.95
    if slides.mean() > SLIDE_SHARE:
        text = f"the carrying foot slides at {np.median(speed[slides]):.2f} m/s in {slides.mean():.0%} of the steps"
        yield _warning("feet", name, text, at=np.append(False, slides))


# --- findings ---------------------------------------------------------------------------------------------------------
def _error(check: Check, subject: str, text: str, *, at: ArrayLike | None = None) -> Finding:
    return _finding(check, "error", subject, text, at)


def _warning(check: Check, subject: str, text: str, *, at: ArrayLike | None = None) -> Finding:
    return _finding(check, "warning", subject, text, at)


def _finding(check: Check, severity: Severity, subject: str, text: str, at: ArrayLike | None) -> Finding:
    """Return a finding at the steps marked in ``at`` [T]."""
    step, count = (-1, 1) if at is None else (int(np.argmax(at)), int(np.sum(at)))
    return Finding(check=check, severity=severity, subject=subject, text=text, step=step, count=count)
