"""Encodings of sensors for networks, chosen by the units and bounds in the table of sensors.

A family of networks has one encoding for each kind of number, with which its files of weights were trained, so an
encoding must never change. NumPy and PyTorch evaluate the same functions ``of(xp, seen)``, which convert numbers [...,
given] to [..., length].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.sensing.table import HUMANOID_GPS, OF_SKILLS, SENSES, TABLE, Sensor, Times

SPEED_MPS = 2.5
"""Divisor of velocities and ranges, which is the robot's speed limit [m/s]."""
DETECTOR = "humanoid_detector"
"""Name of a flag that is computed from a picture, and is therefore not in the table."""
_FLAG = Sensor(abs, (0.0,), (1.0,))
"""Sensor of a flag, which is used in place of the row of the table."""


class Encoding(NamedTuple):
    """Conversion of a sensor's numbers of one unit to inputs of a network."""

    of: Callable[[Any, Any], Any]
    given: int
    length: int
    times: Times = "once"
    """Number of times that the sensor repeats the unit."""
    dtype: type[np.floating] = np.float32
    """NumPy type in which the encoding is computed."""


def _divided(sensor: Sensor, by: float | None) -> Encoding:
    """Return the encoding that divides the numbers of a sensor; None leaves them as they are."""
    return Encoding(lambda xp, seen: seen / by if by else seen, sensor.width, sensor.width, sensor.times)


# --- of commands: networks beside pictures, and of skills (`sim_kinematic.policies.visual_policy`) -----------------------
def _polar(xp: Any, seen: Any) -> Any:
    """Return the distance [m] and angle [rad], [..., 6]."""
    # cosine and sine do not jump straight behind the robot, where the angle itself does
    d, a = seen[..., :1], seen[..., 1:]
    return xp.concatenate([d / 5, xp.exp(-d / 2), xp.exp(-d), xp.cos(a), xp.sin(a), a / np.pi], -1)


def _spot(xp: Any, seen: Any) -> Any:
    """Return a point [m] divided by `SPEED_MPS`, its direction, and its nearness on two scales, [..., 8]."""
    # 0.1 m keeps the direction finite at the point itself
    d = xp.sqrt((seen * seen).sum(-1)[..., None])
    return xp.concatenate([seen / SPEED_MPS, seen / (d + 0.1), xp.exp(-2 * d), xp.exp(-8 * d)], -1)


def _of_commands(sensor: Sensor) -> Encoding:
    if sensor.unit == ("m", "rad"):
        return Encoding(_polar, 2, 6, dtype=np.float64)
    if sensor.unit == ("m",) * 3 and sensor.frame == "hand":
        return Encoding(_spot, 3, 8)
    if sensor.unit == ("rad",):
        return _divided(sensor, np.pi)
    return _divided(sensor, SPEED_MPS if sensor.unit else None)


# --- of choices: networks of rearrangement (`sim_kinematic.policies.choosers.chooser_network`) ---------------------------
def _polars(xp: Any, seen: Any) -> Any:
    """Return the encoding [..., 4 n] of alternating distances [m] and angles [rad] [..., 2 n].

    It has all distances in two forms, then all cosines, then all sines.
    """
    d, a = seen[..., 0::2], seen[..., 1::2]
    return xp.concatenate([d / 5, xp.exp(-d), xp.cos(a), xp.sin(a)], -1)


def _length(xp: Any, seen: Any) -> Any:
    """Return the length of a path [m], [..., 2]."""
    # a path that does not exist is `FAR_M` long, an input of 100 if it were not clipped
    return xp.concatenate([seen.clip(None, 30.0) / 10, xp.exp(-seen / 2)], -1)


def _of_choices(sensor: Sensor) -> Encoding:
    if "rad" in sensor.unit:
        return Encoding(_polars, sensor.width, 2 * sensor.width, sensor.times)
    if sensor.unit == ("m",) and np.ravel(sensor.high)[0] == FAR_M:
        return Encoding(_length, 1, 2, sensor.times)
    return _divided(sensor, {("m/s", "m/s"): SPEED_MPS, ("s",): 50.0}.get(sensor.unit))


OF_SOCIAL_NAV = (HUMANOID_GPS, DETECTOR, "humanoid_velocity", "egomotion", "way", "range_scan")
"""Names of the observations that networks of social navigation read."""
OF_COMMANDS: Mapping[str, Encoding] = {
    **{
        name: _of_commands(_FLAG if name == DETECTOR else TABLE[name])
        for name in dict.fromkeys((*OF_SOCIAL_NAV, *OF_SKILLS))
    },
    # of crowd_nav (`h3data_crowds.crowd_nav`), whose people come as numbers from -2 to 2
    "goal_gps": Encoding(_polar, 2, 6, dtype=np.float64),
    "goal_way": Encoding(_polar, 2, 6, dtype=np.float64),
    "people": Encoding(lambda xp, seen: seen, 20, 20),
}
"""Encodings of the observations that networks of commands read together with a picture, by name."""
OF_CHOICES: Mapping[str, Encoding] = {
    name: _of_choices(sensor) for name, sensor in SENSES.items() if sensor.times != "choices"
} | {DETECTOR: _of_choices(_FLAG)}
"""Encodings of the observations that networks of choices can read in addition to the sensors of choices, by name."""
