"""Roster of a world: any number of robots and people, as a list of kinds, bodies and files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from h3data.bodies import Robot, humanoid_names, is_robot, load_humanoid, load_robot, robot_name, robot_names
from h3data.bodies.names import JOIN, split_walk
from h3data.bodies.people.look.wardrobe import split_outfit
from h3data.bodies.people.random_humanoid import is_random
from h3data.errors import InputError, SceneError, suggest
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.contact.frames import Body
from sim_kinematic.motion.spec import BaseSpec

Kind = Literal["robot", "human"]
ROBOT_BODY, HUMAN_BODY = "quad_arm", "female_0"
"""Names of the default bodies of agents of kind ``robot`` and ``human``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AgentSpec:
    """Description of one agent of a world."""

    kind: Kind
    name: str
    """Name in recordings: the kind, with a number if there are several agents of it."""
    model: str
    """Name of a body, or a path to one, as `load_robot` and `load_humanoid` take it."""
    body: Body

    @property
    def robot(self) -> Robot:
        """Body of an agent that is known to be a robot."""
        assert isinstance(self.body, Robot), self.name
        return self.body


def common_floor(roster: Sequence[AgentSpec], free: FreeSpace) -> FreeSpace:
    """Return the map on which all agents of an episode can move: without stairs if an agent cannot climb them."""
    return free if all(member.body.climbs_stairs for member in roster) else free.without_stairs


def make_roster(
    agents: str | Sequence[str | Robot], *, robot: str | Path | Robot = ROBOT_BODY, human: str = HUMAN_BODY
) -> tuple[AgentSpec, ...]:
    """Return the agents that ``agents`` lists, robots first, as in states and recordings, otherwise in the given order.

    Args:
        agents: A sequence, or names separated by commas. Each is ``robot`` or ``human``; the name of a body; a file: a
            URDF, a ``robot.toml`` or its folder for a robot, an .npz for a person; or its kind and one of these,
            ``robot:../fetch.urdf``, ``human:male_1``; or a `Robot`. A ``+`` and a file after a person set the gait.
        robot: Body of each ``robot``.
        human: Body of each ``human``.

    Raises:
        InputError: The list is empty, or an entry is unknown; the message lists the known names.
    """
    listed = agents.split(",") if isinstance(agents, str) else list(agents)
    listed = [name.strip() if isinstance(name, str) else name for name in listed]
    if not listed or listed == [""]:
        raise InputError(
            "Expected at least one agent: robot, human, or the name of a built-in body; got none.", code="H3-SIM-020"
        )
    parsed = [_kind_and_model(name, robot=robot_name(robot), human=human) for name in listed]
    total, count = Counter(kind for kind, _ in parsed), Counter[str]()
    roster = []
    # a stable sort: each kind keeps the order of the list
    for kind, model in sorted(parsed, key=lambda pair: pair[0] != "robot"):
        count[kind] += 1
        name = kind if total[kind] == 1 else f"{kind}_{count[kind]}"
        load = {"robot": load_robot, "human": load_humanoid}[kind]
        roster.append(AgentSpec(kind=kind, name=name, model=model, body=load(model)))
    return tuple(roster)


def with_body(human: str | None, body: str) -> str:
    """Return the name of a person with their body filled in.

    If only a motion is named (``+walk.npz``), the person has the episode's own body, else the default one.
    """
    body = body or HUMAN_BODY
    if human is None:
        return body
    return body + human if human.startswith(JOIN) else human


def with_motion(agents: Sequence[str], motion: str) -> tuple[str, ...]:
    """Return agents of `make_roster` in which people named by their body have the gait ``motion`` (``+walk.npz``)."""

    def is_named(name: str) -> bool:
        kind, colon, model = name.partition(":")
        body = model if kind == "human" and colon else name
        return name not in ("robot", "human") and kind != "robot" and is_person(body) and not split_walk(body)[1]

    return tuple(name + motion if is_named(name) else name for name in agents)


def _stored(model: str) -> str:
    """Return the name by which recordings know a person; ``+walk.npz`` alone is the default body."""
    if JOIN not in model:
        return model
    from h3data.bodies.names import stored_name

    return stored_name(with_body(model, HUMAN_BODY))


def _kind_and_model(name: str | Robot, *, robot: str, human: str) -> tuple[Kind, str]:
    if isinstance(name, Robot):
        return "robot", robot_name(name)
    kind, colon, model = name.partition(":") if isinstance(name, str) else ("", "", "")
    if kind == "robot":
        return kind, model if colon else robot
    if kind == "human":
        return kind, _stored(model if colon else human)
    if is_person(str(name)):
        return "human", _stored(name)
    if isinstance(name, str) and is_robot(name):
        return "robot", name
    known = ("robot", "human", *robot_names(), *humanoid_names())
    files = ", a robot's .urdf, robot.toml or folder, or a person's .npz file"
    raise InputError(f"Unknown agent {name!r}.{suggest(str(name), known, more=files)}", code="H3-SIM-019")


def is_person(name: str) -> bool:
    """Return whether a name that is not the kind of an agent names a person.

    People are named by a body, ``random:SEED`` or a file, each possibly with an outfit or a motion.
    """
    body, motion = split_walk(name)
    body, _ = split_outfit(body)
    return body in humanoid_names() or body.endswith(".npz") or is_random(body) or bool(motion and not body)


def kinds_of(roster: Sequence[AgentSpec]) -> tuple[Kind, ...]:
    """Return the kind of each agent."""
    return tuple(agent.kind for agent in roster)


def sample_places(
    scene: Scene,
    free: FreeSpace,
    roster: Sequence[AgentSpec],
    rng: np.random.Generator,
    *,
    apart_m: float,
    rules: BaseSpec,
    taken: Mapping[int, Array] | None = None,
) -> Array:
    """Sample starts of agents, ``(x, z, heading)`` [A, 3]: on one island, ``apart_m`` from others if there is room.

    A robot keeps its base clear of obstacles, by its own discs under these rules, and the rest of it clear of
    furniture. ``taken`` holds the places that agents already have, by number.

    Raises:
        SceneError: There is no room.
    """
    places = {k: np.asarray(place, np.float64) for k, place in (taken or {}).items()}
    robots = roster[: kinds_of(roster).count("robot")]
    fits = {id(agent.body): robot_fits(agent.robot, rules, scene, free) for agent in robots}
    # least distance between two agents at the start [m]
    nearest_m = 1.0
    # places sampled for one agent before the distance to the others is halved, down to 1 m
    most_attempts = 100
    for k, agent in enumerate(roster):
        if k in places:
            continue
        distance, attempts = apart_m, 0
        while True:
            # both are drawn in every attempt, whichever test it fails, so that the stream stays aligned
            (xz,), heading = free.sample(rng, 1), float(rng.uniform(-np.pi, np.pi))
            others = [place[:2] for place in places.values()]
            is_free = all(np.hypot(*(xz - other)) >= distance for other in others)
            # one of the others is enough, as all of them are on one island
            is_free = is_free and (not others or bool(np.isfinite(free.geodesic(xz, others[0]))))
            test = fits.get(id(agent.body))
            if is_free and (test is None or test(xz, heading)):
                places[k] = np.append(xz, heading)
                break
            attempts += 1
            if attempts == most_attempts:
                distance, attempts = distance / 2, 0
                if distance < nearest_m:
                    raise SceneError(
                        f"Found no place for {len(roster)} agents. Hint: fewer agents, or a larger home.",
                        code="H3-SIM-021",
                    )
    return np.stack([places[k] for k in range(len(roster))])
