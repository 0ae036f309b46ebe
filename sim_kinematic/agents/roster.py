"""Who is in a world: any robots and people, as a list of kinds or of built-in bodies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from h3data.bodies import Robot, humanoid_names, load_humanoid, load_robot, robot_names
from h3data.errors import InputError, SceneError, did_you_mean
from h3data.geometry import Array, ground_pose
from h3data.scene import FreeSpace
from sim_kinematic.contact.frames import Body
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.step import least_clearance

ROBOT_BODY, HUMAN_BODY = "quad_arm", "female_0"
"""Of those who are named by their kind."""
DRAWS = 100
"""So often a place is drawn; then it may be half as far from the others, and so on down to `NEAREST_M`."""
NEAREST_M = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """One agent of a world."""

    kind: Literal["robot", "human"]
    name: str
    """In recordings: its kind, with a number where there are several of that kind."""
    model: str
    """Name of the built-in body."""
    body: Body


def cast_of(agents: str | Sequence[str], *, robot: str = ROBOT_BODY, human: str = HUMAN_BODY) -> tuple[Member, ...]:
    """The members that ``agents`` lists: ``robot``, ``human``, names of built-in bodies, or .npz files of people, as a sequence
    or with commas between. Robots come first, as in the state and in recordings; the order is kept otherwise.

    ``robot`` and ``human`` are the bodies of those who are named by their kind.

    Raises:
        InputError: nobody, or somebody who does not exist; the message lists who does.
    """
    listed = agents.split(",") if isinstance(agents, str) else list(agents)
    listed = [name.strip() if isinstance(name, str) else name for name in listed]
    if not listed or listed == [""]:
        raise InputError("Expected at least one agent: robot, human, or the name of a built-in body; got none.")
    robots, people = list(robot_names()), list(humanoid_names())
    models = [{"robot": robot, "human": human}.get(name, name) for name in listed]
    kinds: list[Literal["robot", "human"]] = []
    for name, model in zip(listed, models, strict=True):
        if name not in ("robot", "human") and model not in (*robots, *people) and not str(model).endswith(".npz"):
            there = ("robot", "human", *robots, *people)
            raise InputError(
                f"Unknown agent {name!r}.{did_you_mean(str(name), there)} Expected one of {', '.join(there)}, or a person's "
                ".npz file."
            )
        kinds.append("robot" if name == "robot" or model in robots else "human")
    many, count = Counter(kinds), Counter[str]()
    members = []
    for kind, model in sorted(zip(kinds, models, strict=True), key=lambda pair: pair[0] != "robot"):
        count[kind] += 1
        name = kind if many[kind] == 1 else f"{kind}_{count[kind]}"
        body = load_robot(model) if kind == "robot" else load_humanoid(model)
        members.append(Member(kind=kind, name=name, model=model, body=body))
    return tuple(members)


def kinds_of(cast: Sequence[Member]) -> tuple[str, ...]:
    """The kind of each member."""
    return tuple(member.kind for member in cast)


def draw_places(
    free: FreeSpace, cast: Sequence[Member], rng: np.random.Generator, *, apart_m: float, base: BaseSpec,
    stands_free: Callable[[Member, Array], bool], taken: dict[int, Array] | None = None,
) -> Array:  # fmt: skip
    """Where each member begins, ``(x, z, heading)`` [A, 3]: on one island, ``apart_m`` from everybody if there is room.

    ``taken`` are the places of those who have one already, by number. A robot's base is free of obstacles, and
    ``stands_free`` may look closer at its pose7.

    Raises:
        SceneError: there is no room.
    """
    places = {k: np.asarray(place, np.float64) for k, place in (taken or {}).items()}
    offsets = np.asarray(base.disc_offsets_m)
    for k, member in enumerate(cast):
        if k in places:
            continue
        distance, draws = apart_m, 0
        while True:
            (xz,), heading = free.sample(rng, 1), float(rng.uniform(-np.pi, np.pi))
            others = [place[:2] for place in places.values()]
            fits = all(np.hypot(*(xz - other)) >= distance for other in others)
            fits = fits and (not others or bool(np.isfinite(free.geodesic(xz, others[0]))))
            if fits and isinstance(member.body, Robot):
                clear = least_clearance(free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, offsets)
                pose = ground_pose(xz, heading, free.floor_y)
                fits = clear >= base.disc_radius_m and stands_free(member, pose)
            if fits:
                places[k] = np.append(xz, heading)
                break
            draws += 1
            if draws == DRAWS:
                distance, draws = distance / 2, 0
                if distance < NEAREST_M:
                    raise SceneError(f"Found no place for {len(cast)} agents. Hint: fewer agents, or a larger home.")
    return np.stack([places[k] for k in range(len(cast))])
