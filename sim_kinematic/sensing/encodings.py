"""Numbers of sensors as networks read them, by unit and bounds of the rows of the table, over an array namespace.

A family of networks has one encoding for each kind of number, which its files of weights have been trained with. NumPy and
PyTorch evaluate the same functions ``of(xp, seen)``: numbers [..., given] to [..., length].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.sensing.table import HUMANOID_GPS, OF_SKILLS, SENSES, TABLE, Sensor, Times

SPEED_MPS = 2.5
"""Velocities and ranges are divided by this, the robot's speed limit."""
DETECTOR = "humanoid_detector"
"""A flag that comes from a picture, which is in no row of the table."""
_FLAG = Sensor(abs, (0.0,), (1.0,))


class Encoding(NamedTuple):
    """Conversion of the numbers of one unit of a sensor to inputs of a network."""

    of: Callable[[Any, Any], Any]
    given: int
    length: int
    times: Times = "once"
    """Number of times that the sensor repeats the unit."""
    dtype: type[np.floating] = np.float32
    """NumPy type in which the encoding is computed."""


def _plain(xp: Any, seen: Any) -> Any:
    del xp
    return seen


def _divided(by: float) -> Callable[[Any, Any], Any]:
    return lambda xp, seen: seen / by


def _side_by_side(sensor: Sensor, of: Callable[[Any, Any], Any]) -> Encoding:
    """Encoding with as many numbers as it is given."""
    return Encoding(of, sensor.width, sensor.width, sensor.times)


# --- of commands: networks beside pictures, and of skills (`sim_kinematic.policies.visual_policy`) -----------------------
def _polar(xp: Any, seen: Any) -> Any:
    """Distance [m] and angle [rad], [..., 6]."""
    d, a = seen[..., :1], seen[..., 1:]
    return xp.concatenate([d / 5, xp.exp(-d / 2), xp.exp(-d), xp.cos(a), xp.sin(a), a / np.pi], -1)


def _spot(xp: Any, seen: Any) -> Any:
    """A point [m] as it is, its direction, and how near it is, [..., 8]."""
    d = xp.sqrt((seen * seen).sum(-1)[..., None])
    return xp.concatenate([seen / SPEED_MPS, seen / (d + 0.1), xp.exp(-2 * d), xp.exp(-8 * d)], -1)


def _of_commands(sensor: Sensor) -> Encoding:
    if sensor.unit == ("m", "rad"):
        return Encoding(_polar, 2, 6, dtype=np.float64)
    if sensor.unit == ("m",) * 3 and sensor.frame == "hand":
        return Encoding(_spot, 3, 8)
    if sensor.unit == ("rad",):
        return _side_by_side(sensor, _divided(np.pi))
    return _side_by_side(sensor, _divided(SPEED_MPS) if sensor.unit else _plain)


# --- of choices: networks of rearrangement (`sim_kinematic.policies.choosers.chooser_network`) ---------------------------
def _polars(xp: Any, seen: Any) -> Any:
    """Distances [m] and angles [rad] by turns [..., 2 n]: all distances in two forms, all cosines, all sines, [..., 4 n]."""
    d, a = seen[..., 0::2], seen[..., 1::2]
    return xp.concatenate([d / 5, xp.exp(-d), xp.cos(a), xp.sin(a)], -1)


def _length(xp: Any, seen: Any) -> Any:
    """Length of a path [m], [..., 2]."""
    return xp.concatenate([seen.clip(None, 30.0) / 10, xp.exp(-seen / 2)], -1)


def _of_choices(sensor: Sensor) -> Encoding:
    if "rad" in sensor.unit:
        return Encoding(_polars, sensor.width, 2 * sensor.width, sensor.times)
    if sensor.unit == ("m",) and np.ravel(sensor.high)[0] == FAR_M:
        return Encoding(_length, 1, 2, sensor.times)
    scale = {("m/s", "m/s"): SPEED_MPS, ("s",): 50.0}.get(sensor.unit)
    return _side_by_side(sensor, _divided(scale) if scale else _plain)


OF_SOCIAL_NAV = (HUMANOID_GPS, DETECTOR, "humanoid_velocity", "egomotion", "way", "range_scan")
"""Numbers that networks of social navigation read."""
OF_COMMANDS: Mapping[str, Encoding] = {
    name: _of_commands(_FLAG if name == DETECTOR else TABLE[name])
    for name in dict.fromkeys((*OF_SOCIAL_NAV, *OF_SKILLS))
}
"""Observations that networks of commands read together with a picture."""
OF_CHOICES: Mapping[str, Encoding] = {
    name: _of_choices(sensor) for name, sensor in SENSES.items() if sensor.times != "choices"
} | {DETECTOR: _of_choices(_FLAG)}
"""Observations that networks of choices can read, besides the sensors that are one of their choices."""
