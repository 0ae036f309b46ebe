"""The observations that agents of any task can be shown beside pictures: one table, a row per sensor.

A sensor of one's own is one more row: ``{**SENSORS, "goal": Sensor(...)}`` returned by `Task.sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import Array, ground_pose
from h3data.moved import refuse_renamed
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import AgentState
from sim_kinematic.sensing.agent_pictures import Limits
from sim_kinematic.sensing.sensor import (
    FAR_M,
    FAST,
    RANGE_M,
    RANGES,
    egomotion,
    gps_compass,
    humanoid_velocity,
    in_frame,
    localization,
    localization_in_start_frame,
    range_scan,
    way,
)
from sim_kinematic.world import World

if not TYPE_CHECKING:
    __getattr__ = refuse_renamed(__name__)

JOINT_MOST = 10.0
"""Bound of joint positions [rad or m]."""
PAIR_SENSORS = ("humanoid_gps", "humanoid_velocity", "way", "humanoid_in_start_frame")
"""Sensors of another agent, which a lone one does not have."""


class SensorContext(NamedTuple):
    """One agent of each world, now."""

    spec: Any
    """The task's rules."""
    base: BaseSpec
    """Discs and limits of the agent."""
    memory: Any
    """State that the task stores between steps (`WorldRollout.memory`), for its own sensors."""
    episodes: Sequence[Any]
    """The episode of each world."""
    world: World
    agent: int
    now: AgentState
    before: AgentState
    """One step ago."""
    start: AgentState
    other: AgentState
    """The other agent: of a robot the first person, of a person the first robot, else the next agent."""
    other_before: AgentState
    contact: NDArray[np.bool_]
    """The agent touched an obstacle in the last step, [W]."""
    touching: NDArray[np.bool_]
    """It touches another agent, [W]."""
    arm: Array
    """Joint positions of its arm, which rests, [n]; of a person [0]."""
    distance: Callable[[], Array]
    """Length of the shortest path to the other agent [m], [W]."""


class Sensor(NamedTuple):
    """An observation that is no picture."""

    of: Callable[[Any], NDArray[np.floating]]
    """Values [W, n] of a `SensorContext`."""
    low: ArrayLike
    high: ArrayLike

    def limits(self, repeat: int = 1) -> Limits:
        """The space of one world's values."""
        low, high = (np.array(bound, np.float32).repeat(repeat) for bound in (self.low, self.high))
        return Limits(low, high, low.shape, np.float32)


def _other_from_start(moment: SensorContext) -> NDArray[np.floating]:
    heights = moment.world.heights
    start = ground_pose(moment.start.xz, moment.start.heading, heights(moment.start.xz))
    other = ground_pose(moment.other.xz, moment.other.heading, heights(moment.other.xz))
    return in_frame(start, other[:, None, :3])[:, 0]


def _path_to_other(moment: SensorContext) -> NDArray[np.floating]:
    begun = moment.base.disc_radius_m / 2
    xz, heading, other = moment.now.xz, moment.now.heading.tolist(), moment.other.xz
    length = moment.distance().tolist()
    values = np.zeros((len(xz), 2))
    for free, rows in moment.world.groups:
        values[rows] = [way(free, xz[w], heading[w], other[w], length[w], beyond_m=begun) for w in rows]
    return values


def _range_scan(moment: SensorContext) -> NDArray[np.floating]:
    values = np.zeros((len(moment.now.xz), RANGES))
    for free, rows in moment.world.groups:
        values[rows] = range_scan(free, moment.now.xz[rows], moment.now.heading[rows])
    return values


SENSORS: Mapping[str, Sensor] = {
    "humanoid_gps": Sensor(lambda m: gps_compass(m.now.xz, m.now.heading, m.other.xz), [0.0, -np.pi], [FAR_M, np.pi]),
    "egomotion": Sensor(
        lambda m: egomotion(m.before.xz, m.before.heading, m.now.xz, m.now.heading), [-FAST] * 3, [FAST] * 3
    ),
    "localization": Sensor(
        lambda m: localization(m.now.xz, m.now.heading, m.world.heights(m.now.xz)),
        [-FAR_M] * 3 + [-np.pi],
        [FAR_M] * 3 + [np.pi],
    ),
    "humanoid_velocity": Sensor(
        lambda m: humanoid_velocity(m.now.heading, m.other_before.xz, m.other.xz), [-FAST] * 2, [FAST] * 2
    ),
    "way": Sensor(_path_to_other, [0.0, -np.pi], [FAR_M, np.pi]),
    "range_scan": Sensor(_range_scan, [0.0] * RANGES, [RANGE_M] * RANGES),
    "localization_in_start_frame": Sensor(
        lambda m: localization_in_start_frame(m.start.xz, m.start.heading, m.now.xz, m.now.heading),
        [-FAR_M] * 3 + [-np.pi],
        [FAR_M] * 3 + [np.pi],
    ),
    "humanoid_in_start_frame": Sensor(_other_from_start, [-FAR_M] * 3, [FAR_M] * 3),
    "collision": Sensor(lambda m: np.stack([m.contact, m.touching], -1).astype(np.float64), [0.0] * 2, [1.0] * 2),
    "is_holding": Sensor(lambda m: np.zeros((m.world.worlds, 1)), [0.0], [1.0]),
    "arm_joints": Sensor(lambda m: np.tile(m.arm, (m.world.worlds, 1)), [-JOINT_MOST], [JOINT_MOST]),
}
"""``humanoid_gps``: distance [m] and angle [rad], positive to the right, of the other agent. ``egomotion``: forward, left
[m/s] and turn [rad/s] of the last step. ``localization``: x, y, z [m] and heading [rad] in the world.
``humanoid_velocity``: forward and left [m/s] of the other's last step. ``way``: length of the shortest path to the other [m]
and the angle at which it begins [rad]. ``range_scan``: free distance in 12 directions [m]. ``collision``: with an obstacle,
with another agent."""


def sensors_of(kind: str) -> Mapping[str, Sensor]:
    """The sensors of agents of a kind: people have no arm joints that could be read."""
    return SENSORS if kind == "robot" else {name: sensor for name, sensor in SENSORS.items() if name != "arm_joints"}
