"""Depth by which people and robots overlap walls and furniture, measured by FCL.

It plays 50 episodes of each task in the homes of ``h3-homes/test``, or as many as ``--episodes`` says.

``penetration.<task>.above_2cm`` is the share of steps in which any part of any agent is deeper than 2 cm, outside contact that
it intends: while an agent picks or places, the hand, the forearm and what it holds may be in what the object lies on.

``--robot`` measures other robots, by name or URDF; ``--robot all`` every shipped one, minutes for each. Their figures are
called ``penetration.<robot>.<task>``, but those of ``quad_arm``. ``--human`` measures bodies of people, by name or ``all``, who
wander beside ``quad_arm`` and another person: ``penetration.<body>.wander``.

For each task and kind of agent, and each part of its body that ever is deeper than 2 mm: the share of steps in which it is
deeper than 2 mm, 2 cm, 5 cm, and the worst. ``any`` is any part of an agent, ``arm`` arms, hands and what they hold; of people
``walking`` is any part while the hands reach for nothing, ``open_door`` any part in doors and drawers that are moved, and
``carried`` any part in the tray or carton of another person. `h3data_pipelines.validation.penetration` says what depth is.
``robot.handling.through_walls``: picks and places of robots whose straight line from the arm's base to 10 cm over the object
goes through a wall.

The task ``open_homes`` is four people with the routine ``chores`` beside a robot, in as many episodes, in homes that open.

    python -m benchmarks penetration --episodes 10 --robot all --robot fetch.urdf
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot, humanoid_names, load_robot
from h3data.bodies.robots.robot_files import robot_names
from h3data.errors import InputError, SceneError
from h3data.recording import Recording
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_pipelines.validation.penetration import Penetration, penetrations, unintended_depth
from sim_kinematic.agents.robots.arm_clearance import CLEARANCE, arm_links
from sim_kinematic.contact import FclScene, MovingShapes, capsule_transforms, contacts, shapes_from_capsules
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.wander import Wander

Emit = Callable[[str, float, str], None]
DEFAULT_ROBOT, ALL = "quad_arm", "all"
DEPTHS_M = {"2mm": 0.002, "2cm": 0.02, "5cm": 0.05}
BODIES = ("female_0", "male_1", "female_2", "male_2")
WANDERERS, BROADEST = "robot:{robot},human,{human}", "male_1"
WANDER_STEPS = 600
OPEN_HOMES, MOVED = "small2-open", {"door": "open_door", "carried": "carried"}
"""Homes in which people do chores, and the lines of the kinds of things that are moved."""
WALLS = "walls"
"""Name of the instance in our homes."""


def run(emit: Emit, episodes: int = 50, robots: Sequence[str] = (), humans: Sequence[str] = ()) -> None:
    """Emit ``penetration.<task>.above_2cm`` and ``penetration.<task>.<kind>.<part>.*`` of each robot and of each body
    of people who wander; of the default robot where nothing is named.
    """
    bodies = [name for human in humans for name in (humanoid_names() if human == ALL else (human,))]
    for body in dict.fromkeys(bodies):
        _measure(emit, f"penetration.{body}.wander", _wander(episodes, DEFAULT_ROBOT, body))
    robots = robots or (() if bodies else (DEFAULT_ROBOT,))
    names = [name for robot in robots for name in (robot_names() if robot == ALL else (robot,))]
    for robot in dict.fromkeys(names):
        group = "penetration" if robot == DEFAULT_ROBOT else f"penetration.{load_robot(robot).name}"
        for task, recordings in EPISODES.items():
            _measure(emit, f"{group}.{task}", recordings(episodes, robot))


def _measure(emit: Emit, name: str, recordings: Iterator[Recording]) -> None:
    """Emit the figures of some recordings, under a name."""
    depths: dict[tuple[str, str], list[NDArray[np.float64]]] = {}
    crossed: list[bool] = []
    above: list[NDArray[np.bool_]] = []
    for recording in recordings:
        crossed += _through_walls(recording)
        measured = penetrations(recording)
        above.append(unintended_depth(measured) > DEPTHS_M["2cm"])
        for kind, part, depth in _depths(recording, measured):
            depths.setdefault((kind, part), []).append(depth)
    steps = np.concatenate(above) if above else np.zeros(0, np.bool_)
    if not len(steps):  # this robot fits into none of the homes
        return
    emit(f"{name}.above_2cm", float(steps.mean()), f"of {len(steps)} steps, any part of any agent")
    for (kind, part), parts in depths.items():
        depth = np.concatenate(parts)
        if part not in ("any", *MOVED.values()) and depth.max() <= DEPTHS_M["2mm"]:
            continue
        for label, limit in DEPTHS_M.items():
            emit(f"{name}.{kind}.{part}.over_{label}", 100 * float((depth > limit).mean()), "% of steps")
        emit(f"{name}.{kind}.{part}.worst", 1000 * float(depth.max()), "mm")
        emit(f"{name}.{kind}.{part}.steps", len(depth), "steps")
    if crossed:
        emit(f"{name}.robot.handling.through_walls", 100 * float(np.mean(crossed)), "% of picks and places")
        emit(f"{name}.robot.handling.count", len(crossed), "picks and places")


def _through_walls(recording: Recording) -> list[bool]:
    """Return whether a wall is in the straight line, for each pick and place of a robot."""
    replay = Replay(recording)
    events = [e for e in recording.events if e.kind in ("pick", "place") and recording.agents[e.agent].kind == "robot"]
    if not events or replay.scene is None:
        return []
    home, found = FclScene(replay.scene), []
    moving = {body.name: body.moving for body in recording.bodies}
    for event in events:
        body = replay.model(event.agent)
        assert isinstance(body, Robot)
        start = replay.link_matrices(event.agent)[event.step, arm_links(body)[0], :3, 3].astype(np.float64)[None]
        there = recording.columns["object_pose"][event.step, moving[event.target], :3].astype(np.float64)
        end = there[None] + np.array([0.0, CLEARANCE.approach_m, 0.0])
        line = MovingShapes(shapes_from_capsules(start, end, CLEARANCE.line_radius_m))
        line.set_transforms(capsule_transforms(start, end))
        found.append(any(home.names[contact.index_a] == WALLS for contact in contacts(home, line)))
    return found


def _depths(recording: Recording, measured: list[Penetration]) -> Iterator[tuple[str, str, NDArray[np.float64]]]:
    """Yield kind of agent, part, and its depths [T] [m]."""
    for found in measured:
        agent = recording.agents[found.agent]
        yield agent.kind, "any", found.depth_m.max(1)
        yield agent.kind, "arm", found.depth_m[:, found.arm].max(1)
        for kind, part in MOVED.items() if "object_pose" in recording.columns and JOINTS in recording.columns else ():
            yield agent.kind, part, np.where(found.kind == kind, found.unintended_m, 0.0).max(1)
        codes = recording.columns.get(f"agent_{found.agent}.skill")
        if agent.kind == "human" and codes is not None:
            reaches = np.isin(codes, [k for k, name in enumerate(agent.skill_names) if name in ("pick", "place")])
            yield agent.kind, "walking", found.depth_m[~reaches].max(1)
        for part, depth in zip(found.parts, found.depth_m.T, strict=True):
            yield agent.kind, part.replace(" ", "_"), depth


def _homes(episodes: int) -> Iterator[tuple[int, Scene, FreeSpace]]:
    """Yield a seed and a home for each episode, the homes in turn."""
    rules, homes = SocialNavSpec(), named_scenes("h3-homes/test")
    for seed in range(episodes):
        source = homes[seed % len(homes)].source
        yield seed, open_scene(source), open_free_space(source, rules.agent_radius_m, rules.agent_height_m)


def _social_nav(episodes: int, robot: str) -> Iterator[Recording]:
    rules = SocialNavSpec(end_on_collision=False)
    for seed, scene, free in _homes(episodes):
        human = BODIES[seed % len(BODIES)]
        yield simulate(
            SocialNav(), SocialNav().episode(scene, seed=seed, spec=rules, free=free, robot=robot, human=human)
        )


def _rearrange(episodes: int, robot: str) -> Iterator[Recording]:
    for seed, scene, free in _homes(episodes):
        try:
            yield simulate(Rearrange(), Rearrange().episode(scene, seed=seed, free=free, robot=robot))
        except SceneError:  # no room for the task in this home
            continue


def _wander(episodes: int, robot: str, human: str = BROADEST) -> Iterator[Recording]:
    rules, agents = SocialNavSpec(max_steps=WANDER_STEPS), WANDERERS.format(robot=robot, human=human)
    for seed, scene, free in _homes(episodes):
        yield simulate(Wander(), Wander().episode(scene, seed=seed, spec=rules, agents=agents, free=free))


def _open_homes(episodes: int, robot: str) -> Iterator[Recording]:
    rules = SocialNavSpec(max_steps=4 * WANDER_STEPS)
    agents = ",".join([f"robot:{robot}", *(f"human:{body}" for body in BODIES)])
    for seed in range(episodes):
        source = named_scenes(f"{OPEN_HOMES}:{seed}")[0].source
        free = open_free_space(source, rules.agent_radius_m, rules.agent_height_m)
        try:
            episode = Wander().episode(open_scene(source), seed=seed, spec=rules, agents=agents, free=free)
            yield simulate(Wander(), episode, {"human": "orca+chores"})
        except (InputError, SceneError) as fault:  # no chore, or no room, in this home
            print(f"  {OPEN_HOMES}:{seed}: {fault}")


EPISODES: dict[str, Callable[[int, str], Iterator[Recording]]] = {
    "social_nav": _social_nav,
    "rearrange": _rearrange,
    "wander": _wander,
    "open_homes": _open_homes,
}
"""A number of episodes of each task with one robot, in the test homes in turn, or in homes that open."""
