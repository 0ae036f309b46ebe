"""Sampling of episodes of social rearrangement: objects, their goals, and the starts of both agents.

The rules follow the paper (section 4.2) and habitat-lab (spec/habitat.md 2.1, 2.2).

The seed determines the episode. Sampling is repeated until both the robot and the person can reach every object and
every goal, and a person alone could finish in time. So the episode is the same for all policies, and it can be solved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.geometry import Array, quat_from_heading, wrap_angle
from h3data.recording.task_episodes.stored_rearrangements import EpisodeObject
from h3data.scene import FreeSpace, Instance, Receptacle, Scene, instance_matrix
from h3data.scene.articulation import joints_of
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.agents.opening.doorways import RoomDoors
from sim_kinematic.agents.opening.openables import ArticulatedParts, stands_clear
from sim_kinematic.agents.opening.reachable import ReachQuery, is_drawer, openables_at, within_reach
from sim_kinematic.agents.opening.skills import stands_before
from sim_kinematic.agents.person_clearance import reach_room
from sim_kinematic.agents.person_skills import HANDS
from sim_kinematic.agents.robots.arm_clearance import arm_clearance
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, kinds_of, make_roster, sample_places
from sim_kinematic.agents.stands import handle_stands, nearest_stand, person_stands, robot_fits, robot_stands
from sim_kinematic.agents.waypoint_walker import walking_path
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import (
    HOME_BASE,
    NATURAL_WALKER,
    RULE_SETS,
    STEP_S,
    BaseSpec,
    OracleSpec,
    SocialNavSpec,
    WalkerSpec,
)
from sim_kinematic.policies.skills.names import recorded_skills
from sim_kinematic.tasks.episode import Episode, Starts, sample_pair_starts
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS

PAIR = ("robot", "human")
"""Bodies of the paper's two agents."""
ATTEMPTS, THOROUGH_ATTEMPTS, REDRAW = 200, 150, 10
"""Number of attempts that try one spot on a surface; number of further attempts that try `SPOTS` spots, since free
spots may be rare; and number of attempts after which the starts are sampled again."""
SPOTS, SPOT_ATTEMPTS = 20, 20
"""Number of spots on a surface that a thorough attempt tries, and number of rounds over at most twelve surfaces."""
STANDS_WITHIN_M, LIFT_M, OPENING_S = 1.0, 0.001, 9.0
"""Largest distance of a person from the object that they take or put down [m]; height by which objects float above
their surface so that a collision test finds no overlap [m]; and estimated time to open one door or drawer [s]."""
HANDLING_S = 4.5
"""Estimated time that a person needs for one object, besides walking and turning [s]."""
SNAP_M = 2.0
"""Largest distance of the floor from the middle of a surface [m]."""
SPARE = 0.98
"""Share of the longest duration within which the estimated duration of the work must stay, for any order of objects."""


@dataclass(frozen=True, kw_only=True)
class RearrangeSpec:
    """Rules of social rearrangement."""

    max_steps: int = 1500
    """Largest number of steps of an episode; the paper has 750 for people at 2.5 m/s, and natural people walk at 1.3
    m/s."""
    objects: int = 2
    at_goal_m: float = 0.3
    """Distance from its goal within which an object is at its goal (Habitat's ``object_at``) [m]."""
    # Habitat's grasp_thresh_dist, and the paper's
    grip_m: float = 0.15
    """Largest distance from a robot's hand to the object that it takes [m]."""
    spawn_distance_m: float = 5.0
    carry_m: float = 2.0
    """Least distance on the floor from an object to its goal [m]."""
    open_m: float = 0.35
    """Free height above a receptacle from which on it counts as open [m]."""
    object_radius_m: float = 0.12
    """Radius of an object's circumscribed circle on the floor plane above which it is not moved [m]."""
    # Habitat's agents_within_threshold; the paper's text has a single distance of 1.5 m
    near_m: tuple[float, float] = (2.0, 1.5)
    """Half axes, ahead and aside, of the ellipse in which another agent may interrupt a skill [m]."""
    arm_rad_s: float = 8.0
    """Speed of the robot's arm joints [rad/s]; if infinite, objects are in the hand at once, as with Habitat's oracle
    skills."""
    end_on_collision: bool = True
    reward: str = "paper"
    """Reward profile, a name in `sim_kinematic.tasks.rules.rewards.REARRANGE_REWARDS`."""
    agent_radius_m: float = 0.25
    agent_height_m: float = 1.41
    robot: BaseSpec = HOME_BASE
    human: WalkerSpec = NATURAL_WALKER
    rule_sets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "natural": {**RULE_SETS["natural"], "max_steps": 1500, "people_give_way": None},
        "paper": {**RULE_SETS["paper"], "max_steps": 750, "people_give_way": False},
    }
    people_give_way: bool | None = field(default=None, repr=False)
    """True if a person who is alone with one robot gives way to it, as all agents do where there are more. By default
    this holds for every base except Habitat's, whose planners give way to nobody. The field is left out of ``repr``,
    from which the identity of episodes is derived."""

    solid_agents: bool = field(default=False, repr=False)
    """True if a person under commands slides along the discs of others as along walls (as in
    `sim_kinematic.motion.spec.SocialNavSpec`), and also gives way to a single robot."""
    floor_moves: bool = field(default=False, repr=False)
    """True if doors and drawers change the free floor when they open and close. This holds for all episodes that are
    sampled in homes with such parts; episodes from before version 0.3 do not have the rule."""
    oracle: OracleSpec | None = field(default=None, repr=False)
    """Rules of simplified skills like Habitat's oracle skills (see `ORACLE_RULES`); None for full skills."""
    observe: str = field(default="full", repr=False)
    """Knowledge of policies. With ``full``, they know the positions of all objects; with ``seen``, only of the objects
    that the agent itself has seen (`sim_kinematic.sensing.sight`)."""
    parts: int = field(default=0, repr=False)
    """Number of doors and drawers that agents may choose to open by number, which are those of `Rearrange.parts_of`."""
    skills: str = field(default="", repr=False)
    """Learned skills of robots, with digests (`sim_kinematic.policies.skills.names.recorded_skills`). Other skills are
    scripted and use the whole state."""
    chores: bool = field(default=False, repr=False)
    """True if people who are driven from outside have a phone and, where the home allows it, a tray and something in the
    fridge (`sim_kinematic.agents.skills.CHORES`)."""

    def __repr__(self) -> str:
        # uids of episodes are made of it: those from before there were oracle skills stay as they were
        later = {"oracle": None, "observe": "full", "chores": False}
        shown = [f for f in fields(self) if f.repr or (f.name in later and getattr(self, f.name) != later[f.name])]
        return f"RearrangeSpec({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in shown)})"

    def __post_init__(self) -> None:
        if self.people_give_way is None:
            object.__setattr__(self, "people_give_way", self.robot.slide != "habitat")
        if self.skills:
            object.__setattr__(self, "skills", recorded_skills(self.skills))
        if self.observe not in ("full", "seen"):
            raise InputError(f"Expected observe=full or observe=seen, got {self.observe!r}.", code="H3-TASK-085")
        if self.reward not in REARRANGE_REWARDS:
            raise InputError(
                f"Unknown reward {self.reward!r}. Expected one of: {', '.join(REARRANGE_REWARDS)}.", code="H3-TASK-011"
            )
        if self.max_steps < 1 or self.objects < 1:
            raise InputError(
                f"Expected at least 1 step and 1 object, got {self.max_steps} steps, {self.objects} objects.",
                code="H3-TASK-012",
            )


ORACLE_RULES = RearrangeSpec(
    max_steps=750, robot=BaseSpec(), human=WalkerSpec(), arm_rad_s=math.inf, people_give_way=False, oracle=OracleSpec()
)
"""Rules for the paper's robot and person with oracle skills, which ``h3data.make("rearrange", device=...)`` uses."""


def with_oracle_skills(spec: Any) -> Any:
    """Return rules of rearrangement, or of a derived task, with the fields for oracle skills taken from `ORACLE_RULES`."""
    fields = ("max_steps", "robot", "human", "arm_rad_s", "people_give_way", "oracle")
    return replace(spec, **{name: getattr(ORACLE_RULES, name) for name in fields})


def rules_in(scene: Scene, spec: RearrangeSpec) -> RearrangeSpec:
    """Return the rules of an episode that is sampled in a home.

    The floor of the episode changes (`RearrangeSpec.floor_moves`) if the home has doors or drawers and agents have full
    skills.
    """
    return replace(spec, floor_moves=bool(scene.articulations) and spec.oracle is None)


class Target(NamedTuple):
    """Object of the task, with its start and its goal."""

    name: str
    """Name of the object's instance in the scene."""
    start: Array
    """Pose (pose7) of the object in the world at the start of the episode, [7]."""
    goal: Array
    """Goal position of the object's origin, shape [3] [m]."""
    source: str
    """Receptacle on which the object lies at the start, ``instance|receptacle``."""
    destination: str


@dataclass(frozen=True, kw_only=True, eq=False)
class RearrangeEpisode(Episode):
    """Episode with objects to bring to their goals."""

    targets: tuple[Target, ...]
    pair: tuple[str, str]
    """Bodies of the robot and the person for whom the episode was sampled, which other agents may play as well."""
    pair_starts: Starts
    """Starts of the robot and the person for whom the episode was sampled."""
    added: tuple[EpisodeObject, ...] = ()
    """Objects of ``scene`` that the episode's file added to it."""
    object_paths: tuple[str, ...] = ()
    """Folders that contain the templates of the objects."""
    wording: str = ""
    """Instruction in the episode's file; if empty, it is made from the targets."""
    is_sampled: bool = True
    """True if the seed and the rules determine the episode; otherwise its identity includes starts and targets."""

    @property
    def moving(self) -> dict[str, Array]:
        """Objects of the task by name, with their poses (pose7) [7] at the start."""
        return {target.name: target.start for target in self.targets}

    @property
    def robot(self) -> Robot:
        """Body of the robot for which the episode was sampled."""
        return load_robot(self.pair[0])

    @property
    def human(self) -> Humanoid:
        """Body of the person for whom the episode was sampled."""
        return load_humanoid(self.pair[1])

    def played_by(self, agents: str | Sequence[str]) -> RearrangeEpisode:
        """Return the episode with other agents.

        Raises:
            InputError: there are no such agents.
            SceneError: there is no room for them.
        """
        roster = make_roster(agents, robot=self.pair[0], human=self.pair[1])
        starts = starts_of(self.scene, self.free, self.seed, self.spec, self.pair_starts, roster)
        return replace(self, roster=roster, starts=starts)


def pair_of(roster: Sequence[AgentSpec]) -> tuple[str, str]:
    """Return the bodies of the first robot and the first person; the default bodies where a kind is missing."""
    # backwards, so that the first of each kind is the one that stays
    models = {member.kind: member.model for member in reversed(roster)}
    return models.get("robot", ROBOT_BODY), models.get("human", HUMAN_BODY)


def body_indices(episode: RearrangeEpisode) -> list[int]:
    """Return the index of each object of the task among the recording's bodies."""
    names = [i.name for i in episode.scene.instances]
    return [names.index(target.name) for target in episode.targets]


def starts_of(
    scene: Scene, free: FreeSpace, seed: int, spec: RearrangeSpec, starts: Starts, cast: Sequence[AgentSpec]
) -> Array:
    """Return the sampled starts of the first robot and the first person, and starts for all other agents."""
    kinds = kinds_of(cast)
    taken: dict[int, Array] = {}
    if "robot" in kinds:
        taken[kinds.index("robot")] = np.append(starts.robot_xz, starts.robot_heading)
    if "human" in kinds:
        taken[kinds.index("human")] = np.append(starts.human_xz, starts.human_heading)
    # a stream of its own: further agents change nothing about the pair
    rng = generator(seed, "more_agents")
    return sample_places(scene, free, cast, rng, apart_m=spec.spawn_distance_m, rules=spec.robot, taken=taken)


def draw_episode(
    scene: Scene, free: FreeSpace, seed: int, spec: RearrangeSpec, robot: Robot, human: Humanoid
) -> tuple[Starts, tuple[Target, ...]]:
    """Sample the starts, objects and goals of the episode with this seed."""
    rules = SocialNavSpec(spawn_distance_m=spec.spawn_distance_m, robot=spec.robot)
    fits = robot_fits(robot, spec.robot, scene, free)
    movable, doorways = _movable(scene, spec), RoomDoors.of(scene, free)
    # drawers are reached from above once they are open, however low the room that they slide into
    # oracle skills open only what the task asks for, so nothing lies in what opens
    shut = {} if spec.oracle is None else joints_of(scene).enclosing
    surfaces = [
        (i, r)
        for i, r in scene.receptacles()
        if (r.clearance_m >= spec.open_m or is_drawer(scene, i)) and f"{i.name}|{r.name}" not in shut
    ]
    # two pieces of furniture, as a goal lies on another one than the object
    if len(movable) < spec.objects or len({i.name for i, _ in surfaces}) < 2:
        raise SceneError(
            f"Rearranging {spec.objects} objects needs as many movable things and open receptacles on two pieces of "
            f"furniture; scene {scene.name!r} has {len(movable)} things and {len(surfaces)} receptacles.",
            code="H3-TASK-010",
        )
    # agents open doors on their way: paths are those with all doors open, and each door costs time
    draw = _EpisodeSampler(doorways.open_scene, doorways.open_floor, spec, robot, human, surfaces, doorways)
    budget = SPARE * spec.max_steps * STEP_S
    # the longest path on foot; turning is left out, so that nothing feasible is ruled out
    longest = (budget - HANDLING_S * spec.objects) * spec.human.speed_mps
    # two legs for each object: to it, and on to its goal
    leg = longest / (2 * spec.objects)
    why = f"a person alone would take more than {budget:.0f} s"
    starts = None
    for attempt in range(ATTEMPTS + THOROUGH_ATTEMPTS):
        rng, thorough = generator(seed, "rearrange", step=attempt), attempt >= ATTEMPTS
        if starts is None or attempt % REDRAW == 0:
            starts = sample_pair_starts(free, int(rng.integers(2**63)), rules, fits=fits)
        chosen = [movable[k] for k in rng.permutation(len(movable))[: spec.objects]]
        # in large homes most errands are too long: later attempts look nearby
        within = np.inf if attempt < REDRAW else leg
        targets = draw.targets(rng, chosen, starts.human_xz, within, longest, spots=SPOTS if thorough else 1)
        if targets is None:
            continue
        seconds = draw.seconds_alone(starts, targets)
        if seconds <= budget:
            # whoever plays may begin with either object
            seconds = draw.seconds_alone(starts, targets[::-1])
        if seconds <= budget:
            return starts, targets
        why = f"a person alone would take about {seconds:.0f} s"
    raise SceneError(
        f"Found no {spec.objects} objects and goals in {scene.name!r} within reach of both agents in "
        f"{ATTEMPTS + THOROUGH_ATTEMPTS} attempts "
        f"({why}). Hint: a larger max_steps=, or another home.",
        code="H3-TASK-009",
    )


def seconds_alone(
    scene: Scene,
    free: FreeSpace,
    spec: RearrangeSpec,
    robot: Robot,
    human: Humanoid,
    starts: Starts,
    targets: tuple[Target, ...],
) -> float:
    """Estimate the time that a person alone needs for all objects [s]; infinite if one of them is out of reach."""
    doorways = RoomDoors.of(scene, free)
    draw = _EpisodeSampler(doorways.open_scene, doorways.open_floor, spec, robot, human, [], doorways)
    return draw.seconds_alone(starts, targets)


def free_spot(
    scene: Scene,
    free: FreeSpace,
    spec: RearrangeSpec,
    robot: Robot,
    human: Humanoid,
    surfaces: list[tuple[Instance, Receptacle]],
    rng: np.random.Generator,
    thing: Instance,
    taken: list[tuple[Array, float]],
) -> tuple[Array, str] | None:
    """Return a free spot [3] for an object on one of some surfaces that both agents reach, and its receptacle.

    The result is None if there is no such spot.

    ``taken`` lists the positions [3] and radii [m] of other objects, to which the spot is added.
    """
    doorways = RoomDoors.of(scene, free)
    draw = _EpisodeSampler(doorways.open_scene, doorways.open_floor, spec, robot, human, surfaces, doorways)
    # within any distance, so it does not matter where the way begins
    tries = (draw._place(rng, thing, taken, np.zeros(2), np.inf) for _ in range(SPOT_ATTEMPTS))
    return next((spot for spot in tries if spot is not None), None)


def _movable(scene: Scene, spec: RearrangeSpec) -> list[Instance]:
    return [
        i
        for i in scene.instances
        if i.motion == "kinematic"
        and len(scene.assets[i.asset].mesh.vertices)
        and object_extent(scene, i)[0] <= spec.object_radius_m
    ]


def _overlap(point: Array, radius: float, other: NDArray, other_radius: float) -> bool:
    """Return whether two things at points [3] would be in each other's space."""
    dx, dy, dz = (point - other).tolist()
    return math.sqrt(dx * dx + dz * dz) < radius + other_radius + 0.01 and abs(dy) < 0.4


@dataclass(frozen=True, eq=False)
class _EpisodeSampler:
    scene: Scene
    free: FreeSpace
    spec: RearrangeSpec
    robot: Robot
    human: Humanoid
    surfaces: list[tuple[Instance, Receptacle]]
    doorways: RoomDoors
    """Doors between the rooms of the home, all of which are open in ``scene`` and ``free``."""
    _stands: dict[tuple[float, ...], Array] = field(default_factory=dict)
    """Stands of a person by point."""
    _openable: dict[int, bool] = field(default_factory=dict)
    """True if both agents open a part, by joint."""

    def targets(
        self,
        rng: np.random.Generator,
        chosen: list[Instance],
        here: Array,
        within_m: float,
        longest_m: float,
        *,
        spots: int,
    ) -> tuple[Target, ...] | None:
        """Return a start and a goal for each chosen object, each within ``within_m`` [m] of the previous place.

        Returns None if ``spots`` tries on each surface give no such places, or if a path that visits all of them is
        certainly longer than ``longest_m``.
        """
        names = {i.name for i in chosen}
        taken = [
            (i.pose[:3], object_extent(self.scene, i)[0])
            for i in self.scene.instances
            if i.motion == "kinematic" and i.name not in names
        ]
        found = []
        least = 0.0
        for thing in chosen:
            start = self._place(rng, thing, taken, here, within_m, spots=spots)
            if start is None:
                return None
            # at either end a person stands this far away, so a leg may be so much shorter than the line
            least += max(float(np.hypot(*(start[0][[0, 2]] - here))) - 2 * STANDS_WITHIN_M, 0.0)
            # before the search for a goal, which costs more than the straight lines up to here
            if least > longest_m:
                return None
            here = start[0][[0, 2]]
            goal = self._place(rng, thing, taken, here, within_m, start, spots=spots)
            if goal is None:
                return None
            least += max(float(np.hypot(*(goal[0][[0, 2]] - here))) - 2 * STANDS_WITHIN_M, 0.0)
            here = goal[0][[0, 2]]
            turned = np.concatenate([start[0], quat_from_heading(rng.uniform(-np.pi, np.pi))])
            found.append(Target(thing.name, turned, goal[0], start[1], goal[1]))
        return tuple(found)

    def _place(
        self,
        rng: np.random.Generator,
        thing: Instance,
        taken: list[tuple[NDArray, float]],
        here: Array,
        within_m: float,
        away_from: tuple[Array, str] | None = None,
        *,
        spots: int = 1,
    ) -> tuple[Array, str] | None:
        """Return a free spot [3] for a thing that both agents reach, and its receptacle; it is taken from then on."""
        radius, low, high = object_extent(self.scene, thing)
        order = rng.permutation(len(self.surfaces))
        near = order if np.isinf(within_m) else order[self._ways(here)[order] <= within_m]
        for k in np.repeat(near[:12], spots).tolist():
            instance, receptacle = self.surfaces[k]
            size = receptacle.half_size * np.abs(instance.scale[[0, 2]]) - radius
            # drawn before the tests, so a surface without room takes as many numbers as any other
            local = rng.uniform(-1, 1, 2)
            if size.min() < 0 or high - low + 0.05 > receptacle.clearance_m:
                continue
            # in the receptacle's axes, which the instance's scale stretches; the radius is in metres
            x, z = local * (receptacle.half_size - radius / np.abs(instance.scale[[0, 2]]))
            spot = instance_matrix(instance) @ np.append(receptacle.center + np.array([x, 0, z]), 1.0)
            # the place of the asset's origin, which may be above the lowest point of the thing
            point = spot[:3] + np.array([0, LIFT_M - low, 0])
            inside = within_reach(self.scene, f"{instance.name}|{receptacle.name}", point)
            if inside is None or (away_from is not None and is_drawer(self.scene, instance)):
                continue
            if away_from is not None:
                if instance.name == away_from[1].partition("|")[0]:
                    continue
                if np.hypot(*(point - away_from[0])[[0, 2]]) < self.spec.carry_m:
                    continue
            if any(_overlap(point, radius, *other) for other in taken):
                continue
            clearance = arm_clearance(inside.scene, self.robot, self.free.floor_y)
            base = base_of(self.robot, self.spec.robot)
            stands = robot_stands(floor_of(self.robot, base, self.scene, self.free), self.robot, base, inside.point)
            # nobody can stand where the open door or drawer is
            stands = stands[stands_clear(stands, inside.taken, base.disc_offsets_m, base.disc_radius_m)]
            if not any(clearance.is_clear(stand, inside.point) for stand in stands):
                continue
            if self._person_stand(inside)[0] is None or not all(self._both_open(*part) for part in inside.opened):
                continue
            taken.append((point, radius))
            return point, f"{instance.name}|{receptacle.name}"
        return None

    def _both_open(self, openables: ArticulatedParts, joint: int) -> bool:
        """Return whether both agents find a stand from which they open a part."""
        if joint not in self._openable:
            self._openable[joint] = all(len(stands) for stands in self._stands_before(openables, joint))
        return self._openable[joint]

    def _both_open_door(self, joint: int) -> bool:
        """Return whether both agents open a door from either side."""
        if joint not in self._openable:
            joints = joints_of(self.doorways.scene)
            positions = joints.rest.copy()
            positions[joint] = joints.closed[joint]
            shut = openables_at(self.doorways.scene, positions, frozenset(self.doorways.joints))
            both = self._stands_before(shut, joint)
            self._openable[joint] = all(all(self.doorways.sides(joint, stands)) for stands in both)
        return self._openable[joint]

    def _stands_before(self, openables: ArticulatedParts, joint: int) -> tuple[Array, Array]:
        """Return stands ``(x, z, heading)`` [N, 3] from which a person and the robot open a part."""
        handle = openables.handles(openables.positions)[joint]
        base, discs = base_of(self.robot, self.spec.robot), AVOIDANCE.person
        people = np.concatenate([person_stands(self.free, self.human, handle, hand) for hand in HANDS])
        floor = floor_of(self.robot, base, self.scene, self.free)
        # handle_stands: a robot may take a handle from where it has no room to turn
        robots = np.concatenate([f(floor, self.robot, base, handle) for f in (robot_stands, handle_stands)])
        return (
            people[stands_before(openables, joint, people, discs.offsets_m, discs.radius_m)],
            robots[stands_before(openables, joint, robots, base.disc_offsets_m, base.disc_radius_m)],
        )

    @cached_property
    def _centers(self) -> Array:
        """Middle of each surface on the floor plane [S, 2]."""
        return np.array([instance_matrix(i) @ np.append(r.center, 1.0) for i, r in self.surfaces])[:, [0, 2]]

    def _ways(self, here: Array) -> Array:
        """Return the length of the way from ``here`` [2] to each surface [S] [m], about."""
        return self.free.geodesic(np.broadcast_to(here, self._centers.shape), self._centers, max_snap_m=SNAP_M)

    def _person_stand(self, place: ReachQuery, here: Array | None = None) -> tuple[Array | None, float]:
        """Return pose [3] from which the hand reaches a place without the body touching the home, and the path length.

        It is the nearest such pose to ``here`` [2]. Returns None and infinity if there is none.
        """
        point = place.point
        at = tuple(point.tolist())
        stands = self._stands.get(at)
        if stands is None:
            stands = person_stands(self.free, self.human, point)
            stands = stands[stands_clear(stands, place.taken, (0.0,), self.spec.agent_radius_m)]
            self._stands[at] = stands
        if not len(stands):
            return None, np.inf
        room = reach_room(place.scene, self.human, self.free.floor_y)
        # without a place to come from, only the existence of a stand counts
        start = stands[0, :2] if here is None else here
        k, length = nearest_stand(self.free, stands, start, is_clear=lambda stand: room.is_clear(stand, point))
        return (stands[k], length) if k >= 0 else (None, length)

    def seconds_alone(self, starts: Starts, targets: tuple[Target, ...]) -> float:
        """Estimate the time that a person alone needs for all objects in turn [s]; infinite if there is no path."""
        here, heading = starts.human_xz, starts.human_heading
        # a set of doors: one that has been opened stays open on later legs
        way, turned, opened, walker, doors = 0.0, 0.0, 0, self.spec.human, set[int]()
        positions = joints_of(self.doorways.scene).rest
        for target in targets:
            for point, receptacle in ((target.start[:3], target.source), (target.goal, target.destination)):
                place = within_reach(self.scene, receptacle, point)
                stand, length = (None, np.inf) if place is None else self._person_stand(place, here)
                if place is None or stand is None:
                    return np.inf
                opened += len(place.opened)
                path = walking_path(self.free, *np.array([here, stand[:2]], np.float64), walker)
                doors.update(self.doorways.crossed(path, positions, self.free.radius_m))
                if not all(map(self._both_open_door, doors)):
                    return np.inf
                legs = np.diff(path, axis=0)
                if walker.clearance_m:  # the detour around corners: 6% of the time where there are many
                    length = float(np.hypot(*legs.T).sum())
                # forward is (cos, -sin) of the heading in (x, z)
                headings = [heading, *np.arctan2(-legs[:, 1], legs[:, 0]), stand[2]]
                turned += float(np.abs(wrap_angle(np.diff(headings))).sum())
                here, heading, way = stand[:2], float(stand[2]), way + length
        pace = way / walker.speed_mps + OPENING_S * (opened + len(doors))
        if walker.stride is None:
            return pace + turned / walker.turn_rad_s + HANDLING_S * len(targets)
        # against full speed throughout, v / 2a is lost in setting off and v / 2d in braking
        setting_off = walker.speed_mps / 2 * (1 / walker.stride.accel_mps2 + 1 / walker.stride.decel_mps2)
        # two legs for each object, each with a start and a stop
        return pace + turned / walker.stride.turn_rad_s + (2 * setting_off + HANDLING_S) * len(targets)
