"""Table of the sensors of all tasks, except pictures, with one row per sensor.

A row is a function of a `Context` over its array namespace. So the same row serves environments and policies on the CPU
(``numpy``), files of weights, training, and worlds on a device (``torch``). A task adds a sensor of its own as one more
row: `Task.sensors` is ``{**SENSORS, "goal": Sensor(...)}``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.state import NOBODY, AgentState
from sim_kinematic.sensing.agent_pictures import Limits
from sim_kinematic.sensing.lidar import LIDAR_M, LIDAR_RAYS, scan
from sim_kinematic.sensing.sensor import (
    FAR_M,
    FAST,
    RANGE_M,
    RANGES,
    egomotion,
    gps_compass,
    humanoid_velocity,
    localization,
    localization_in_start_frame,
    other_agent_gps,
    range_scan,
    way,
)

if TYPE_CHECKING:
    from sim_kinematic.world import World

NEARER_M = 3.0
"""Largest distance by which an agent can get nearer to any point within a second [m]."""
AHEAD_M = (1.0, 2.5)
"""Lengths along the shortest path at which ``path_ahead`` returns points [m]: the paths of 0.4 s and 1 s at the robot's
largest speed."""
Times = Literal["once", "objects", "joints", "choices", "parts"]
Ending = Literal["done", "failed", "aborted"]


class Pose(NamedTuple):
    """Poses of the bases of agents."""

    xz: Any
    """Position on the floor [..., 2] [m]."""
    heading: Any
    """Heading [...] [rad]."""


# every field is Any: the same rows read arrays and tensors, and a context has only the fields of its own sensors
class Context(Protocol):
    """Input of sensors: the state of one agent in each of some worlds [...]; fields that are not read may be missing.

    Arrays belong to the namespace ``xp``. ``now``, ``before`` (one step ago), ``start``, ``other`` and ``other_before``
    have ``xz`` and ``heading``, like a `Pose`. Places of K objects, ``objects``, ``starts`` and ``goals``, are [..., K,
    3].
    """

    xp: Any
    agent: Any
    """Number of the agent."""
    now: Any
    before: Any
    start: Any
    other: Any
    """Pose of the other agent."""
    other_before: Any
    contact: Any
    """True if the agent touched an obstacle in the last step, bool [...]."""
    touching: Any
    """True if the agent touches another agent, bool [...]."""
    arm: Any
    """Positions of the arm's joints [..., n] [rad or m]; empty [..., 0] for a person."""
    held_by: Any
    """Number of the agent that holds each object, [..., K]."""
    objects: Any
    starts: Any
    goals: Any
    at_goal: Any
    """True if the object is at its goal, bool [..., K]."""
    close: Any
    """True if the other agent is inside the ellipse in which skills may be interrupted, bool [...]."""
    handles: Any
    """Positions of the handles of the M doors and drawers that agents may open, at rest, [..., M, 3] [m]."""
    open_parts: Any
    """True if the door or drawer is at least ajar, bool [..., M]."""
    steps: Any
    """Number of steps since the start of the episode [...]."""
    target: Any
    """Target of a skill [..., 3] [m]."""
    resting: Any
    """Place of the hand at rest [..., 3] [m]."""

    def floor_y(self) -> Any:
        """Return the height of the floor at the agent, [...] [m]."""
        ...

    def path(self, points: Any = None) -> tuple[Any, Any]:
        """Return the shortest path to points [..., 2] [m]: its length [...] [m] and a point near its start [..., 2] [m].

        The default is the other agent, or the target of a skill.
        """
        ...

    def clearance(self, points: Any) -> Any:
        """Return signed distance [..., n] [m] of points [..., n, 2] to the nearest obstacle."""
        ...

    def free_along(self, headings: Any, max_m: float) -> Any:
        """Return the distance [..., R] [m] from the agent along headings [..., R] [rad] to the nearest obstacle.

        The distance is at most ``max_m`` [m].
        """
        ...

    def circles(self, *, legs: bool) -> Any:
        """Return the other agents as circles ``(x, z, radius)`` [..., N, 3] [m]; with ``legs``, two per person."""
        ...

    def in_hand(self, points: Any) -> Any:
        """Return world points [..., n, 3] in the frame of the hand."""
        ...

    def from_start(self, points: Any) -> Any:
        """Return world points [..., n, 3] [m] in the agent root frame at the start of the episode."""
        ...

    def other_root(self) -> Any:
        """Return the position of the other agent's root in the world, [..., 3] [m]."""
        ...

    def ways(self, end: Literal["objects", "goals"], *, other: bool, then: bool = False) -> Any:
        """Return the lengths of shortest paths to objects or goals, [..., K] [m].

        The paths start at the agent or, with ``other``, at the other agent.

        With ``then``, the paths start where that agent was a second ago.
        """
        ...

    def ahead(self, *, other: bool) -> Any:
        """Return the points that are `AHEAD_M` ahead on the path to each object, [..., K, n, 2] [m].

        The path is that of the agent, or with ``other`` that of the other agent.
        """
        ...

    def ended(self, outcome: Ending) -> Any:
        """Return a number per choice, [..., C]: 1 for the agent's last one if it had this outcome, else 0."""
        ...


class SensorContext(NamedTuple):
    """Input of sensors: one agent in each of W worlds whose agents drive and walk, on the CPU and on devices.

    On a device (``xp`` is torch) ``episodes`` is empty and ``world`` a `h3data_training.torch.task_worlds.TensorWorld`.
    """

    spec: Any
    """Rules of the task."""
    base: BaseSpec
    """Discs and limits of the agent."""
    memory: Any
    """State that the task stores between steps (`WorldRollout.memory`), for its own sensors."""
    episodes: Sequence[Any]
    """Episode of each world."""
    world: World
    agent: int
    now: AgentState
    before: AgentState
    """State of the agent one step ago."""
    start: AgentState
    other: AgentState
    """State of the other agent: the first person for a robot, the first robot for a person, else the next agent."""
    other_before: AgentState
    contact: NDArray[np.bool_]
    """True if the agent touched an obstacle in the last step, [W]."""
    touching: NDArray[np.bool_]
    """True if the agent touches another agent, [W]."""
    arm: Array
    """Positions of the joints of the resting arm, [W, n] [rad or m]; empty [W, 0] for a person."""
    path: Callable[..., tuple[Array, Array]]
    """Function that returns the shortest path to points [W, 2] (by default the other agent): its length [W] [m] and its
    first waypoint [W, 2] [m]."""
    xp: Any = np

    @property
    def held_by(self) -> NDArray[np.int64]:
        """Number of the agent that holds each object, [W, K]."""
        return self.world.state.held_by

    def floor_y(self) -> Array:
        """Return the height of the floor at the agent, [W] [m]."""
        return self.world.heights(self.now.xz)

    def clearance(self, points: Array) -> Array:
        """Return signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
        return self.world.clearance(points)

    def free_along(self, headings: Array, max_m: float) -> Array:
        """Return the distance [W, R] [m] from the agent along headings [W, R] [rad] to the nearest obstacle.

        The distance is at most ``max_m`` [m].
        """
        return self.world.free_along(self.now.xz, headings, max_m)

    def circles(self, *, legs: bool) -> Array:
        """Return the other agents as circles ``(x, z, radius)`` [W, N, 3] [m]; with ``legs``, two per person."""
        return self.world.circles(self.agent, legs=legs)

    def from_start(self, points: Array) -> Array:
        """Return world points [W, n, 3] [m] in the agent root frame at the start of the episode."""
        return self.world.in_root_frame(self.start, points)

    def other_root(self) -> Array:
        """Return the position of the other agent's root in the world, [W, 3] [m]."""
        xz = self.other.xz
        return self.xp.stack([xz[:, 0], self.world.heights(xz), xz[:, 1]], -1)


class Sensor(NamedTuple):
    """Observation that is not a picture, as a row of the table of sensors."""

    of: Callable[[Any], Any]
    """Function that returns values [..., n] from a `Context`, or [W, n] from a `SensorContext` of worlds whose agents
    drive and walk."""
    low: ArrayLike
    """Least value of each number in one unit of the sensor; their count is the width of a unit."""
    high: ArrayLike
    """Largest value of each number in one unit of the sensor."""
    unit: tuple[str, ...] = ()
    """Unit of measurement of each number of the sensor, empty for a number without one; an empty tuple if no number has
    one."""
    frame: str = ""
    """Axes of the numbers: ``base`` (forward, left, or an angle to the right), ``world``, ``start`` (the agent root frame of
    the start: x forward, y up, z right) or ``hand``."""
    times: Times = "once"
    """Number of times that the sensor's numbers are repeated: once, or once for each object, joint of the arm, choice,
    or door and drawer that agents may choose to open."""
    of_other: bool = False
    """True if the sensor measures something about another agent, so that an agent alone does not have it."""
    kinds: tuple[str, ...] = ("robot", "human")
    """Kinds of agents that have the sensor."""

    @property
    def width(self) -> int:
        """Number of values in one unit of the sensor."""
        return int(np.size(self.low))

    def limits(self, repeat: int = 1) -> Limits:
        """Return the limits of one world's values, [n] for ``repeat`` units."""
        low, high = (np.tile(np.atleast_1d(np.array(bound, np.float32)), repeat) for bound in (self.low, self.high))
        return Limits(low, high, low.shape, np.float32)


# --- shapes -------------------------------------------------------------------------------------------------------------
def _flat(m: Context, values: Any) -> Any:
    """Return values [..., K, ...] of each object as one row, [..., n]."""
    return values.reshape((*m.now.heading.shape, -1))


def _polar_of(m: Context, points_xz: Any) -> Any:
    """Return the distance and angle of points [..., n, 2], [..., 2 n]."""
    # one more axis for the agent, which is one for all of its points
    return _flat(m, gps_compass(m.now.xz[..., None, :], m.now.heading[..., None], points_xz, xp=m.xp))


_POLAR: Any = {"low": (0.0, -np.pi), "high": (FAR_M, np.pi), "unit": ("m", "rad"), "frame": "base"}
_POINT: Any = {"low": (-FAR_M,) * 3, "high": (FAR_M,) * 3, "unit": ("m",) * 3}
_POSE: Any = {
    "low": (*_POINT["low"], -np.pi),
    "high": (*_POINT["high"], np.pi),
    "unit": (*_POINT["unit"], "rad"),
}
_FLAG: Any = {"low": (0.0,), "high": (1.0,)}


def _gps(points: Callable[[Context], Any]) -> Sensor:
    # x and z by a slice with a step, which arrays and tensors both take as a view
    return Sensor(lambda m: _polar_of(m, points(m)[..., 0:3:2]), **_POLAR, times="objects")


def _in_frame(frame: Literal["hand", "start"], points: Callable[[Context], Any]) -> Sensor:
    def seen(m: Context) -> Any:
        return _flat(m, m.in_hand(points(m)) if frame == "hand" else m.from_start(points(m)))

    return Sensor(seen, **_POINT, frame=frame, times="objects")


def _one_of_choices(outcome: Ending) -> Sensor:
    return Sensor(lambda m: m.ended(outcome), **_FLAG, times="choices")


def _ways(end: Literal["objects", "goals"], *, other: bool = False) -> Sensor:
    return Sensor(lambda m: m.ways(end, other=other), (0.0,), (FAR_M,), ("m",), times="objects", of_other=other)


def _other_from(points: Callable[[Context], Any]) -> Sensor:
    def seen(m: Context) -> Any:
        gap = points(m)[..., 0:3:2] - m.other.xz[..., None, :]
        return m.xp.hypot(gap[..., 0], gap[..., 1])

    return Sensor(seen, (0.0,), (FAR_M,), ("m",), times="objects", of_other=True)


def _path_ahead(*, other: bool) -> Sensor:
    def seen(m: Context) -> Any:
        return _polar_of(m, m.ahead(other=other).reshape((*m.now.heading.shape, -1, 2)))

    # one unit of the sensor has a distance and an angle for each of the points
    unit: Any = {name: side * len(AHEAD_M) for name, side in _POLAR.items() if name != "frame"}
    return Sensor(seen, **unit, frame="base", times="objects", of_other=other)


def _lidar(*, legs: bool) -> Sensor:
    many = {"low": (0.0,) * LIDAR_RAYS, "high": (LIDAR_M,) * LIDAR_RAYS, "unit": ("m",) * LIDAR_RAYS}
    return Sensor(lambda m: scan(m, legs=legs), **many, frame="base")


_OTHER_GPS = Sensor(lambda m: gps_compass(m.now.xz, m.now.heading, m.other.xz, xp=m.xp), **_POLAR, of_other=True)
_OTHER_VELOCITY = Sensor(
    lambda m: humanoid_velocity(m.now.heading, m.other_before.xz, m.other.xz, xp=m.xp),
    (-FAST,) * 2,
    (FAST,) * 2,
    ("m/s",) * 2,
    "base",
    of_other=True,
)

# --- the table ----------------------------------------------------------------------------------------------------------
HUMANOID_GPS = "humanoid_gps"
"""Name of the sensor for distance and direction of the other agent, as in the paper."""
TABLE: Mapping[str, Sensor] = {
    # of any agent
    HUMANOID_GPS: _OTHER_GPS,
    "egomotion": Sensor(
        lambda m: egomotion(m.before.xz, m.before.heading, m.now.xz, m.now.heading, xp=m.xp),
        (-FAST,) * 3,
        (FAST,) * 3,
        ("m/s", "m/s", "rad/s"),
        "base",
    ),
    "localization": Sensor(
        lambda m: localization(m.now.xz, m.now.heading, m.floor_y(), xp=m.xp), **_POSE, frame="world"
    ),
    "humanoid_velocity": _OTHER_VELOCITY,
    "way": Sensor(lambda m: way(m.now.xz, m.now.heading, *m.path(), xp=m.xp), **_POLAR, of_other=True),
    "range_scan": Sensor(
        lambda m: range_scan(m.clearance, m.now.xz, m.now.heading, xp=m.xp),
        (0.0,) * RANGES,
        (RANGE_M,) * RANGES,
        ("m",) * RANGES,
        "base",
    ),
    "lidar": _lidar(legs=False),
    "lidar_legs": _lidar(legs=True),
    "localization_in_start_frame": Sensor(
        lambda m: localization_in_start_frame(m.start.xz, m.start.heading, m.now.xz, m.now.heading, xp=m.xp),
        **_POSE,
        frame="start",
    ),
    "humanoid_in_start_frame": Sensor(
        lambda m: m.from_start(m.other_root()[..., None, :])[..., 0, :], **_POINT, frame="start", of_other=True
    ),
    "collision": Sensor(lambda m: m.xp.stack([m.contact, m.touching], -1), (0.0,) * 2, (1.0,) * 2),
    "is_holding": Sensor(lambda m: (m.held_by == m.agent).any(-1)[..., None], **_FLAG),
    "arm_joints": Sensor(lambda m: m.arm, (-10.0,), (10.0,), ("rad",), times="joints"),
    # of rearrangement
    "obj_start_gps_compass": _gps(lambda m: m.starts),
    "obj_goal_gps_compass": _gps(lambda m: m.goals),
    "obj_start_sensor": _in_frame("hand", lambda m: m.starts),
    "obj_goal_sensor": _in_frame("hand", lambda m: m.goals),
    "other_agent_gps": Sensor(
        lambda m: other_agent_gps(m.now.xz, m.other.xz, xp=m.xp),
        (-FAR_M,) * 2,
        (FAR_M,) * 2,
        ("m",) * 2,
        "world",
        of_other=True,
    ),
    "obj_gps_compass": _gps(lambda m: m.objects),
    "obj_sensor": _in_frame("hand", lambda m: m.objects),
    "holds": Sensor(lambda m: m.held_by == m.agent, **_FLAG, times="objects"),
    "held_by_other": Sensor(lambda m: (m.held_by != m.agent) & (m.held_by != NOBODY), **_FLAG, times="objects"),
    "at_goal": Sensor(lambda m: m.at_goal, **_FLAG, times="objects"),
    "other_gps_compass": _OTHER_GPS,
    "close": Sensor(lambda m: m.close[..., None], **_FLAG, of_other=True),
    "obj_start_in_start_frame": _in_frame("start", lambda m: m.starts),
    "obj_goal_in_start_frame": _in_frame("start", lambda m: m.goals),
    "obj_in_start_frame": _in_frame("start", lambda m: m.objects),
    "last_done": _one_of_choices("done"),
    "interrupted": _one_of_choices("aborted"),
    "last_failed": _one_of_choices("failed"),
    "way_to_objects": _ways("objects"),
    "way_to_goals": _ways("goals"),
    "other_way_to_objects": _ways("objects", other=True),
    "other_way_to_goals": _ways("goals", other=True),
    "other_from_starts": _other_from(lambda m: m.starts),
    "other_from_goals": _other_from(lambda m: m.goals),
    # by how much the other's path to each object has become shorter within a second
    "other_approach": Sensor(
        lambda m: (m.ways("objects", other=True, then=True) - m.ways("objects", other=True)).clip(-NEARER_M, NEARER_M),
        (-NEARER_M,),
        (NEARER_M,),
        ("m",),
        times="objects",
        of_other=True,
    ),
    "path_ahead": _path_ahead(other=False),
    "other_path_ahead": _path_ahead(other=True),
    "other_velocity": _OTHER_VELOCITY,
    "elapsed_s": Sensor(lambda m: m.steps[..., None] * STEP_S, (0.0,), (FAR_M,), ("s",)),
    "part_gps_compass": Sensor(lambda m: _polar_of(m, m.handles[..., 0:3:2]), **_POLAR, times="parts"),
    "part_is_open": Sensor(lambda m: m.open_parts, **_FLAG, times="parts"),
    # of a robot with one skill to learn
    "target_gps_compass": Sensor(
        lambda m: gps_compass(m.now.xz, m.now.heading, m.target[..., 0:3:2], xp=m.xp), **_POLAR
    ),
    "target_sensor": Sensor(lambda m: m.in_hand(m.target[..., None, :])[..., 0, :], **_POINT, frame="hand"),
    "resting_sensor": Sensor(lambda m: m.in_hand(m.resting[..., None, :])[..., 0, :], **_POINT, frame="hand"),
}
"""All sensors by name (h3data docs environments)."""
LIDARS = ("lidar", "lidar_legs")
"""Names of laser scanners that see agents, either as discs or by their legs."""


OF_SKILLS = (
    "way",
    "range_scan",
    "egomotion",
    "target_gps_compass",
    "target_sensor",
    "resting_sensor",
    "is_holding",
    "arm_joints",
)
"""Observations that a learned skill may have in addition to a picture."""
# the order of the table counts here: rows up to ``arm_joints`` are those of any agent
SENSORS: Mapping[str, Sensor] = {name: TABLE[name] for name in list(TABLE)[: list(TABLE).index("arm_joints") + 1]}
"""Sensors of agents of any task whose agents drive and walk."""
# those left out need fields that `RearrangeContext` lacks, or are other_velocity by another name
SENSES: Mapping[str, Sensor] = {
    name: sensor
    for name, sensor in TABLE.items()
    if name
    not in (
        "humanoid_velocity",
        "way",
        "range_scan",
        *LIDARS,
        "part_gps_compass",
        "part_is_open",
        "target_gps_compass",
        "target_sensor",
        "resting_sensor",
    )
}
"""Sensors of agents of rearrangement."""
FOLLOWER = (HUMANOID_GPS, "egomotion", "localization", "humanoid_velocity", "way", "range_scan")
"""Observations available to a robot that follows a person, in training and in play, on the CPU and on devices."""
STATE_OBSERVATIONS = (HUMANOID_GPS, "egomotion")
"""Default observations of agents that drive and walk; none of them needs a picture."""
PAPER_OBSERVATIONS = ("arm_depth", "humanoid_detector", HUMANOID_GPS)
"""Observations of the paper's policy of social navigation (appendix), which need a picture in every step."""
HABITAT_SENSES = (
    "arm_depth",
    "is_holding",
    "obj_start_gps_compass",
    "obj_goal_gps_compass",
    "other_agent_gps",
    "obj_start_sensor",
    "obj_goal_sensor",
)
"""Observations of the upper layer in Habitat's configuration, which need a picture in every step."""
PAPER_SENSES = (
    *(name for name in HABITAT_SENSES if name != "other_agent_gps"),
    HUMANOID_GPS,
    "arm_joints",
    "egomotion",
)
"""Observations of the robot in the paper (section 4.2), which need a picture in every step: depth, arm joints,
egomotion, distance and direction of the person, and the observations of the task in Habitat's configuration."""
STATE_SENSES = (
    "obj_gps_compass",
    "obj_goal_gps_compass",
    "holds",
    "held_by_other",
    "at_goal",
    "other_gps_compass",
    "last_done",
    "interrupted",
)
"""Sensors that suffice for a policy without memory to solve the task of rearrangement."""


def sensed(name: str, sensor: Sensor, moment: Any, task: str, agent: str) -> Any:
    """Return the values of a named sensor of an agent.

    Raises:
        InputError: The sensor needs a field that the worlds of the task do not have; the message names task, agent and sensor.
    """
    try:
        return sensor.of(moment)
    except AttributeError as fault:
        # an attribute that something else lacks is an error in the sensor itself
        if fault.obj is not moment:
            raise
        raise InputError(
            f"The sensor {name!r} of {agent} needs {fault.name!r}, which worlds of {task} do not have here. Hint: leave "
            "the sensor out.",
            code="H3-SIM-055",
        ) from fault


def sensors_of(kind: str, sensors: Mapping[str, Sensor]) -> dict[str, Sensor]:
    """Return those sensors that a kind of agent has, by name."""
    return {name: sensor for name, sensor in sensors.items() if kind in sensor.kinds}
