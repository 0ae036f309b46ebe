"""Measure the motion of people in one episode of each task in each home of ``h3-homes/test``, and compare it with real walks.

Joints are those of a replay, as pictures show them; a step is 1/30 s. For each task:

``pops_per_minute``
    Steps in which a joint moves more than 12 cm against the pelvis, and more than 1.1 times as far as it ever does in the
    steady gait at any speed up to the fastest of the episode; per minute of a person.
``mid_air_stops``
    Steps in which the root rests while both soles are more than 2 cm above the floor.
``turning_share``
    Steps in which the root turns without getting anywhere, of all steps.
``foot_slide``
    How far the planted foot moves along the floor: the lowest point of a sole that is within 2 mm of it before and after a
    step. Where both are, that of the foot that moves less, as a swinging foot may graze the floor. Mean and 99th percentile.
``jerk``
    Mean length of the third derivative of the paths of head, wrists and ankles while the root moves [m/s^3].

``quad_arm.foot_slide_mm``, ``foot_slide_p99_mm``
    How far the feet of ``quad_arm`` creep in a step while they stand, worst of speeds from -1 to 2.5 m/s and turns up to
    2.5 rad/s, on the spot too, and of the episodes of social navigation [mm].

``robots.jumps_per_minute``, ``robots.reversals_per_minute``
    Steps in which a robot's speed changes by 0.5 m/s or more, and changes of the direction in which it turns or drives
    within five steps; per minute of a robot of rearrangement and wandering.

``motion.<metric>`` is the worst of the tasks (pops, slide, jerk), their sum (mid-air stops) or all their steps together
(turning share). ``motion.paper.<task>.*`` are those of social navigation and rearrangement with ``rules="paper"``, in
small homes.
``motion.real.<name>.*`` are the same figures of captured walks in ``../shared``, put on a body at 30 frames/s;
where they are absent, ``motion.real.clips`` is 0.

    python -m benchmarks motion
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import h3data
from benchmarks.penetration import DEFAULT_ROBOT, EPISODES
from h3data.bodies import JOINT_INDEX, Humanoid, load_humanoid, load_robot
from h3data.bodies.people.soles import LEG_JOINTS, sole_points
from h3data.bodies.robots.trot import trot
from h3data.geometry import Array, ground_pose, heading_from_quat, transform_points, wrap_angle
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_motion.files import read_motion
from h3data_motion.recording import motion_columns
from h3data_motion.retarget import retarget
from sim_kinematic.motion.spec import STEP_S

Emit = Callable[[str, float, str], None]
SHARED = Path(__file__).resolve().parents[2] / "shared"
HOMES = 10
"""One episode of each task in each test home."""
POP_M, STEADY_ROOM = 0.12, 1.1
AIR_M, REST_M, REST_RAD, FLOOR_M = 0.02, 1e-3, 1e-3, 0.002
JUMP_MPS, CREEPS_MPS, CREEPS_RAD_S, AT_ONCE = 0.5, 0.05, 0.1, 5
PAPER_HOMES = 6
PAPER_TASKS: dict[str, dict[str, Any]] = {
    "social_nav": {"max_steps": 900, "end_on_collision": False},
    "rearrange": {"max_steps": 750},
}
SPEEDS = 5
"""Up to the fastest of an episode, at which the steady gait is looked at."""
BODY_JOINTS = 22
"""Joints without jaw, eyes and fingers, which the wrists stand for."""
JERK_JOINTS = [JOINT_INDEX[name] for name in ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")]


def run(emit: Emit) -> None:
    """Emit ``motion.quad_arm.*``, ``motion.<task>.*``, ``motion.*`` and ``motion.real.*``."""
    slides = [trot_slides(track) for track in [*robot_tracks(), *_driven_tracks()]]
    emit("motion.quad_arm.foot_slide_mm", 1000 * max(float(slide.mean()) for slide in slides), _UNITS["foot_slide_mm"])
    worst = 1000 * max(float(np.percentile(slide, 99)) for slide in slides)
    emit("motion.quad_arm.foot_slide_p99_mm", worst, _UNITS["foot_slide_p99_mm"])
    totals: list[dict[str, Array]] = []
    for task, episodes in EPISODES.items():
        recordings = list(episodes(HOMES, DEFAULT_ROBOT))
        if task != "social_nav":  # there it is the policies who decide
            _emit_robots(emit, f"motion.{task}.robots", recordings)
        parts = [part for recording in recordings for part in motions(recording)]
        found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        totals.append(found)
        _emit_all(emit, f"motion.{task}", found)
    figures = [figures_of(found) for found in totals]
    for name in ("pops_per_minute", "foot_slide_mm", "foot_slide_p99_mm", "jerk"):
        emit(f"motion.{name}", max(figure[name] for figure in figures), _UNITS[name])
    emit("motion.mid_air_stops", sum(figure["mid_air_stops"] for figure in figures), "steps")
    turns = np.concatenate([found["turns"] for found in totals])
    emit("motion.turning_share", float(turns.mean()), "of all steps")
    for task, options in PAPER_TASKS.items():
        paper = [part for home in range(PAPER_HOMES) for part in motions(_paper(task, home, options))]
        found = {name: np.concatenate([part[name] for part in paper]) for name in paper[0]}
        _emit_all(emit, f"motion.paper.{task}", found)
    clips = sorted((SHARED / "motion").glob("*.bvh"))
    emit("motion.real.clips", len(clips), "captured walks (in ../shared/motion)")
    for path in clips:
        _emit_all(emit, f"motion.real.{path.stem}", real_motion(path))


_UNITS = {
    "pops_per_minute": "steps per minute",
    "mid_air_stops": "steps",
    "turning_share": "of all steps",
    "foot_slide_mm": "mm per step",
    "foot_slide_p99_mm": "mm per step",
    "jerk": "m/s^3",
    "minutes": "minutes of people",
}


def robot_tracks(steps: int = 300) -> list[Array]:
    """Return agent roots [T, 7] of robots at constant speeds and turn rates, in curves and on the spot."""
    tracks = []
    for speed, turn in product((-1.0, 0.0, 0.2, 0.5, 1.0, 1.5, 2.0, 2.5), (0.0, 0.5, 1.5, 2.5)):
        heading = np.arange(steps) * turn * STEP_S
        moved = speed * STEP_S * np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
        if speed or turn:
            tracks.append(ground_pose(np.cumsum(moved, axis=0), heading))
    return tracks


def _driven_tracks() -> Iterator[Array]:
    for recording in EPISODES["social_nav"](3, DEFAULT_ROBOT):
        yield recording.columns["agent_0.base_pose"].astype(np.float64)


def _emit_robots(emit: Emit, prefix: str, recordings: list[Recording]) -> None:
    jumps = reversals = minutes = 0.0
    for recording in recordings:
        for number, agent in enumerate(recording.agents):
            if agent.kind == "robot":
                forward, turn = robot_speeds(recording.columns[f"agent_{number}.base_pose"].astype(np.float64))
                jumps += (np.abs(np.diff(np.abs(forward))) >= JUMP_MPS).sum()
                reversals += _reversals(forward, CREEPS_MPS) + _reversals(turn, CREEPS_RAD_S)
                minutes += len(forward) * STEP_S / 60
    emit(f"{prefix}.jumps_per_minute", jumps / minutes, "steps per minute")
    emit(f"{prefix}.reversals_per_minute", reversals / minutes, "changes per minute")


def robot_speeds(base: Array) -> tuple[Array, Array]:
    """Return forward [m/s] and turning speed [rad/s] in each step of a track of agent roots [T, 7]."""
    heading, moved = heading_from_quat(base[:, 3:]), np.diff(base[:, [0, 2]], axis=0) / STEP_S
    forward = moved[:, 0] * np.cos(heading[:-1]) - moved[:, 1] * np.sin(heading[:-1])
    return forward, wrap_angle(np.diff(heading)) / STEP_S


def _reversals(speed: Array, least: float) -> int:
    """Return the changes of sign, within `AT_ONCE` steps, of a speed [T] that counts from ``least`` on."""
    at = np.flatnonzero(np.abs(speed) > least)
    return int(((np.diff(np.sign(speed[at])) != 0) & (np.diff(at) <= AT_ONCE)).sum())


def trot_slides(base: Array) -> Array:
    """Return the distance [m] by which each standing foot of ``quad_arm`` slides in each step of a base track [T, 7]."""
    robot = load_robot(DEFAULT_ROBOT)
    links = [int(robot.joint_links[leg.columns[2]]) for leg in robot.legs]

    def feet_of(base: Array, joints: Array) -> Array:
        """Return the places of the feet [T, L, 3]."""
        frames = robot.link_matrices(base, joints)
        feet = zip(links, robot.legs, strict=True)
        return np.stack([transform_points(frames[:, k], leg.foot[None])[:, 0] for k, leg in feet], axis=1)

    rest = np.tile(robot.rest, (len(base), 1))
    feet, floor = feet_of(base, trot(robot, base, rest)), feet_of(base[:1], rest[:1])[..., 1].min()
    stands = feet[..., 1] < floor + FLOOR_M
    creep = np.hypot(*np.moveaxis(np.diff(feet[..., [0, 2]], axis=0), -1, 0))
    return creep[stands[1:] & stands[:-1]]


def _paper(task: str, home: int, options: dict[str, Any]) -> Recording:
    return h3data.simulate(task, f"small:{home}", seed=home, rules="paper", **options)


def _emit_all(emit: Emit, prefix: str, found: dict[str, Array]) -> None:
    for name, value in figures_of(found).items():
        emit(f"{prefix}.{name}", value, _UNITS[name])


def figures_of(found: dict[str, Array]) -> dict[str, float]:
    """Return the figures of what `motions` found."""
    minutes = len(found["turns"]) * STEP_S / 60
    return {
        "pops_per_minute": float(found["pops"].sum()) / minutes,
        "mid_air_stops": float(found["mid_air"].sum()),
        "turning_share": float(found["turns"].mean()),
        "foot_slide_mm": 1000 * float(found["slide"].mean()) if len(found["slide"]) else 0.0,
        "foot_slide_p99_mm": 1000 * float(np.percentile(found["slide"], 99)) if len(found["slide"]) else 0.0,
        "jerk": float(found["jerk"].mean()) if len(found["jerk"]) else 0.0,
        "minutes": minutes,
    }


def motions(recording: Recording) -> Iterator[dict[str, Array]]:
    """Yield the figures of the motion of each person of a recording (`motion_of`)."""
    replay = Replay(recording)
    for number, agent in enumerate(recording.agents):
        body = replay.model(number) if agent.kind == "human" else None
        if isinstance(body, Humanoid):
            base = recording.columns[f"agent_{number}.base_pose"].astype(np.float64)
            joints = replay.joint_matrices(number, np.arange(len(recording))).astype(np.float64)
            yield motion_of(body, base, joints)


def real_motion(path: Path, body_name: str = "male_1") -> dict[str, Array]:
    """Return the same of a captured motion on a body."""
    body = load_humanoid(body_name)
    columns = motion_columns(retarget(read_motion(path), body), body)
    joints = body.joint_matrices_free(columns["agent_0.root_pose"], columns["agent_0.joint_quat"])
    return motion_of(body, columns["agent_0.base_pose"].astype(np.float64), joints)


def motion_of(body: Humanoid, base: Array, joints: Array) -> dict[str, Array]:
    """Return the counted motion of a person in T steps, from agent roots [T, 7] and joint frames [T, 55, 4, 4]."""
    heading = heading_from_quat(base[:, 3:])
    walked = np.hypot(*np.diff(base[:, [0, 2]], axis=0).T)
    turned = np.abs(wrap_angle(np.diff(heading)))
    rests = walked < REST_M
    local = _local(heading, joints)
    moved = np.linalg.norm(np.diff(local, axis=0), axis=-1)
    limit = np.maximum(POP_M, STEADY_ROOM * _steady_steps(body, float(walked.max(initial=0.0))))
    soles = sole_points(body, joints[:, LEG_JOINTS])
    soles[..., 1] -= base[0, 1]
    lowest = soles[..., 1].min(-1)
    down = (lowest[1:] < FLOOR_M) & (lowest[:-1] < FLOOR_M)
    pivot = np.argmin(soles[1:, ..., 1] + soles[:-1, ..., 1], axis=-1)[..., None]
    slide = np.take_along_axis(np.linalg.norm(np.diff(soles[..., ::2], axis=0), axis=-1), pivot, axis=-1)[..., 0]
    jerk = np.linalg.norm(np.diff(joints[..., :3, 3][:, JERK_JOINTS], n=3, axis=0), axis=-1) / STEP_S**3
    stirs = ~rests | (turned > REST_RAD)
    return {
        "pops": (moved > limit).any(1),
        "mid_air": rests & (lowest[1:] > AIR_M).all(1),
        "turns": rests & (turned > REST_RAD),
        "slide": np.where(down, slide, np.inf).min(1)[down.any(1)],
        "jerk": jerk[stirs[2:]].mean(-1),
    }


def _local(heading: Array, joints: Array) -> Array:
    """Return the places [T, 21, 3] of the joints from the pelvis, in the frame that turns with the root."""
    away = joints[:, 1:BODY_JOINTS, :3, 3] - joints[:, :1, :3, 3]
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return np.stack([c * away[..., 0] - s * away[..., 2], away[..., 1], s * away[..., 0] + c * away[..., 2]], -1)


def _steady_steps(body: Humanoid, step_m: float) -> Array:
    """Return the farthest that each joint moves in a step of the steady gait, [21] [m], at any speed."""
    farthest, count = np.zeros(BODY_JOINTS - 1), 64
    phase, root = np.linspace(0, 1, count, endpoint=False), [[0, 0, 0, 0, 0, 0, 1]]
    fastest = step_m / STEP_S
    for speed in np.linspace(0, fastest, SPEEDS + 1)[1:] if fastest > REST_M else ():
        speeds, ahead = np.full(count, speed), speed * STEP_S / body.stride_m(speed)
        poses = [body.joint_matrices(root, *body.walk_pose(speeds, phase + way)) for way in (0.0, ahead)]
        before, after = (_local(np.zeros(count), frames) for frames in poses)
        farthest = np.maximum(farthest, np.linalg.norm(after - before, axis=-1).max(0))
    return farthest
