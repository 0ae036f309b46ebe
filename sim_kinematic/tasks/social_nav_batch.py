"""W episodes of social navigation side by side, each begun anew when wanted: what the training interfaces step.

An episode is the one that `sim_kinematic.tasks.social_nav.simulate_social_nav` plays with the same scene, seed and actions, bit
for bit, whatever W is. Worlds in one home are stepped together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.geometry import Array, ground_pose
from h3data.habitat.scene_names import named_scenes, open_free_space, open_scene
from h3data.scene import FreeSpace, Scene
from h3data.scene.scene_sets import SceneSource
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.contact.clearance import RobotHumanContact
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.motion.spec import STEP_S, BaseSpec, SocialNavSpec
from sim_kinematic.motion.state import HumanState, RobotState, WorldState
from sim_kinematic.motion.step import drive_robots, walk_humans
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.tasks.describe import bar, in_words
from sim_kinematic.tasks.predicates import is_found
from sim_kinematic.tasks.rewards import Encounter, RewardProfile, RewardStep, SocialNavReward
from sim_kinematic.tasks.social_nav import SocialNavWorld, draw_starts

TRAINING = SocialNavSpec(spawn_distance_m=3.0)
"""The paper's rules for training: they start at least 3 m apart (appendix, social navigation)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """A scene to play in. What it takes to do so is made at first use and kept."""

    source: Scene | SceneSource
    spec: SocialNavSpec
    robot: Robot
    human: Humanoid
    names: tuple[str, str]
    """Of robot and human."""

    @cached_property
    def scene(self) -> Scene:
        """The home."""
        return self.source if isinstance(self.source, Scene) else open_scene(self.source)

    @cached_property
    def free(self) -> FreeSpace:
        """Its free floor."""
        size = self.spec.agent_radius_m, self.spec.agent_height_m
        if isinstance(self.source, Scene):
            return FreeSpace.from_scene(self.source, radius_m=size[0], height_m=size[1])
        return open_free_space(self.source, *size)

    @cached_property
    def _fits(self) -> Callable[[Array, float], bool]:
        return robot_fits(self.robot, self.spec.robot, self.scene, self.free)

    @property
    def is_ready(self) -> bool:
        """Whether home and floor have been made."""
        return "free" in vars(self) and "scene" in vars(self)

    def make(self) -> None:
        """Make home and floor."""
        _ = self.scene, self.free

    def episode(self, seed: int) -> SocialNavWorld:
        """The episode that `SocialNavWorld.create` draws from ``seed``."""
        robot_name, human_name = self.names
        return SocialNavWorld(
            scene=self.scene, free=self.free, seed=seed, spec=self.spec, robot=self.robot, human=self.human,
            starts=draw_starts(self.free, seed, self.spec, fits=self._fits),
            robot_name=robot_name, human_name=human_name,
        )  # fmt: skip


class SocialNavBatch:
    """W worlds, each in one episode of its own."""

    def __init__(
        self,
        scenes: str | Scene | Sequence[str | Scene],
        *,
        worlds: int = 1,
        spec: SocialNavSpec = TRAINING,
        reward: RewardProfile = "paper",
        robot: str = "quad_arm",
        human: str = "female_0",
        driven_human: bool = False,
    ) -> None:
        """
        Args:
            scenes: Where to play: what the command line takes (`h3data.habitat.scene_names.named_scenes`), such as
                ``h3-homes/train`` or ``small:3``, a `Scene`, or several of these. Every episode draws one of them.
            worlds: W.
            spec: The rules.
            reward: Which reward (`sim_kinematic.tasks.rewards`).
            robot: Name of a built-in robot.
            human: Name of a built-in body.
            driven_human: The person is moved by actions; else she walks to random points.

        Raises:
            InputError: there are no such scenes, bodies or rewards, or W is not at least 1.
        """
        if isinstance(worlds, bool) or not isinstance(worlds, int | np.integer) or worlds < 1:
            raise InputError(f"Expected at least 1 world, a whole number, got {worlds!r}.")
        self.spec, self.worlds, self._scenes = spec, int(worlds), scenes
        self.robot, self.human = load_robot(robot), load_humanoid(human)
        self.places = tuple(
            Place(source=source, spec=spec, robot=self.robot, human=self.human, names=(robot, human))
            for source in scene_sources(scenes)
        )
        self.clip = self.human.clip_for_speed(spec.human.speed_mps)
        self.rewards = SocialNavReward(self.worlds, profile=reward, rules=spec)
        self.state = WorldState.zeros(self.worlds)
        (self._robot,), (self._person,) = self.state.robots, self.state.people
        self.before = self.state.copy()
        """The state before the last step."""
        self._moments = tuple(zip(self.before.arrays(), self.state.arrays(), strict=True))
        self.start = self.state.copy()
        """The state in which each world's episode began."""
        self.place = np.full(self.worlds, -1)
        """Index of the scene that each world is in, [W]."""
        self.episodes: list[SocialNavWorld] = []
        """What each world plays; empty before the first `begin`."""
        self.steps = np.zeros(self.worlds, np.int64)
        """Steps of the episode so far, [W]."""
        self.geodesic = np.zeros(self.worlds)
        """Shortest way from robot to person [m], inf where there is none, [W]."""
        self.collides = np.zeros(self.worlds, np.bool_)
        """Robot and person touch, [W]."""
        self.human_contact = np.zeros(self.worlds, np.bool_)
        """A driven person touched an obstacle in the last step, [W]."""
        self.found = np.zeros(self.worlds, np.bool_)
        """The robot has found the person in this episode, [W]."""
        self.success = np.zeros(self.worlds, np.bool_)
        """The robot has followed the person long enough, [W]."""
        self.base = base_of(self.robot, spec.robot)
        self.action_width = 3 if spec.robot.max_lateral_mps else 2
        self._driven = driven_human
        self._contact = RobotHumanContact(self.robot, self.human)
        self._walkers: list[WaypointHuman] = []
        self._targets = np.zeros((self.worlds, 2))
        self._collisions = np.zeros(self.worlds, np.int64)
        self._faces = np.zeros(self.worlds)
        self.groups: list[tuple[FreeSpace, NDArray[np.intp]]] = []
        """The worlds that share a floor: it and their indices [n]."""

    # --- episodes -----------------------------------------------------------------------------------------------------
    def begin(self, seeds: ArrayLike, indices: ArrayLike, *, where: ArrayLike = True) -> None:
        """Begin episode ``indices`` [W] of the runs ``seeds`` [W] in the worlds ``where`` [W].

        Scene and episode follow from these two numbers alone.

        Raises:
            SceneError: the scene has no two starts as far apart as the rules say.
        """
        fresh = np.broadcast_to(np.asarray(where, np.bool_), self.worlds)
        seeds, indices = np.broadcast_to(seeds, self.worlds), np.broadcast_to(indices, self.worlds)
        if not self.episodes:
            fresh = np.ones(self.worlds, np.bool_)
        rows = np.flatnonzero(fresh)
        runs = [(int(seeds[w]), int(indices[w])) for w in rows]
        chosen = [int(generator(seed, "scene", step=index).integers(len(self.places))) for seed, index in runs]
        self._make_places(chosen)
        drawn = [  # all of them first: when one fails, no world has changed
            (k, self.places[k].episode(episode_seed(seed, index)))
            for k, (seed, index) in zip(chosen, runs, strict=True)
        ]
        if not self.episodes:
            self.episodes = [episode for _, episode in drawn]
            self._walkers = [_walker(episode) for episode in self.episodes]
        for w, (k, episode) in zip(rows, drawn, strict=True):
            starts = episode.starts
            self.state.put([int(w)], WorldState.zeros(1))
            self._robot.xz[w], self._robot.heading[w] = starts.robot_xz, starts.robot_heading
            self._person.xz[w], self._person.heading[w] = starts.human_xz, starts.human_heading
            self.place[w], self.episodes[w], self._walkers[w] = k, episode, _walker(episode)
            if not self._driven:
                self._targets[w] = self._walkers[w].target(starts.human_xz)
        self.steps[fresh] = self._collisions[fresh] = 0
        self.found[fresh] = self.success[fresh] = self.collides[fresh] = self.human_contact[fresh] = False
        self.groups = [(self.episodes[g[0]].free, g) for g in _runs(self.place)]
        self._look(rows)
        begun = self.state.take(rows)
        self.before.put(rows, begun)
        self.start.put(rows, begun)
        worth = self.rewards.reset(self._encounter(), where=fresh)
        self.success[fresh] |= worth.success[fresh]

    def _make_places(self, chosen: Sequence[int]) -> None:
        """Make the homes that are not there yet; a bar says how far it is."""
        missing = [k for k in dict.fromkeys(chosen) if not self.places[k].is_ready]
        if not missing:
            return
        with bar("homes", len(missing), "home") as made:
            for k in missing:
                self.places[k].make()
                made.update()

    @property
    def words(self) -> str:
        """What it is."""
        robot, human = self.places[0].names
        agents, beside = {"robot": robot}, {"human": human}
        if self._driven:
            agents, beside = agents | beside, {}
        return in_words("social_nav", self._scenes, len(self.places), agents, beside=beside, worlds=self.worlds)

    def step(self, actions: ArrayLike, human_actions: ArrayLike | None = None) -> RewardStep:
        """Move all worlds one step and say what that was worth.

        Args:
            actions: Forward and left turn of each robot in -1..1 of its limits, which they are clipped to, [W, 2]; [W, 3]
                with sideways, where the rules allow it.
            human_actions: The same for driven people, [W, 2]. They do not walk backwards.

        Raises:
            InputError: actions have another shape or are not finite; then nothing has moved.
        """
        if not self.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.")
        moves = checked_actions(actions, (self.worlds, self.action_width))
        walks = checked_actions(human_actions, (self.worlds, 2)) if human_actions is not None else None
        if (walks is not None) != self._driven:
            raise InputError("Expected actions of people if, and only if, they are driven (driven_human=True).")
        for before, now in self._moments:
            before[...] = now
        if walks is None:
            self._next_targets()
            walk_humans(self._person, self._targets, self.spec.human)
        for free, rows in self.groups:
            alone = len(rows) == self.worlds
            part = self.state if alone else self.state.take(rows)
            if walks is not None:
                self.human_contact[rows] = self._drive_people(part.people[0], free, walks[rows])
            draw_arms(part.people[0], free, self.human, self.spec.human.arms)
            drive_robots(part.robots[0], free, moves[rows], self.base)
            if not alone:
                self.state.put(rows, part)
        self.steps += 1
        self._look(np.arange(self.worlds))
        self._collisions += self.collides | self._robot.contact
        worth = self.rewards.step(self._encounter())
        self.success |= worth.success
        return worth

    @property
    def out_of_time(self) -> NDArray[np.bool_]:
        """Worlds whose episode has had all its steps, [W]."""
        return self.steps >= self.spec.max_steps

    @property
    def floor_y(self) -> Array:
        """Height of the floor in each world [m], [W]."""
        return np.array([episode.free.floor_y for episode in self.episodes])

    # --- parts of a step ----------------------------------------------------------------------------------------------
    def _next_targets(self) -> None:
        """Way points of those who have arrived; the others keep theirs."""
        gap = self._targets - self._person.xz
        for w in np.flatnonzero(np.hypot(gap[:, 0], gap[:, 1]) <= self.spec.human.arrive_m):
            self._targets[w] = self._walkers[w].target(self._person.xz[w])

    def _drive_people(self, state: HumanState, free: FreeSpace, actions: Array) -> NDArray[np.bool_]:
        """Move people as bases of one disc, and their walking cycle with them; which of them touched an obstacle."""
        walker = self.spec.human
        body = BaseSpec(
            max_speed_mps=walker.speed_mps, max_turn_rad_s=walker.turn_rad_s, allow_back=False, disc_offsets_m=(0.0,),
            disc_radius_m=self.spec.agent_radius_m,
        )  # fmt: skip
        touched = np.zeros(len(actions), np.bool_)
        was = state.xz.copy()
        drive_robots(
            RobotState(xz=state.xz, heading=state.heading, contact=touched, joints=np.zeros((len(actions), 0))), free,
            actions, body,
        )  # fmt: skip
        walked = np.hypot(*(state.xz - was).T)
        goes, rate = walked > 0, STEP_S / walker.blend_s
        begins = goes & (state.blend == 0)
        state.set_off[begins] = state.distance[begins]
        state.distance[:] += walked
        state.blend[:] = np.where(
            goes, np.minimum(np.maximum(state.blend, 0.5) + rate, 1), np.maximum(state.blend - rate, 0)
        )
        return touched

    def _look(self, rows: NDArray[np.intp]) -> None:
        """What the rules ask of the state of some worlds: distances, contact, whether she is found."""
        robot, person = self._robot, self._person
        everywhere = len(rows) == self.worlds
        for free, group in self.groups:
            some = group if everywhere else np.intersect1d(group, rows)
            self.geodesic[some] = free.geodesic(robot.xz[some], person.xz[some])
        gap = robot.xz[rows] - person.xz[rows]
        near = rows[np.hypot(gap[:, 0], gap[:, 1]) <= self._contact.gate_m + 1e-3]
        self.collides[rows] = False
        if len(near):
            self.collides[near] = self._touching(near)
        self._faces[rows] = facing(robot.xz[rows], robot.heading[rows], person.xz[rows])
        began = self.steps[rows] > 0  # the start itself is no step
        self.found[rows] |= is_found(self.geodesic[rows], self._faces[rows], self.spec) & began

    def _touching(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether robot and person touch in what would be recorded, poses in float32, in some worlds [n]."""
        robot, person, walk = self._robot, self._person, self.human.clips[self.clip]
        floor = np.array([self.episodes[w].free.floor_y for w in rows])
        phase = (walk.start_phase + (person.distance[rows] - person.set_off[rows]) / walk.stride_m) % 1.0
        return self._contact.touching_many(
            ground_pose(robot.xz[rows], robot.heading[rows], floor).astype(np.float32),
            ground_pose(person.xz[rows], person.heading[rows], floor).astype(np.float32),
            np.full(len(rows), self.clip), _recorded(phase), _recorded(person.blend[rows]),
            _recorded(person.arms[rows]),
        )  # fmt: skip

    def _encounter(self) -> Encounter:
        robot = self._robot
        return Encounter(
            robot_xz=robot.xz, robot_heading=robot.heading, human_xz=self._person.xz, geodesic=self.geodesic,
            collides=self.collides, collisions=self._collisions, faces=self._faces,
        )  # fmt: skip


def checked_actions(actions: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Actions as float64 of this shape.

    Raises:
        InputError: they are no numbers, have another shape, or one is not finite.
    """
    try:
        checked = np.asarray(actions, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"Expected actions of shape {list(shape)}, got {actions!r}.") from None
    if checked.shape != shape:
        raise InputError(f"Expected actions of shape {list(shape)}, got {list(checked.shape)}.")
    if not np.isfinite(checked).all():
        raise InputError(f"Actions must be finite, got {checked[~np.isfinite(checked)][0]} in {checked.tolist()}.")
    return checked


def _recorded(values: Array) -> Array:
    """Numbers as they are after having been written in float32."""
    return values.astype(np.float32).astype(np.float64)


def _walker(episode: SocialNavWorld) -> WaypointHuman:
    return WaypointHuman(episode.free, episode.seed, episode.spec.human, episode.goals)


def _runs(place: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Rows with the same number, one array for each number."""
    return [np.flatnonzero(place == k) for k in np.unique(place)]


def scene_sources(scenes: str | Scene | Sequence[str | Scene]) -> list[Scene | SceneSource]:
    """Where to play: names as the command line takes them, and scenes, one after the other.

    Raises:
        InputError: there are no such scenes.
    """
    listed = list(scenes) if isinstance(scenes, list | tuple) else [scenes]
    found: list[Scene | SceneSource] = []
    for one in listed:
        if isinstance(one, Scene):
            found.append(one)
        elif isinstance(one, str):
            found += [named.source for named in named_scenes(one)]
        else:
            raise InputError(f"Expected scenes as names or Scene, got {type(one).__name__}.")
    if not found:
        raise InputError("Expected at least one scene, got none.")
    return found
