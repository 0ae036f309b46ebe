"""Records of a task: its rules, an episode and its starts, and the outcome of a step."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, SceneError, suggest
from h3data.geometry import Array
from h3data.recording import Event
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import AgentSpec, common_floor, sample_places
from sim_kinematic.agents.stands import discs_fit
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import HOME_BASE, NATURAL_WALKER, RULE_SETS, BaseSpec, SocialNavSpec, WalkerSpec

MAX_STEPS = 1_000_000
"""Largest number of steps of an episode that can be simulated again, which is nine hours."""


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Rules that every task has, to which a task's own spec adds others."""

    max_steps: int = 1500
    spawn_distance_m: float = 5.0
    """Least distance between any two agents at the start, where there is room [m]."""
    agent_radius_m: float = 0.25
    agent_height_m: float = 1.41
    """Height of the agent for which the free floor is computed, equal to that of Habitat's navigation mesh for Spot
    [m]."""
    robot: BaseSpec = HOME_BASE
    human: WalkerSpec = NATURAL_WALKER
    rule_sets: ClassVar[Mapping[str, Mapping[str, Any]]] = RULE_SETS
    """Fields by the name of a set of rules, ``natural`` and ``paper``, as `with_options` takes them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """Constant part of an episode: home, map, rules, agents, starts and seed."""

    scene: Scene
    free: FreeSpace
    seed: int
    spec: Any
    """Rules of the task, a frozen dataclass."""
    roster: tuple[AgentSpec, ...]
    """Agents of the episode, robots first, then people."""
    starts: Array
    """Start ``(x, z, heading)`` of each agent, shape [A, 3]."""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """Further data that the task sampled, as JSON types, which are recorded in ``info["extra"]``."""

    def __post_init__(self) -> None:
        # agents must reach each other, whoever made the episode: paths are found on the floor that all can use
        object.__setattr__(self, "free", common_floor(self.roster, self.free))

    def only(self, *numbers: int) -> Self:
        """Return the episode with only some of its agents."""
        return replace(self, roster=tuple(self.roster[k] for k in numbers), starts=self.starts[list(numbers)])

    @cached_property
    def bases(self) -> tuple[BaseSpec, ...]:
        """Discs and limits of each agent: a robot's own, or those of the rules for people."""
        return tuple(base_of(member.body, self.spec.robot) for member in self.roster)

    def floor(self, agent: int) -> FreeSpace:
        """Return the floor on which an agent finds its paths, without places too narrow for it."""
        return floor_of(self.roster[agent].body, self.bases[agent], self.scene, self.free)

    @property
    def moving(self) -> dict[str, Array]:
        """Instances of the scene that agents may move, with their initial poses (pose7) [7], in recorded order."""
        return {}


def sample_starts(
    scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: Sequence[AgentSpec], stream: str = "starts"
) -> Array:
    """Return random free starts [A, 3], at least ``spec.spawn_distance_m`` apart if there is room.

    ``stream`` names the stream of random numbers; another name gives other starts.
    """
    rng = generator(seed, stream)
    return sample_places(scene, free, roster, rng, apart_m=spec.spawn_distance_m, rules=spec.robot)


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Start poses of a robot and a person."""

    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    human_heading: float

    @property
    def places(self) -> Array:
        """Places ``(x, z, heading)`` of robot and person, [2, 3]."""
        return np.array([[*self.robot_xz, self.robot_heading], [*self.human_xz, self.human_heading]])

    @classmethod
    def of(cls, places: Array) -> Starts:
        """Build starts from an array [2, 3] whose first row is the robot's and second the person's."""
        robot, human = np.asarray(places, np.float64)
        return cls(robot_xz=robot[:2], robot_heading=float(robot[2]), human_xz=human[:2], human_heading=float(human[2]))


def sample_pair_starts(
    free: FreeSpace, seed: int, spec: SocialNavSpec, *, fits: Callable[[Array, float], bool] | None = None
) -> Starts:
    """Sample starts at least ``spec.spawn_distance_m`` apart on one island of the free floor.

    ``fits`` tests whether the robot fits at ``(xz [2], heading)`` (`sim_kinematic.agents.stands.robot_fits`); without
    it, only the base of the rules is kept free of obstacles.

    Raises:
        SceneError: The scene has no two such places.
    """
    rng = generator(seed, "spawn")
    base_fits = partial(discs_fit, free, spec.robot)
    farthest, misfits = 0.0, 0
    for _ in range(200):
        robot_xz, human_xz = free.sample(rng, 2)
        # drawn for rejected pairs too, so that the tests do not shift the draws of later pairs
        robot_heading, human_heading = rng.uniform(-np.pi, np.pi, 2)
        apart = float(np.hypot(*(robot_xz - human_xz)))
        farthest = max(farthest, apart)
        if apart < spec.spawn_distance_m:
            continue
        if not np.isfinite(free.geodesic(robot_xz, human_xz)):
            continue
        if (fits or base_fits)(robot_xz, robot_heading):
            return Starts(
                robot_xz=robot_xz,
                robot_heading=float(robot_heading),
                human_xz=human_xz,
                human_heading=float(human_heading),
            )
        misfits += 1
    narrow = (
        f" At {misfits} of these pairs the robot did not fit: "
        "base_discs_m and base_radius_m of its robot.toml say its size."
    )
    raise SceneError(
        f"Found no start poses {spec.spawn_distance_m} m apart with a free base in 200 attempts (the farthest pair was "
        f"{farthest:.1f} m apart).{narrow if misfits else ''} Hint: a smaller spawn_distance=, or a larger home.",
        code="H3-TASK-048",
    )


@dataclass(frozen=True, kw_only=True)
class StepOutcome:
    """Evaluation of one step in W worlds, with arrays [W]."""

    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    """True if the rules end the episode, [W]."""
    success: NDArray[np.bool_]
    """True if the task is done, [W]; once true in an episode, it should stay true."""
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Values to record, by column name (`Task.columns`), [W, ...] each."""
    ended: str = ""
    """Word in ``info["ended"]`` for an episode that the rules end; if empty, it is ``success`` or ``terminated``."""
    events: Sequence[tuple[int, Event]] = ()
    """Events of this step, each with the number of the world that it belongs to."""


def rules_dict(spec: Any) -> dict[str, Any]:
    """Return the rules of an episode as a dictionary, in the form of recordings and episode files.

    A rule added after the first version of the format has no entry as long as it has its neutral value: people turn on
    the spot (no ``stride``), no agent is solid, no floor moves, people collide with their whole bodies, and no skill is
    a learned or an oracle skill. Old and new recordings of the same episode thus have equal dictionaries.
    """
    rules = asdict(spec)
    if rules.get("person_contact") == "body":
        del rules["person_contact"]
    for name in ("solid_agents", "floor_moves", "skills", "oracle", "parts"):
        # True stands for specs that lack the rule and have nothing to leave out
        if not rules.get(name, True):
            del rules[name]
    human = rules.get("human")
    # None is the neutral value, the ellipsis stands for no entry at all
    if isinstance(human, dict) and human.get("stride", ...) is None:
        del human["stride"]
    return rules


def with_options(spec: Any, **options: Any) -> Any:
    """Return rules with some options replaced, where None leaves an option unchanged.

    In addition to the fields of ``spec``, there are the options ``rules``, the name of a set of rules (``paper`` or
    ``natural``) to which the other options are applied, and ``human_speed``, the walking speed of people [m/s].
    """
    speed, rules = options.pop("human_speed", None), options.pop("rules", None)
    if rules is not None:
        sets: Mapping[str, Mapping[str, Any]] = getattr(spec, "rule_sets", {})
        if rules not in sets:
            raise InputError(
                f"Unknown rules {rules!r}. Expected one of: {', '.join(sets) or 'none, this task has no sets of rules'}.",
                code="H3-TASK-001",
            )
        spec = replace(spec, **sets[rules])
    # after the set of rules, which may bring a walker of its own
    if speed is not None:
        spec = replace(spec, human=replace(spec.human, speed_mps=speed))
    known = [field.name for field in fields(spec) if field.init]
    for name in options:
        if name not in known:
            valid = [*known, "human_speed", "rules"]
            raise InputError(
                f"Unknown rule {name!r}.{suggest(name, valid, lead='Expected some of')}", code="H3-JOB-020"
            )
    return replace(spec, **{name: value for name, value in options.items() if value is not None})


def rule_value(spec: Any, name: str, value: Any) -> Any:
    """Return the value of a rule, given as JSON, in the type that the rules have.

    Raises:
        InputError: The task has no such rule, or its values are of another type.
    """
    # types of rules that can be given as text, and how to ask for them
    rule_kinds = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "a word",
        tuple: "a list of numbers",
    }
    there = [f.name for f in fields(spec) if type(getattr(spec, f.name)) in rule_kinds]
    if name not in there:
        raise InputError(f"Unknown rule {name!r}.{suggest(name, there)}", code="H3-JOB-020")
    now = getattr(spec, name)
    kind = type(now)
    if kind is float and type(value) is int:
        value = float(value)
    if kind is tuple and isinstance(value, list) and len(value) == len(now):
        value = tuple(float(one) if type(one) in (int, float) else None for one in value)
    # True is an int to Python and NaN a float, so types are compared exactly and NaN is refused
    numbers = value if isinstance(value, tuple) else (value,)
    if type(value) is not kind or any(number is None or number != number for number in numbers):
        usual, given = (one if isinstance(one, str) else json.dumps(one) for one in (now, value))
        shape = f" of length {len(now)}" if kind is tuple else ""
        raise InputError(
            f"Expected the rule {name} to be {rule_kinds[kind]}{shape}, as {name}={usual}; got {given}.",
            code="H3-JOB-021",
        )
    return value
