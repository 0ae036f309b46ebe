"""Task ``scenarios``, which places a card's situation in a home where it fits, and otherwise in a small floor plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, SceneError
from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from h3data_crowds.cards import ALL, Card, Layout, PlaceKind, choose_cards, load_cards, sample_layout
from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
from h3data_crowds.places import Frame, axes_of, build_plan, find_frame
from h3data_crowds.scripted import ScriptedPerson
from sim_kinematic.agents.roster import AgentSpec, common_floor, kinds_of
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.crowd.traits import sample_traits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.sensing.table import Sensor
from sim_kinematic.tasks.codec import EpisodePlace, TaskCodec, TaskRecord
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.task import TaskUsage

LAYOUTS = 6
"""Number of layouts of a card that are sampled for a home before a floor plan is built instead."""
STOP_M = 1.4
"""Distance from the person within which a robot that follows observes its own position as the goal [m]."""
LEAD_M = 3.5
"""Distance from the person beyond which a robot that leads observes its own position as the goal [m]."""
ASIDE_M, AHEAD_M = 1.0, 0.5
"""Goal of a robot that accompanies a person: its distances to the side and ahead of the person [m]."""
GESTURES = ("", "wait", "proceed")


@dataclass(frozen=True, kw_only=True)
class ScenarioSpec(CrowdNavSpec):
    """Rules in addition to those of `CrowdNav`."""

    max_steps: int = 1200
    card: str = ""
    """Names of cards separated by commas, or ``all``; an episode's seed selects one. Empty selects the task's own
    cards.
    """
    where: str = "auto"
    """Places of episodes: ``home`` (where the card fits), ``plan`` (floor plans), ``auto`` (a plan if the home does not
    fit).
    """
    follow_min_m: float = 1.0
    follow_max_m: float = 2.0
    """Largest distance to a person at which the robot counts as following them (Puig et al. 2023) [m]."""
    share: float = 0.5
    """Smallest share of the time until the person's arrival in which a robot follows or accompanies them."""
    beside_m: float = 1.6
    """Largest distance to the side of a person whom the robot accompanies [m]."""
    along_m: float = 0.9
    """Largest distance along the direction of walking of a person whom the robot accompanies [m]."""
    passage_m: float = 0.6
    """Radius around the frame's origin that a robot which gives way must not enter before the person has passed [m]."""
    group_m: float = 0.7
    """Radius of the space inside a group that nobody may cross (o-space, Kendon 1990) [m]."""

    def __post_init__(self) -> None:
        if self.card:
            choose_cards(self.card)
        if self.where not in ("auto", "home", "plan"):
            raise InputError(f"Expected where as auto, home or plan, got {self.where!r}.", code="H3-TASK-077")


class ScenarioCodec(TaskCodec):
    """Codec of scenario episodes that rebuilds their floor plans from files."""

    def instruction(self, episode: Episode) -> str:
        """Return the text of the episode's card."""
        return load_cards()[episode.extra["card"]].text

    def episode(self, record: TaskRecord, place: EpisodePlace) -> Episode:
        """Return the episode of a record, in its floor plan if it has one."""
        if record.extra.get("where") == "plan":
            kind, spec = load_cards()[choose_cards(record.extra["card"])[0]].place, place.spec
            place = replace(
                place, scene=build_plan(kind), free=_plan_floor(kind, spec.agent_radius_m, spec.agent_height_m)
            )
        return super().episode(record, place)


class Scenarios(CrowdNav):
    """Task to reach the goal of a scenario card among its people, by the rules of its mode."""

    Spec: ClassVar[type[Any]] = ScenarioSpec
    agents: ClassVar[tuple[str, ...]] = ("robot", *["human"] * 6)
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        **CrowdNav.policies,
        "human": {"card": lambda task, episode, number: _person(episode, number)},
    }
    defaults: ClassVar[Mapping[str, str]] = {"robot": "dwa", "human": "card"}
    sensors: ClassVar[Mapping[str, Sensor]] = {
        **CrowdNav.sensors,
        # 0: none, 1: wait, 2: proceed
        "gesture": Sensor(
            lambda m: np.array([[float(GESTURES.index(episode.extra["gesture"]))] for episode in m.episodes]),
            [0.0],
            [2.0],
            kinds=("robot",),
        ),
    }
    cards: ClassVar[str] = ALL
    """Names of the task's cards, used if the rules name none."""
    usage: ClassVar[TaskUsage] = TaskUsage(env_rules=ScenarioSpec(card="crowd_navigation"))

    @property
    def codec(self) -> ScenarioCodec:
        """Codec that restores floor plans."""
        return ScenarioCodec(self)

    def sample(self, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: tuple[AgentSpec, ...]) -> Episode:
        """Sample a layout of a card and find a place for it; agents in excess of the card's are left out.

        Raises:
            InputError: There is no such card, or the roster has too few agents for it.
            SceneError: The card does not fit the home (``where="home"``).
        """
        names = choose_cards(spec.card or self.cards)
        rng = generator(seed, "scenario")
        name = names[int(rng.integers(len(names)))]
        card = load_cards()[name]
        count = kinds_of(roster).count("robot")
        robots, people = roster[:count], roster[count:]
        if not robots or len(people) < len(card.people):
            raise InputError(
                f"The card {name} needs a robot and {len(card.people)} people, the roster has {len(robots)} and "
                f"{len(people)}. Hint: name more agents, or none: a card has its own.",
                code="H3-TASK-078",
            )
        roster = (robots[0], *people[: len(card.people)])
        where: Literal["home", "plan"] = "home"
        free = common_floor(roster, free)
        found = _in_home(scene, free, card, rng, roster[0], spec) if spec.where != "plan" else None
        if found is None and spec.where == "home":
            raise SceneError(
                f"The card {name} does not fit {scene.name}: none of the places tried is a free {card.place} of its size. "
                "Hint: where=auto builds a plan instead.",
                code="H3-TASK-079",
            )
        if found is None:
            where, scene = "plan", build_plan(card.place)
            free = _plan_floor(card.place, spec.agent_radius_m, spec.agent_height_m)
            found = sample_layout(card, rng), Frame(np.zeros(2), 0.0)
        layout, frame = found
        extra = {
            "card": name,
            "mode": card.mode,
            "where": where,
            "goal": frame.to_world(layout.robot[1]).tolist(),
            "origin": frame.origin.tolist(),
            "gesture": card.gesture,
            "people": [
                {
                    "role": person.role,
                    "path": frame.to_world(layout.paths[k]).tolist(),
                    "speed": layout.speeds[k],
                    "delay": layout.delays[k],
                }
                for k, person in enumerate(card.people)
            ],
        }
        starts = np.array(
            [
                _looking(frame, layout.robot[0], layout.robot[1] if card.place == "hall" else np.zeros(2)),
                *(
                    _looking(frame, start, path[0] if len(path) and card.place == "hall" else np.zeros(2))
                    for start, path in zip(layout.starts, layout.paths, strict=True)
                ),
            ]
        )
        return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts, extra=extra)

    # --- rules ----------------------------------------------------------------------------------------------------------
    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any]:
        """Store the goals, the time that the robot has spent near people, and its violations of the rules."""
        zeros, people = 0.0 * play.steps, len(play.world.state.people)
        more = {"kept": zeros, "walked": zeros.copy(), "rude": play.steps < 0}
        return {**super().begin(play, rows), **more, "passed": np.zeros((len(zeros), people), np.bool_)}

    def goals(self, play: WorldRollout) -> Any:
        """Return the current goal of each world's robot (x, z) [W, 2] [m], which moves with people in some modes."""
        goals = play.extra("goal")
        own = play.world.state.agents[0].xz
        for w, episode in enumerate(play.episodes):
            mode = episode.extra["mode"]
            if mode not in ("follow", "lead", "accompany") or not play.world.state.people:
                continue
            person = play.world.state.people[0]
            away = float(np.hypot(*(person.xz[w] - own[w])))
            if mode == "lead":
                goals[w] = own[w] if away > LEAD_M else goals[w]
            elif mode == "follow":
                goals[w] = own[w] if away < STOP_M else person.xz[w]
            else:
                angle, side = (
                    float(person.heading[w]),
                    float(np.sign(_offset(person.xz[w], person.heading[w], own[w])[1])),
                )
                aim = person.xz[w] + np.array([AHEAD_M, ASIDE_M * (side or 1.0)]) @ axes_of(np.array(angle))
                fits = bool(episode.free.is_navigable(aim))
                goals[w] = aim if fits else person.xz[w] if away > STOP_M else own[w]
        return goals

    def moved_goals(self, play: WorldRollout) -> Any:
        """Return the goal of the robot of each world after a step (x, z) [W, 2] [m]."""
        return self.goals(play)

    def achieved(self, play: WorldRollout, touching: Any) -> tuple[Any, Any]:
        """Return whether the robot has completed its scenario, and whether the episode has ended, bool [W] each."""
        memory, spec, world = play.memory, play.spec, play.world
        own, people = world.state.agents[0].xz, world.state.people
        success, over = play.steps < 0, play.steps < 0
        for w, episode in enumerate(play.episodes):
            extra, robot = episode.extra, own[w]
            at = [person.xz[w] for person in people]
            there = bool(np.hypot(*(np.array(extra["goal"]) - robot)) < spec.arrive_m)
            origin, mode = np.array(extra["origin"]), extra["mode"]
            if mode in ("follow", "accompany"):
                ends = np.array(extra["people"][0]["path"][-1])
                if mode == "follow":
                    keeps = spec.follow_min_m <= float(np.hypot(*(at[0] - robot))) <= spec.follow_max_m
                else:
                    along, aside = np.abs(_offset(at[0], people[0].heading[w], robot))
                    keeps = along <= spec.along_m and aside <= spec.beside_m
                memory["kept"][w] += keeps
                memory["walked"][w] += 1
                over[w] = np.hypot(*(ends - at[0])) < 2 * spec.arrive_m
                success[w] = over[w] and keeps and memory["kept"][w] >= spec.share * memory["walked"][w]
            elif mode == "lead":
                over[w] = success[w] = there and np.hypot(*(at[0] - robot)) < spec.follow_max_m
            else:
                if mode == "give_way":
                    for k, person in enumerate(extra["people"]):
                        out = np.array(person["path"][0]) - origin
                        memory["passed"][w, k] |= (at[k] - origin) @ out > spec.passage_m * np.hypot(*out)
                    waits = not memory["passed"][w].all()
                    memory["rude"][w] |= waits and np.hypot(*(robot - origin)) < spec.passage_m
                elif mode == "join":
                    memory["rude"][w] |= np.hypot(*(robot - origin)) < spec.group_m
                over[w], success[w] = there, there and not memory["rude"][w]
        return success & ~touching, over & ~touching

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Return an `AgentView` whose ``extra`` has the current goal under ``goal``, and the gestures of people."""
        view = play.agent_view(agent, world)
        return view._replace(extra={**view.extra, "goal": play.memory["goal"][world].tolist()}) if agent == 0 else view


class CrowdFollow(Scenarios):
    """Task to follow a person at a distance of 1 to 2 m."""

    agents: ClassVar[tuple[str, ...]] = ("robot", "human")
    cards: ClassVar[str] = "following"
    usage: ClassVar[TaskUsage] = TaskUsage()


class CrowdLead(CrowdFollow):
    """Task to lead a person to a place."""

    cards: ClassVar[str] = "leading"


class CrowdAccompany(CrowdFollow):
    """Task to walk beside a person."""

    cards: ClassVar[str] = "accompanying"


class CrowdGiveWay(CrowdFollow):
    """Task to let a person through a door first."""

    cards: ClassVar[str] = "narrow_doorway"


class CrowdJoin(CrowdFollow):
    """Task to take the free place in a group of people who stand and talk."""

    agents: ClassVar[tuple[str, ...]] = ("robot", "human", "human", "human")
    cards: ClassVar[str] = "join_group"


def _offset(xz: Array, heading: Any, other: Array) -> Array:
    """Return the place of another person (along, right) [2] [m] in a person's frame."""
    return np.asarray(axes_of(np.asarray(heading)) @ (other - xz))


def _looking(frame: Frame, point: Array, towards: Array) -> tuple[float, float, float]:
    """Return the start (x, z, heading) at a point of a frame, with the view to another one."""
    here, there = frame.to_world(point), frame.to_world(towards)
    gap = there - here
    return float(here[0]), float(here[1]), float(np.arctan2(-gap[1], gap[0]))


def _in_home(
    scene: Scene, free: FreeSpace, card: Card, rng: np.random.Generator, robot: AgentSpec, spec: ScenarioSpec
) -> tuple[Layout, Frame] | None:
    """Return a layout of a card and its frame on the floor of a home; None if it does not fit."""
    fits = robot_fits(robot.robot, spec.robot, scene, free)
    for _ in range(LAYOUTS):
        layout = sample_layout(card, rng)
        frame = find_frame(free, layout, card.place, rng)
        if frame is not None:
            x, z, heading = _looking(frame, layout.robot[0], layout.robot[1] if card.place == "hall" else np.zeros(2))
            if fits(np.array([x, z]), heading):
                return layout, frame
    return None


@lru_cache(maxsize=32)
def _plan_floor(kind: PlaceKind, radius_m: float, height_m: float) -> FreeSpace:
    return FreeSpace.from_scene(build_plan(kind), radius_m=radius_m, height_m=height_m)


def _person(episode: Episode, number: int) -> ScriptedPerson:
    walker = episode.spec.human
    traits = sample_traits(episode.seed, number, walker.speed_mps)
    return ScriptedPerson(episode.free, episode.extra["people"][number - 1], episode.extra, traits, walker)
