"""Motion of people of crowds among each other: speeds, distances, sides and cost, for each model of crowds.

24 people walk about an empty hall of 18 x 12 m, and 4 in each of three homes of ``h3-homes/val``, twice for ``MINUTES`` each.
In the same homes two people walk together beside two who talk (``company``), and four follow routines (``mornings``).
Measured pedestrians (ETH and UCY data sets, our own statistics) give the ranges to compare with. Their places are known every
0.4 s, and who walks in them is faster than 0.3 m/s from one place to the next. Ours count as walking by the same rule:

``speed_mps``, ``speed_sd_mps``
    Mean and standard deviation, between people, of the median speed of those who walk with nobody within 2 m: 0.84 to 1.48
    and 0.30 to 0.42 outdoors. Homes make people turn, so the hall's figure is the one to compare.
``speed_drop_mps``
    Loss of speed for each 0.1 person/m2 of floor within 2 m, the person included: 0.02 to 0.09 outdoors, where all of this
    circle is floor. In homes part of it is walls, furniture, or other sides of them.
``speed_drop_open_mps``, ``narrow_share``
    The same of those who are 0.8 m from walls and furniture or more; share of walking nearer than 0.55 m, where two people
    cannot pass each other.
``closest_p5_m``, ``below_050``, ``below_035``
    Least distance between two centres in an encounter (within 3 m): 5th percentile (0.61 to 0.79), and shares below
    0.5 m (0.004 to 0.019) and 0.35 m (0 to 0.003).
``majority_side``
    Share of head-on encounters that pass on the more frequent side: 0.54 to 0.78.
``standing``, ``progress_mps``
    Share of person-steps slower than 0.1 m/s: 0.05 to 0.34. Mean speed of all who are on the way, those who stand and wait
    included: rules by which people wait instead of walking slowly lower the loss of speed, and this too.
``contacts_per_person_hour``, ``gridlocks_per_person_hour``
    Steps in which bodies touch, by FCL; periods of 20 s in which nobody of those who are on the way all the time gets on by
    0.5 m, while others may stay somewhere on purpose, as people do who talk. Both should be 0.

``people.<model>.p8_steps_per_cpu_s``, ``p24_steps_per_cpu_s``: steps of 8 and 24 people in a large home, with contact and
recording. ``people.<model>.w16_p4_env_steps_per_cpu_s``: steps of 16 worlds of ``crowd_nav`` with 4 people each, all worlds
counted. ``wander`` is the model with right of way, which is slower by design.

    python -m benchmarks people                                     # both models of crowds, in all places
    python -m benchmarks people --model social_force --place homes  # one model in one place
    python -m benchmarks people --tracks mine.csv                   # people of a file of tracks, by the same measures

``spacing_m`` is the median distance between members of a group who walk: 0.69 to 1.15. At the end, a table shows all
figures beside those of measured pedestrians. ``--tracks`` takes a file that ``h3data import`` reads without options, or a
recording that it has written; `contacts` and ``gridlocks`` are not measured there, and all floor counts as free.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.errors import H3DataError
from h3data.formats import ImportRequest
from h3data.geometry import IDENTITY_POSE, Array
from h3data.mesh.mesh import Mesh
from h3data.recording import Recording
from h3data.scene import Asset, Box, FreeSpace, Instance, Room, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_ros.track_import import read_tracks
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.crowd.traits import CrowdSpec
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.wander import Wander

Emit = Callable[[str, float, str], None]
MODELS = ("orca", "social_force")
MINUTES = 2
RATE = 30
HALL_M = (18.0, 12.0)
HOMES = ("h3-homes/val#0", "h3-homes/val#3", "h3-homes/val#5")
NEAR_M, ALONE_M, AROUND_M = 3.0, 2.0, 2.0
PLACES_S, WALKING_MPS = 0.4, 0.3
"""Time between two positions of measured pedestrians [s], and speed between them above which a person walks [m/s]."""
COMPANY = {"company": ("walk1", "walk1", "talk1", "talk1"), "mornings": ("morning",) * 4}
"""People in company in the same homes, and people who follow a routine."""
OPEN_M = 0.8
ROWS = 64
"""Number of rows of which all distances are computed at once."""
POINTS, EVERY = 200, 5
"""Number of points that sample the floor around a person, and number of steps between samples."""
GRIDLOCK_S, GETS_ON_M = 20, 0.5
ALONE_S = 2.0
"""Least time that somebody walks with nobody near, for a speed of their own [s]."""
MEASURED: Mapping[str, tuple[float, float]] = {
    "speed_mps": (0.84, 1.48),
    "speed_sd_mps": (0.30, 0.42),
    "speed_drop_mps": (0.02, 0.09),
    "closest_p5_m": (0.61, 0.79),
    "below_050": (0.004, 0.019),
    "below_035": (0.0, 0.003),
    "spacing_m": (0.69, 1.15),
    "majority_side": (0.54, 0.78),
    "standing": (0.05, 0.34),
}
"""Lowest and highest figure of five sets of measured pedestrians (ETH and UCY)."""


def hall(width: float = HALL_M[0], depth: float = HALL_M[1]) -> Scene:
    """Return an empty room with walls, ``width`` x ``depth`` [m]."""
    blocks = {
        "floor": ((-0.1, -0.1, -0.1), (width + 0.1, 0.0, depth + 0.1)),
        "west": ((-0.1, 0.0, -0.1), (0.0, 2.6, depth + 0.1)),
        "east": ((width, 0.0, -0.1), (width + 0.1, 2.6, depth + 0.1)),
        "north": ((0.0, 0.0, -0.1), (width, 2.6, 0.0)),
        "south": ((0.0, 0.0, depth), (width, 2.6, depth + 0.1)),
    }
    assets = {name: _block(name, np.array(low), np.array(high)) for name, (low, high) in blocks.items()}
    walls = tuple(Instance(name=name, asset=name, pose=IDENTITY_POSE.copy(), motion="static") for name in blocks)
    room = Room(name="hall", category="living", rectangles=np.array([[0.0, 0.0, width, depth]]))
    return Scene(name="hall", assets=assets, instances=walls, rooms=(room,))


def _block(name: str, low: Array, high: Array) -> Asset:
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))], np.int32)
    mesh = Mesh(vertices=corners.astype(np.float32), faces=faces, colors=np.full((8, 3), 150, np.uint8))
    shape = Box(pose=np.concatenate([(low + high) / 2, [0, 0, 0, 1]]), half_extents=(high - low) / 2)
    return Asset(
        name=name,
        mesh=mesh,
        category="floor" if name == "floor" else "wall",
        shapes=() if name == "floor" else (shape,),
    )


def walk(scene: Scene, free: FreeSpace, people: int, policy: str, seed: int, steps: int) -> Recording:
    """Return a recording of people who walk about a scene under a policy."""
    task, roster = Wander(), make_roster(["human"] * people)
    spec = SocialNavSpec(max_steps=steps, spawn_distance_m=0.8)
    episode = task.sample(scene, free, seed, spec, roster)
    return simulate(task, episode, {"human": policy})


class Walks(NamedTuple):
    """Motion of P people over T steps."""

    xz: Array
    """Positions [T, P, 2] [m]; NaN where nobody has seen the person."""
    velocity: Array
    """Velocities [T - 1, P, 2] [m/s]."""
    touching: NDArray[np.bool_]
    """Mask of steps in which any agents touch, shape [T]."""
    room: Array
    """Distance of each person to walls and furniture, shape [T, P] [m]."""
    floor: Array
    """Area of the floor on which people can walk within `AROUND_M` of each person [T, P] [m2]."""
    goes: NDArray[np.bool_]
    """Whether each person is on the way, rather than staying somewhere to do something [T, P]."""
    groups: tuple[tuple[int, ...], ...] = ()
    """People of each group that walks together."""
    rate: float = RATE
    """Steps per second [1/s]."""

    @classmethod
    def of(cls, recording: Recording, scene: Scene, free: FreeSpace) -> Walks:
        """Return positions and velocities of a recording's people in a home and on its floor."""
        columns, people = recording.columns, len(recording.agents)
        xz = np.stack([columns[f"agent_{k}.base_pose"][:, [0, 2]] for k in range(people)], 1).astype(np.float64)
        room = free.signed_distance(xz.reshape(-1, 2)).reshape(xz.shape[:2])
        goes = np.ones(room.shape, np.bool_)
        for event in recording.events:
            if event.kind in ("activity", "walks_to"):
                goes[event.step :, event.agent] = event.kind == "walks_to"
        touching = np.asarray(columns["metrics.collision"])
        groups: dict[str, list[int]] = {}
        for name, facts in recording.episode.info.get("people", {}).items():
            if facts["group"].startswith("walk"):
                groups.setdefault(facts["group"], []).append([agent.name for agent in recording.agents].index(name))
        together = tuple(map(tuple, groups.values()))
        return cls(xz, np.diff(xz, axis=0) * RATE, touching, room, floor_around(scene, free, xz), goes, together)

    def only(self, people: list[int]) -> Walks:
        """Return the motion of some of the people, without their groups."""
        own = {name: getattr(self, name)[:, people] for name in ("xz", "velocity", "room", "floor", "goes")}
        return self._replace(**own, groups=())

    @classmethod
    def of_tracks(cls, recording: Recording) -> Walks:
        """Return the motion of the people of an imported file of tracks, in rows of one rate."""
        people = [k for k, agent in enumerate(recording.agents) if agent.kind == "human"]
        rate = 1e9 / recording.episode.dt_ns
        seconds = (recording.columns["time_ns"] - recording.columns["time_ns"][0]) * 1e-9
        rows = np.round(seconds * rate).astype(np.int64)
        xz = np.full((rows[-1] + 1, len(people), 2), np.nan)
        for p, k in enumerate(people):
            xz[rows, p] = recording.columns[f"agent_{k}.base_pose"][:, [0, 2]]
        shape = xz.shape[:2]
        floor, room = np.full(shape, np.pi * AROUND_M**2), np.full(shape, np.inf)
        nothing = np.zeros(len(xz), np.bool_)
        return cls(xz, np.diff(xz, axis=0) * rate, nothing, room, floor, np.ones(shape, np.bool_), rate=rate)

    def others(self) -> tuple[Array, NDArray[np.int64], list[tuple[int, int]]]:
        """Return distances [T, P] [m] to the nearest other person, numbers [T, P] of people within `AROUND_M`, and pairs
        who are within `NEAR_M` at some time.
        """
        nearest, around = np.full(self.xz.shape[:2], np.inf), np.zeros(self.xz.shape[:2], np.int64)
        near = np.zeros((self.xz.shape[1],) * 2, np.bool_)
        for first in range(0, len(self.xz), ROWS):  # all at once, hundreds of people take gigabytes
            at = self.xz[first : first + ROWS]
            gaps = np.hypot(*(at[:, :, None] - at[:, None]).transpose(3, 0, 1, 2))
            gaps[:, np.arange(at.shape[1]), np.arange(at.shape[1])] = np.inf
            nearest[first : first + ROWS] = np.fmin.reduce(gaps, axis=2)
            around[first : first + ROWS] = (gaps < AROUND_M).sum(2)
            near |= (gaps < NEAR_M).any(0)
        return nearest, around, [(a, b) for a, b in np.argwhere(near).tolist() if a < b]


def floor_around(scene: Scene, free: FreeSpace, xz: Array) -> Array:
    """Return the area [T, P] [m2] of the free floor of rooms within `AROUND_M` of places [T, P, 2], by a sunflower."""
    k = np.arange(POINTS) + 0.5
    ring = AROUND_M * np.sqrt(k / POINTS) * np.stack([np.cos(2.4 * k), np.sin(2.4 * k)])
    at = xz[::EVERY, :, None] + ring.T
    rooms = np.concatenate([room.rectangles for room in scene.rooms])
    inside = np.zeros(at.shape[:-1], np.bool_)
    for x0, z0, x1, z1 in rooms:
        inside |= (at[..., 0] > x0) & (at[..., 0] < x1) & (at[..., 1] > z0) & (at[..., 1] < z1)
    area = np.pi * AROUND_M**2 * (inside & (free.signed_distance(at) > 0)).mean(-1)
    return np.repeat(area, EVERY, axis=0)[: len(xz)]


def describe(walks: Sequence[Walks]) -> dict[str, tuple[float, str]]:
    """Return figures of several walks, each with its unit; those that nobody's motion tells are left out."""
    free_speeds, closest, sides, spacing = [], [], [], []
    density, speeds, standing, rooms, going = [], [], [], [], []
    contacts = gridlocks = 0
    hours = 0.0
    for walk in walks:
        xz, velocity, touching, room, floor, goes, groups, rate = walk
        speed = np.hypot(*velocity.transpose(2, 0, 1))
        nearest, around, pairs = walk.others()
        apart = round(PLACES_S * rate)
        way = np.hypot(*(xz[apart:] - xz[:-apart]).transpose(2, 0, 1)) / PLACES_S
        walking, alone = way > WALKING_MPS, nearest[: len(way)] > ALONE_M
        for k, rows in enumerate((walking & alone).T):
            if rows.sum() > ALONE_S * rate:
                free_speeds.append(float(np.median(way[rows, k])))
        density.append(((around[: len(way)] + 1) / floor[: len(way)])[walking])
        speeds.append(way[walking])
        rooms.append(room[: len(way)][walking])
        known = ~np.isnan(speed)
        standing.append(speed[known] < 0.1)
        going.append(speed[known & goes[: len(speed)]])
        contacts += int(touching.sum())
        hours += float((~np.isnan(xz[..., 0])).sum()) / rate / 3600
        window = round(GRIDLOCK_S * rate)
        for start in range(0, len(xz) - window, window):
            rows = slice(start, start + window)
            wants = goes[rows].all(0) & ~np.isnan(xz[rows, :, 0]).any(0)
            gridlocks += bool(wants.any() and (np.ptp(xz[rows][:, wants], axis=0).max(1) < GETS_ON_M).all())
        for group in groups:
            for a in group:
                apart_m = xz[: len(way), [a]] - xz[: len(way), [b for b in group if b != a]]
                spacing.append(np.hypot(*apart_m.transpose(2, 0, 1)).min(1)[walking[:, group].all(1)])
        for a, b in pairs:
            gap = np.hypot(*(xz[:-1, a] - xz[:-1, b]).T)
            near = np.flatnonzero(np.diff(np.concatenate([[0], gap < NEAR_M, [0]])))
            for first, last in zip(near[::2], near[1::2], strict=True):
                at = first + int(np.argmin(gap[first:last]))
                if any(a in group and b in group for group in groups):
                    continue  # the data sets count strangers alone
                closest.append(gap[at])
                va, vb = velocity[at, a], velocity[at, b]
                if va @ vb < -0.7 * np.hypot(*va) * np.hypot(*vb) and min(np.hypot(*va), np.hypot(*vb)) > 0.2:
                    towards = xz[at, b] - xz[at, a]
                    sides.append(va[0] * towards[1] - va[1] * towards[0] > 0)
    around, fast, space = (np.concatenate(parts) for parts in (density, speeds, rooms))
    by_density, in_open = (_slope(around[rows], fast[rows]) for rows in (space > -np.inf, space > OPEN_M))
    least, right = np.array(closest), float(np.mean(sides)) if sides else np.nan
    figures = {
        "person_hours": (hours, "h"),
        "speed_mps": (float(np.mean(free_speeds)) if free_speeds else np.nan, "m/s"),
        "speed_sd_mps": (float(np.std(free_speeds)) if free_speeds else np.nan, "m/s"),
        "speed_drop_mps": (-0.1 * by_density, "m/s"),
        "speed_drop_open_mps": (-0.1 * in_open, "m/s"),
        "narrow_share": (float(np.mean(space < CrowdSpec().narrow_m)), "share"),
        "encounters": (len(least), "n"),
        "closest_p5_m": (float(np.percentile(least, 5)) if closest else np.nan, "m"),
        "below_050": (float(np.mean(least < 0.5)) if closest else np.nan, "share"),
        "below_035": (float(np.mean(least < 0.35)) if closest else np.nan, "share"),
        "spacing_m": (float(np.median(np.concatenate(spacing))) if spacing else np.nan, "m"),
        "majority_side": (max(right, 1 - right), "share"),
        "standing": (float(np.mean(np.concatenate(standing))), "share"),
        "progress_mps": (float(np.mean(np.concatenate(going))), "m/s"),
        "contacts_per_person_hour": (contacts / hours, "steps"),
        "gridlocks_per_person_hour": (gridlocks / hours, "n"),
    }
    return {name: figure for name, figure in figures.items() if not np.isnan(figure[0])}


def _slope(x: Array, y: Array) -> float:
    """Return the slope of the line through points; NaN if all are at one x."""
    return float(np.polyfit(x, y, 1)[0]) if len(x) and np.ptp(x) > 0 else np.nan


def _home(name: str) -> tuple[Scene, FreeSpace]:
    (named,) = named_scenes(name)
    spec = SocialNavSpec()
    return open_scene(named.source), open_free_space(named.source, spec.agent_radius_m, spec.agent_height_m)


def _env_speed(model: str, worlds: int = 16, steps: int = 300) -> float:
    """Return the steps of an environment of many worlds in a second of CPU time, all worlds counted."""
    env = h3data.make("crowd_nav", "h3-homes/train", num_envs=worlds, partner=model, observations=["goal_gps"])
    env.reset(seed=1)
    still = np.zeros((worlds, 2), np.float32)
    for _ in range(30):  # compiles
        env.step(still)
    began = time.process_time()
    for _ in range(steps):
        env.step(still)
    env.close()
    return worlds * steps / (time.process_time() - began)


def read_walks(file: str) -> Walks:
    """Return the motion of the people of a recording, or of a file of tracks that is read without options.

    Raises:
        SystemExit: the file cannot be read; the message says why.
    """
    path = Path(file)
    try:
        recorded = path.suffix == ".mcap"
        return Walks.of_tracks(h3data.load_recording(path) if recorded else read_tracks(path, tracks=ImportRequest()))
    except (H3DataError, OSError) as fault:
        raise SystemExit(f"error: {fault} Or name a recording that h3data import has written.") from None


def table(columns: Mapping[str, Mapping[str, tuple[float, str]]]) -> str:
    """Return the lines of a table of figures by place or file, beside the range of measured pedestrians."""
    names = list(dict.fromkeys(name for figures in columns.values() for name in figures))
    rows = [["", "measured", *columns]]
    for name in names:
        low, high = MEASURED.get(name, (np.nan, np.nan))
        own = [f"{figures[name][0]:.3g}" if name in figures else "" for figures in columns.values()]
        rows.append([name, f"{low:g} to {high:g}" if name in MEASURED else "", *own])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def run(
    emit: Emit,
    *,
    episodes: int = 2,
    models: Sequence[str] = (*MODELS, "wander"),
    places: Sequence[str] = (),
    tracks: Sequence[str] = (),
) -> None:
    """Measure models of crowds in ``episodes`` runs of each place; with ``places``, in these alone and without speeds.

    With ``tracks``, measure the people of these files instead.
    """
    columns: dict[str, dict[str, tuple[float, str]]] = {}
    for file in tracks:
        found = describe([read_walks(file)])
        columns[Path(file).name] = {
            name: found[name] for name in ("person_hours", "encounters", *MEASURED) if name in found
        }
        for name, (value, unit) in columns[Path(file).name].items():
            emit(f"people.{Path(file).stem}.{name}", value, unit)
    if tracks:
        print(table(columns))
        return
    known = {*MODELS, "wander", "hall", "homes", *COMPANY}
    if unknown := {*models, *places} - known:
        raise SystemExit(
            f"Expected models and places among {', '.join(sorted(known))}; got {', '.join(sorted(unknown))}."
        )
    room = hall()
    floor = FreeSpace.from_scene(room)
    homes = [_home(name) for name in HOMES]
    steps = MINUTES * 60 * RATE
    for model in () if places else models:
        large = _home("large:0")
        walk(*large, 8, model, 0, 30)  # compiles
        for count in (8, 24):
            began = time.process_time()
            walk(*large, count, model, 1, 1800)
            emit(f"people.{model}.p{count}_steps_per_cpu_s", 1800 / (time.process_time() - began), "steps/s")
    for model in (model for model in models if model in MODELS):
        if not places:
            emit(f"people.{model}.w16_p4_env_steps_per_cpu_s", _env_speed(model), "steps/s")
        partners = {"homes": model} | {
            name: ",".join(f"{model}+{word}" for word in words) for name, words in COMPANY.items()
        }
        for place in places or ("hall", *partners):
            people, who = (24, model) if place == "hall" else (4, partners[place])
            walks = [
                Walks.of(walk(*home, people, who, 100 + k, steps), *home)
                for home in ([(room, floor)] if place == "hall" else homes)
                for k in range(episodes)
            ]
            columns[f"{model}, {place}"] = describe(walks)
            for name, (value, unit) in columns[f"{model}, {place}"].items():
                emit(f"people.{model}.{place}.{name}", value, unit)
    print(table(columns))
