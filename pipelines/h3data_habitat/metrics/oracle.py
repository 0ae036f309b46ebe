"""Minimum steps ``l`` of the oracle in SPS and F, computed with a greedy robot as in Habitat's code.

At each step i Habitat simulates a robot from the episode's start to the current position of the human: it turns on the spot
until the next waypoint is within 0.1 rad, else drives. l is the first i for which this takes at most i steps. The motion is
integrated at 60 Hz on habitat-lab's main branch, which makes that robot twice as fast as the real one, and at 120 Hz in
0.3.0 (spec/habitat.md 1.6). The paper requires fewer than i steps instead, at equally spaced waypoints.

It needs a map, so it cannot be computed from a recording: compute it once and store it in ``info``::

    finder = PathFinder(FreeSpace.from_scene(scene))
    l = {str(hz): oracle_min_steps(finder, robot_pose[0], human_pose[:, :3], hz=hz) for hz in (60, 120)}
    info["habitat_min_steps"] = {hz: steps for hz, steps in l.items() if steps is not None}
"""

from __future__ import annotations

import math
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import heading_from_quat

REACH_M, FACING = 2.0, 0.5
TURN_ONLY_M, AIM_RAD = 0.2, 0.1
LONGEST = 1501
"""Number of steps after which Habitat's loop gives up and returns this number."""


class Paths(Protocol):
    """A shortest-path planner: `h3data_habitat.navmesh.pathfinder.PathFinder` or habitat-sim's own."""

    def path(self, start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
        """Return waypoints [k, 3] from start to end; k = 0 if there is no path."""
        ...


def steps_to_find(
    paths: Paths, robot_pose: ArrayLike, human_pos: ArrayLike, *, hz: float = 120.0, speed: float = 10.0
) -> int:
    """Return the steps ``r`` of the greedy robot from a pose7 [7] until it is within 2 m of a standing human [3], facing them.

    ``speed`` is in Habitat's units, for driving [m] and turning [rad], integrated over 1 / ``hz`` seconds per step.
    """
    if hz <= 0 or speed <= 0:
        raise InputError(f"Expected a rate and a speed above 0, got {hz} Hz and {speed}.", code="H3-METRIC-013")
    pose = np.asarray(robot_pose, np.float64)
    human = np.asarray(human_pos, np.float64)
    x, z = float(pose[0]), float(pose[2])
    heading = float(heading_from_quat(pose[3:]))
    stride = speed / hz
    path: NDArray[np.float64] | None = None
    length = 0.0
    for steps in range(LONGEST):
        if path is None:  # planned again after each drive; turning on the spot leaves it as it is
            path = paths.path((x, human[1], z), human)
            length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if len(path) > 1 else math.inf
        forward = math.cos(heading), -math.sin(heading)
        if length <= REACH_M and _cosine(forward, (human[0] - x, human[2] - z)) > FACING:
            return steps
        # the first point of the path is where the robot stands
        target = path[1] if len(path) > 1 else human
        aim = target[0] - x, target[2] - z
        near = math.hypot(human[0] - x, human[2] - z) < TURN_ONLY_M
        if not near and math.acos(_cosine(forward, aim)) < AIM_RAD:
            x, z, path = x + forward[0] * stride, z + forward[1] * stride, None
        else:
            # the shorter way round, by the sign of the cross product on the floor
            heading += -stride if forward[0] * aim[1] - forward[1] * aim[0] > 0 else stride
    return LONGEST


def oracle_min_steps(
    paths: Paths,
    robot_pose: ArrayLike,
    human_pos: ArrayLike,
    *,
    rule: Literal["habitat", "paper"] = "habitat",
    hz: float = 120.0,
    speed: float = 10.0,
    every: int = 1,
) -> int | None:
    """Return ``l``, the first step i = 1, 2, ... whose human position the robot reaches in time; None if there is none.

    Args:
        paths: Planner on the map of the episode.
        robot_pose: pose7 [7] at the start.
        human_pos: Positions [T, 3]; row 0 is the reset, Habitat's step 1.
        rule: ``habitat`` requires r <= i, ``paper`` r < i.
        hz: Rate at which the robot's motion is integrated.
        speed: Speed as in `steps_to_find`.
        every: Tests every n-th step only (the paper's waypoints are equally spaced).
    """
    if every < 1:
        raise InputError(f"Expected every >= 1, got {every}.", code="H3-METRIC-014")
    for i, position in enumerate(np.asarray(human_pos, np.float64), start=1):
        if (i - 1) % every:
            continue
        needed = steps_to_find(paths, robot_pose, position, hz=hz, speed=speed)
        if needed < i or (needed == i and rule == "habitat"):
            return i
    return None


def _cosine(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the cosine between two directions on the floor; ``a`` is a unit vector; 1 if ``b`` has no length."""
    length = math.hypot(*b)
    return max(-1.0, min(1.0, (a[0] * b[0] + a[1] * b[1]) / length)) if length > 0 else 1.0
