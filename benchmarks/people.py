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
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.geometry import IDENTITY_POSE, Array
from h3data.mesh.mesh import Mesh
from h3data.recording import Recording
from h3data.scene import Asset, Box, FreeSpace, Instance, Room, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
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
POINTS, EVERY = 200, 5
"""Number of points that sample the floor around a person, and number of steps between samples."""
GRIDLOCK_S, GETS_ON_M = 20, 0.5


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
    """Positions [T, P, 2] [m]."""
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
        return cls(xz, np.diff(xz, axis=0) * RATE, touching, room, floor_around(scene, free, xz), goes)


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
    """Return figures of several walks, each with its unit."""
    free_speeds, closest, sides = [], [], []
    density, speeds, standing, rooms, going = [], [], [], [], []
    contacts = gridlocks = 0
    hours = 0.0
    for xz, velocity, touching, room, floor, goes in walks:
        speed = np.hypot(*velocity.transpose(2, 0, 1))
        gaps = np.hypot(*(xz[:-1, :, None] - xz[:-1, None]).transpose(3, 0, 1, 2))
        gaps[:, np.arange(xz.shape[1]), np.arange(xz.shape[1])] = np.inf
        apart = round(PLACES_S * RATE)
        way = np.hypot(*(xz[apart:] - xz[:-apart]).transpose(2, 0, 1)) / PLACES_S
        near = gaps[: len(way)]
        walking, alone = way > WALKING_MPS, near.min(2) > ALONE_M
        free_speeds += [float(np.median(way[rows, k])) for k, rows in enumerate((walking & alone).T) if rows.sum() > 60]
        density.append((((near < AROUND_M).sum(2) + 1) / floor[: len(way)])[walking])
        speeds.append(way[walking])
        rooms.append(room[: len(way)][walking])
        standing.append((speed < 0.1).ravel())
        going.append(speed[goes[: len(speed)]])
        contacts += int(touching.sum())
        hours += xz.shape[0] * xz.shape[1] / RATE / 3600
        window = GRIDLOCK_S * RATE
        for start in range(0, len(xz) - window, window):
            rows = slice(start, start + window)
            wants = goes[rows].all(0)
            gridlocks += bool(wants.any() and (np.ptp(xz[rows][:, wants], axis=0).max(1) < GETS_ON_M).all())
        for a, b in combinations(range(xz.shape[1]), 2):
            near = np.flatnonzero(np.diff(np.concatenate([[0], gaps[:, a, b] < NEAR_M, [0]])))
            for first, last in zip(near[::2], near[1::2], strict=True):
                at = first + int(np.argmin(gaps[first:last, a, b]))
                closest.append(gaps[at, a, b])
                va, vb = velocity[at, a], velocity[at, b]
                if va @ vb < -0.7 * np.hypot(*va) * np.hypot(*vb) and min(np.hypot(*va), np.hypot(*vb)) > 0.2:
                    towards = xz[at, b] - xz[at, a]
                    sides.append(va[0] * towards[1] - va[1] * towards[0] > 0)
    around, fast, space = (np.concatenate(parts) for parts in (density, speeds, rooms))
    by_density, in_open = (np.polyfit(around[rows], fast[rows], 1)[0] for rows in (space > -np.inf, space > OPEN_M))
    least, right = np.array(closest), float(np.mean(sides)) if sides else np.nan
    return {
        "person_hours": (hours, "h"),
        "speed_mps": (float(np.mean(free_speeds)), "m/s"),
        "speed_sd_mps": (float(np.std(free_speeds)), "m/s"),
        "speed_drop_mps": (-0.1 * float(by_density), "m/s"),
        "speed_drop_open_mps": (-0.1 * float(in_open), "m/s"),
        "narrow_share": (float(np.mean(space < CrowdSpec().narrow_m)), "share"),
        "encounters": (len(least), "n"),
        "closest_p5_m": (float(np.percentile(least, 5)), "m"),
        "below_050": (float(np.mean(least < 0.5)), "share"),
        "below_035": (float(np.mean(least < 0.35)), "share"),
        "majority_side": (max(right, 1 - right), "share"),
        "standing": (float(np.mean(np.concatenate(standing))), "share"),
        "progress_mps": (float(np.mean(np.concatenate(going))), "m/s"),
        "contacts_per_person_hour": (contacts / hours, "steps"),
        "gridlocks_per_person_hour": (gridlocks / hours, "n"),
    }


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


def run(
    emit: Emit, *, episodes: int = 2, models: Sequence[str] = (*MODELS, "wander"), places: Sequence[str] = ()
) -> None:
    """Measure models of crowds in ``episodes`` runs of each place; with ``places``, in these alone and without speeds."""
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
            for name, (value, unit) in describe(walks).items():
                emit(f"people.{model}.{place}.{name}", value, unit)
