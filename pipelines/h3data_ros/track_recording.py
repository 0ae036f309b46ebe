"""Recordings made from tracks of a robot and of people, for metrics, reports and pictures."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_humanoid, load_robot, robot_digest, robot_name
from h3data.errors import FormatError, InputError
from h3data.geometry import ground_pose, heading_from_quat
from h3data.recording.assets.scenes import scene_records
from h3data.recording.records import Agent, AssetRef, Body, Episode, Recording
from h3data.scene import Scene
from h3data.scene.scene_file import scene_bytes
from h3data.terminal import counted
from h3data_motion.walk_synthesis import SYNTHETIC_BODY, walk_columns
from h3data_ros.transforms import at_times

GAP_S = 0.5
"""Longest gap between observations across which poses are interpolated [s]."""
JUMP_MPS, JUMP_M = 8.0, 1.0
"""Speed [m/s] and distance [m] above which a change of position is noise; a track that jumps farther is cut in two."""
TELEPORTING = 0.5
"""Share of jumping tracks above which the unit or the rate must be wrong."""
PLACE_MAX_M = 1e8
"""Greatest coordinate of a position [m] (UTM has 1e7); greater ones count as unknown, because their squares overflow."""
FAR_M = 1000.0
"""Distance of the origin above which it is moved by whole metres, as world coordinates are float32 [m]."""
CELLS_MAX = 20_000_000
"""Largest product of rows and people of one recording."""
HEADING_S, HEADING_M = 0.5, 0.1
"""Time over which headings are measured as directions of motion [s], and least distance covered in it [m]; below it,
the last heading is kept."""
FOOTPRINT_M, HEIGHT_M = 0.25, 0.5
"""Radius and height of the cylinder that shows a robot without a model."""
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Positions of one agent over time, with the times of its observations."""

    name: str
    time_ns: NDArray[np.int64]
    """Times of observations [ns], shape [N], in any order."""
    poses: Array
    """World poses (pose7) on the floor, shape [N, 7]; the quaternion is NaN if only the position is known."""


@dataclass
class Import:
    """Facts about an import, which are stored in ``episode.info``."""

    source: dict[str, Any]
    """Format and name of the file."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts about the import: rates, topics, gaps and counts."""
    warnings: list[str] = field(default_factory=list)
    goal: tuple[float, float] | None = None
    """Goal position of the robot (x, z) [m]."""


def parse_goal(text: str) -> tuple[float, float]:
    """Parse a goal ``x,y`` in the frame of the map [m] and return it as (x, z) in the world [m].

    Raises:
        InputError: the text is not two numbers.
    """
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        x = y = np.nan
    if not np.isfinite([x, y]).all():
        raise InputError(f"--goal is x,y in metres of the map, such as 3.5,-2, got {text!r}.", code="H3-ROS-009")
    return x, -y


def clean_tracks(tracks: Sequence[Track], told: Import) -> list[Track]:
    """Return tracks sorted by time, without unknown positions, and cut at jumps.

    Raises:
        FormatError: most tracks jump, so that the unit or the rate must be wrong.
    """
    cleaned: list[Track] = []
    unknown = twice = 0
    jumping: list[str] = []
    for track in tracks:
        known = (np.abs(track.poses[:, [0, 2]]) < PLACE_MAX_M).all(axis=1)  # False of NaN
        unknown += int((~known).sum())
        times, first = np.unique(track.time_ns[known], return_index=True)
        poses = track.poses[known][first]
        twice += int(known.sum()) - len(times)
        if not len(times):
            continue
        distance = np.linalg.norm(np.diff(poses[:, [0, 2]], axis=0), axis=1)
        # the constant part lets noise pass between observations that follow each other within milliseconds
        cuts = np.flatnonzero(distance > JUMP_M + JUMP_MPS * np.diff(times) * 1e-9) + 1
        if len(cuts):
            jumping.append(track.name)
        bounds = [0, *cuts.tolist(), len(times)]
        for number, (start, end) in enumerate(itertools.pairwise(bounds), 1):
            name = track.name if number == 1 else f"{track.name}_{number}"
            cleaned.append(Track(name=name, time_ns=times[start:end], poses=poses[start:end]))
    if len(jumping) > max(TELEPORTING * len(tracks), 1) or len(cleaned) > 10 * len(tracks) + 10:
        raise FormatError(
            f"{len(jumping)} of {len(tracks)} tracks jump faster than {JUMP_MPS:g} m/s, {jumping[0]!r} first. Hint: say the "
            "unit (--unit mm) or the rate of frames (--rate), or check whether ids are used twice.",
            code="H3-ROS-010",
        )
    if jumping:
        listed = ", ".join(jumping[:4]) + (", ..." if len(jumping) > 4 else "")
        told.warnings.append(f"{len(jumping)} of {len(tracks)} tracks jump and become several agents: {listed}")
    for count, what in (
        (unknown, "places are unknown (no numbers, or no transform to the map) and left out"),
        (twice, "places come twice and the later is left out"),
    ):
        if count:
            told.warnings.append(f"{count} {what}")
    return cleaned


def rows_at(people: Sequence[Track], robot: Track | None, hz: float | None, told: Import) -> NDArray[np.int64]:
    """Return the times of the rows [T] [ns]: at the rate ``hz``, or else whenever people were observed.

    In gaps of people's observations longer than `GAP_S`, rows are at the robot's times, but not more often than
    elsewhere. A gap in all tracks has one row without poses, so that nothing is interpolated across it.

    Raises:
        InputError: the rate is not sensible.
        FormatError: there are no observations.
    """
    tracks = [*people, *([robot] if robot is not None else [])]
    times = [track.time_ns for track in tracks if len(track.time_ns)]
    if not times:
        raise FormatError(
            "There is no observation of anybody. Hint: check the topic or the columns.", code="H3-ROS-011"
        )
    if hz is not None:
        if not 0.1 <= hz <= 1000:
            raise InputError(f"--hz must be at least 0.1 and at most 1000, got {hz:g}.", code="H3-ROS-012")
        start, end = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
        count = int((end - start) * 1e-9 * hz + 1e-6) + 1
        if count > CELLS_MAX:
            raise FormatError(
                f"{hz:g} rows a second over {(end - start) * 1e-9:.0f} s are too many. Hint: take fewer, or check the stamps.",
                code="H3-ROS-013",
            )
        silent = np.diff(np.unique(np.concatenate(times))) > GAP_S * 1e9
        told.facts |= {"rows": "fixed rate", "rate_hz": hz, "gaps": int(silent.sum())}
        return start + np.round(np.arange(count) * (1e9 / hz)).astype(np.int64)
    observed = [track.time_ns for track in people if len(track.time_ns)] or times
    rows = np.unique(np.concatenate(observed))
    period = int(np.median(np.diff(rows))) if len(rows) > 1 else int(GAP_S * 1e9)
    gap = max(int(GAP_S * 1e9), 3 * period)
    if robot is not None and len(robot.time_ns):
        lonely = robot.time_ns[
            np.diff(rows, prepend=rows[:1], append=rows[-1:])[np.searchsorted(rows, robot.time_ns)] > gap
        ]
        outside = robot.time_ns[(robot.time_ns < rows[0] - gap) | (robot.time_ns > rows[-1] + gap)]
        more = np.unique(np.concatenate([lonely, outside]))
        if len(more):
            # a robot tells its pose more often than people are observed: one row a period, as in the rest of the recording
            slot = (more - rows[0]) // period
            more = more[np.unique(slot, return_index=True)[1]]
            rows = np.unique(np.concatenate([rows, more]))
    wide = np.flatnonzero(np.diff(rows) > gap)
    told.facts |= {"rows": "times of observations", "rate_hz": round(1e9 / period, 3), "gaps": len(wide)}
    # one row without poses within each gap, so that no speed is computed across it
    middles = rows[wide] + (rows[wide + 1] - rows[wide]) // 2
    return np.sort(np.concatenate([rows, middles]))


def record_tracks(
    people: Sequence[Track],
    robot: Track | None,
    told: Import,
    *,
    scene: Scene | None,
    hz: float | None,
    task: str,
    model: str = "",
) -> Recording:
    """Return a recording of tracks, with the robot first and then the people in order of first observation.

    Columns ``agent_<i>.recorded`` state whether a row's pose was observed instead of interpolated. Postures of people
    are synthesized from their paths (`h3data_motion.walk_synthesis`). Unobserved headings are directions of motion. A
    robot has the body ``model`` (`h3data.bodies.load_robot`) at rest, or is a cylinder if there is no model.

    Raises:
        InputError: ``hz`` is not sensible, there is no robot ``model``, or there is a model but no robot.
        FormatError: there are no observations, most tracks jump, or they are too long for one recording.
    """
    if model and robot is None:
        raise InputError(
            "--model is the body of the robot, and none of these tracks is one. Hint: --robot ID.", code="H3-ROS-060"
        )
    body = load_robot(model) if model else None
    seen = clean_tracks([*people, *([robot] if robot is not None else [])], told)
    own = [track for track in seen if robot is not None and (track.name == robot.name)]
    moving = own[0] if own else None
    if robot is not None and moving is None:
        raise FormatError(f"The robot {robot.name!r} has no known place.", code="H3-ROS-014")
    walking = sorted((track for track in seen if track is not moving), key=lambda track: int(track.time_ns[0]))
    rows = rows_at(walking, moving, hz, told)
    if len(rows) * (len(walking) + 1) > CELLS_MAX:
        raise FormatError(
            f"{len(rows)} rows of {len(walking)} people are too many for one recording. Hint: cut the file into parts of some "
            "minutes, or take fewer rows with --hz.",
            code="H3-ROS-015",
        )
    offset = _offset([*walking, *([moving] if moving is not None else [])])
    columns: dict[str, Any] = {"time_ns": rows - rows[0]}
    agents: list[Agent] = []
    synthesised: dict[str, list[str]] = {}
    refs, things = scene_records(scene) if scene is not None else ((), ())
    assets, bodies = list(refs), list(things)
    if moving is not None:
        base, recorded, made_up = _base(moving, rows, offset)
        columns |= {"agent_0.base_pose": base, "agent_0.recorded": recorded}
        synthesised[moving.name] = ["posture" if body is not None else "shape", *(["heading"] if made_up else [])]
        if body is not None:
            columns["agent_0.joint_pos"] = np.tile(body.rest.astype(np.float32), (len(rows), 1))
            agents.append(
                Agent(
                    name=moving.name,
                    kind="robot",
                    semantic_id=200,
                    model=f"robot/{robot_name(body)}",
                    joint_names=body.joint_names,
                )
            )
        else:
            columns["object_pose"] = (base + np.array([0, HEIGHT_M / 2, 0, 0, 0, 0, 0], np.float32))[:, None]
            first = base[np.argmax(np.isfinite(base).all(axis=1))]
            size = np.array([FOOTPRINT_M, HEIGHT_M / 2, FOOTPRINT_M], np.float32)
            assets.append(AssetRef(name="robot", uri="primitive:cylinderSolid", color=(90, 110, 140)))
            bodies.append(Body(name="robot", asset="robot", pose=first, scale=size, semantic_id=200, moving=0, agent=0))
            agents.append(Agent(name=moving.name, kind="robot", semantic_id=200))
    human = load_humanoid(SYNTHETIC_BODY)
    for track in walking:
        number = len(agents)
        base, recorded, made_up = _base(track, rows, offset)
        mine = {"base_pose": base, "recorded": recorded, **walk_columns(human, base, columns["time_ns"])}
        columns |= {f"agent_{number}.{name}": values for name, values in mine.items()}
        model = f"humanoid/{SYNTHETIC_BODY}"
        agents.append(
            Agent(name=track.name, kind="human", model=model, semantic_id=100, motion_names=tuple(human.motion_names))
        )
        synthesised[track.name] = ["posture", *(["heading"] if made_up else [])]
    if moving is not None and walking:
        nearest = np.full(len(rows), np.inf, np.float32)
        for number in range(1, len(agents)):
            gap = columns[f"agent_{number}.base_pose"][:, [0, 2]] - columns["agent_0.base_pose"][:, [0, 2]]
            nearest = np.fmin(nearest, np.linalg.norm(gap, axis=1))
        columns["metrics.dist_agents"] = np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32)
    people_said = "people" if len(walking) <= 8 else f"{len(walking)} people"
    told.facts |= {"people": len(walking), "start_ns": int(rows[0])}
    told.facts |= {"offset_m": offset.tolist()} if offset.any() else {}
    who = ("" if moving is None else "1 robot, ") + (f"{len(walking)} people" if len(walking) != 1 else "1 person")
    told.facts["summary"] = (
        f"{told.facts['rate_hz']:g} Hz ({told.facts['rows']}), {who}, "
        f"{counted(told.facts['gaps'], 'gap')} in which nobody is observed"
    )
    info: dict[str, Any] = {
        "source": told.source,
        "profile": "social",
        "imported": told.facts,
        "synthesised": synthesised if len(walking) <= 8 else {people_said: ["posture"]},
        "warnings": told.warnings,
        "t0_unix_ns": int(rows[0]),
    }
    if body is not None and (digest := robot_digest(robot_name(body))):
        info["robots_sha256"] = {robot_name(body): digest}
    if told.goal is not None:
        info["goal"] = [float(told.goal[0] - offset[0]), float(told.goal[1] - offset[2])]
    name = Path(str(told.source.get("file", task))).stem
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"{told.source}{rows[0]}{len(rows)}")),
            episode_id=name,
            task=task,
            scene=scene.name if scene is not None else "",
            dt_ns=int(np.median(np.diff(rows))) if len(rows) > 1 else 100_000_000,
            created_by="h3data",
            info=info,
        ),
        assets=tuple(assets),
        bodies=tuple(bodies),
        agents=tuple(agents),
        columns=columns,
        attachments={} if scene is None else {"scene.glb": scene_bytes(scene)},
    )


def _base(track: Track, rows: NDArray[np.int64], offset: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_], bool]:
    """Return the poses [T, 7] and which are observed [T], and whether the headings are those of motion."""
    poses, made_up = track.poses, False
    if not np.isfinite(poses[:, 3:]).all():
        poses = ground_pose(poses[:, [0, 2]], headings_of_motion(track.time_ns, poses[:, [0, 2]]), 0.0).astype(
            np.float64
        )
        poses[:, 1], made_up = track.poses[:, 1], True
    base = at_times(track.time_ns, poses, rows, int(GAP_S * 1e9))
    base[:, :3] -= offset
    return base.astype(np.float32), np.isin(rows, track.time_ns), made_up


def headings_of_motion(time_ns: NDArray[np.int64], xz: Array) -> Array:
    """Return headings [N] [rad] of a path [N, 2]: its direction over `HEADING_S`, or the last one at rest."""
    seconds = (time_ns - time_ns[0]) * 1e-9
    reach = max(HEADING_S / 2, float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0)
    ends = [
        np.stack(
            [np.interp(np.clip(seconds + s * reach, seconds[0], seconds[-1]), seconds, xz[:, k]) for k in (0, 1)], 1
        )
        for s in (1, -1)
    ]
    step = ends[0] - ends[1]
    moves = np.hypot(step[:, 0], step[:, 1]) > HEADING_M
    if not moves.any():
        return np.zeros(len(xz))
    last = np.maximum.accumulate(np.where(moves, np.arange(len(xz)), -1))
    # before the first motion, the heading is that of the first motion
    last[last < 0] = int(np.argmax(moves))
    # headings turn left from +X, and left is -Z in a world whose +Y is up
    return np.arctan2(-step[last, 1], step[last, 0])


def on_floor(poses: Array) -> Array:
    """Return upright poses [N, 7] at height 0 with the same positions and headings."""
    return ground_pose(poses[:, [0, 2]], heading_from_quat(poses[:, 3:]).reshape(-1), 0.0).astype(np.float64)


def _offset(tracks: Sequence[Track]) -> Array:
    """Return the whole metres by which the world is moved, so that float32 resolves millimetres."""
    places = np.concatenate([track.poses[:, :3] for track in tracks])
    middle = np.median(places[:, [0, 2]], axis=0)
    if np.abs(middle).max() < FAR_M:
        return np.zeros(3)
    return np.array([np.round(middle[0]), 0.0, np.round(middle[1])])
