"""The home with two storeys in which tests of stairs play, made once."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from h3data.scene import FreeSpace, Room, Scene
from h3data.scene.floor_heights import flight_rectangle
from h3data_homes import HomeSpec, build_home

SPEC = HomeSpec(seed=3, generation=2, storeys=2)


@functools.cache
def home() -> Scene:
    """``small2-storeys:3``."""
    return build_home(SPEC)


@functools.cache
def floor() -> FreeSpace:
    """Its free floor."""
    return FreeSpace.from_scene(home())


def stairs() -> Room:
    """The room with the ramp."""
    return next(room for room in home().rooms if room.ramp is not None)


def flight() -> tuple[float, float, float, float]:
    """Plan rectangle of the ramp."""
    return flight_rectangle(floor().heights[floor().heights[:, -1] > 0][0])


def ends() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places on the landings before the first and behind the last step, in the middle."""
    room, ramp = stairs(), stairs().ramp
    assert ramp is not None
    x = float(room.rectangles[0, [0, 2]].mean())
    sign = np.sign(ramp.end - ramp.start)
    return np.array([x, ramp.start - 0.7 * sign]), np.array([x, ramp.end + 0.7 * sign])
