"""Scripted person of social navigation, who walks shortest paths to random points of the home.

The script follows the paper (section 4.1) and habitat-lab (spec/habitat.md 1.4). The person does not react to the
robot, so the seed, or the given goals, determine the whole track.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import sample_sdf, sdf_gradient
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.motion.stride import Strider


@dataclass(frozen=True)
class WaypointSpec:
    """Constants of walks along waypoints."""

    most_steps: int = 20_000
    """Largest number of steps of a walk to one goal, eleven minutes."""
    arc_step_m: float = 0.08
    """Distance below which waypoints belong to one rounded corner [m] (5 cm apart at a radius of 0.25 m)."""
    arc_turn_max: float = 1.75
    """Angle above which corners are not rounded [rad]: their tangents meet far away."""
    min_walk_m: float = 1.5
    """Distance below which a new goal is sampled again, because a robot does not learn to follow a person who stands
    still [m]."""
    aside_step_m: float = 0.02
    """Length of the steps in which a waypoint is moved away from obstacles [m]."""
    ahead_m: float = 0.2
    """Distance of sampled goals from obstacles beyond `WalkerSpec.clearance_m`, because people may arrive there at full
    speed [m]."""
    apart_m: float = 0.15
    """Least distance between waypoints that are moved away from obstacles [m]: with short legs, people would turn on
    the spot."""


WAYPOINTS = WaypointSpec()


@dataclass
class WaypointHuman:
    """Person who walks along waypoints, whose whole state is the current goal and waypoint (``goal`` and ``leg``)."""

    free: FreeSpace
    seed: int
    spec: WalkerSpec
    given: Sequence[tuple[float, float]] = ()
    """Goals ``(x, z)`` to walk to first; after them goals are sampled."""
    goal: int = -1
    """Index of the current goal, -1 before the first."""
    leg: int = 0
    """Index of the waypoint within the path to the goal."""
    goals: list[NDArray[np.float64]] = field(default_factory=list)
    """Goals so far, each ``(x, z)`` [m]."""
    _path: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    _strider: Strider | None = None
    _track: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    _row: int = 0

    def target(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the waypoint ``(x, z)`` to walk to from ``position``; sample a new goal when the last is reached."""
        while True:
            while self.leg < len(self._path):
                waypoint = self._path[self.leg]
                if np.hypot(*(waypoint - position).tolist()) > self.spec.arrive_m:
                    return waypoint
                self.leg += 1
            self._next_goal(position)

    def stride(self, xz: NDArray[np.float64], heading: float) -> NDArray[np.float64]:
        """Return the pose (x, z, heading) one step after the present one, with `WalkerSpec.stride`.

        The person reacts to nobody, so the walk to each goal is computed at once.
        """
        while self._row >= len(self._track):
            self._next_goal(xz)
            self._track, self._row = self._strides().whole(xz, heading, most=WAYPOINTS.most_steps), 0
        self._row += 1
        return self._track[self._row - 1]

    def _strides(self) -> Strider:
        if self._strider is None:
            self._strider = Strider(self.free, self.spec)
        return self._strider

    def next_goal(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the next goal [2] of a person at ``position`` [2]: a given one, or else a sampled one.

        A sampled goal is at least `WAYPOINTS.min_walk_m` away.
        """
        self.goal += 1
        goal = np.array(self.given[self.goal]) if self.goal < len(self.given) else self._drawn(position)
        self.goals.append(goal)
        return goal

    def _next_goal(self, position: NDArray[np.float64]) -> None:
        self._path = walking_path(self.free, position, self.next_goal(position), self.spec)
        # point 0 of the path is where the person is
        self.leg = 1
        if self.spec.stride is not None:
            self._strides().begin(self._path)

    def _drawn(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        # by the number of the goal, so that the walk goes on the same wherever it is resumed
        candidates = self.free.sample(generator(self.seed, "human_goal", step=self.goal), 32)
        lengths = self.free.geodesic(np.broadcast_to(position, candidates.shape), candidates)
        walkable = np.flatnonzero(np.isfinite(lengths) & (lengths >= WAYPOINTS.min_walk_m))
        # a home with nothing that far away: the farthest point there is
        pick = walkable[0] if len(walkable) else int(np.argmax(np.where(np.isfinite(lengths), lengths, -1)))
        clearance = self.spec.clearance_m
        return aside(self.free, candidates[pick], clearance + WAYPOINTS.ahead_m) if clearance else candidates[pick]


def walking_path(
    free: FreeSpace, start: NDArray[np.float64], goal: NDArray[np.float64], spec: WalkerSpec
) -> NDArray[np.float64]:
    """Return the waypoints [K, 2] [m] of a person from ``start`` to ``goal``.

    The waypoints are those of the shortest path with sharp corners, each moved up to ``spec.clearance_m`` away from
    walls and furniture where there is room. If K is 0, there is no path.
    """
    path = free.path(start, goal)
    return with_room(free, sharp_corners(free, path), spec.clearance_m) if len(path) else path


def with_room(free: FreeSpace, path: NDArray[np.float64], clearance_m: float) -> NDArray[np.float64]:
    """Return the path [K, 2] with its corners moved away from obstacles, up to ``clearance_m``; its ends stay.

    A shortest path touches obstacles only at its corners, so moving them gives room to the legs between them as well. A
    corner moves only as far as the straight lines to both its neighbours stay free.
    """
    roomy = path.copy()
    for k in range(1, len(path) - 1):
        away = aside(free, path[k], clearance_m) - path[k]
        for share in (1.0, 0.5, 0.25):
            moved = path[k] + share * away
            # the corner before has moved already, the one after has not yet
            ends = roomy[k - 1], path[k + 1]
            apart = all(np.hypot(*(moved - end)) >= WAYPOINTS.apart_m for end in ends)
            if apart and all(_sees(free, end, moved) for end in ends):
                roomy[k] = moved
                break
    return roomy


def aside(free: FreeSpace, point: NDArray[np.float64], clearance_m: float) -> NDArray[np.float64]:
    """Return a point [2] moved away from obstacles until it has ``clearance_m`` [m], or until there is no more room."""
    ends = float(point[0]), float(point[1]), float(clearance_m), WAYPOINTS.aside_step_m
    return np.array(free.entries(_aside, free.sdf, free.origin, free.cell_m, *ends))


@kernel(error_model="numpy")
def _aside(sdf, origin, cell, x, z, clearance, step):
    room = sample_sdf(sdf, origin, cell, x, z)
    while room < clearance:
        gx, gz = sdf_gradient(sdf, origin, cell, x, z)
        length = math.hypot(gx, gz)
        if length < 1e-6:
            break
        gx, gz = gx / length * min(step, clearance - room), gz / length * min(step, clearance - room)
        wider = sample_sdf(sdf, origin, cell, x + gx, z + gz)
        # on a ridge between two things there is no more room, and steps would go to and fro across it
        if wider < room + 1e-3:
            break
        x, z, room = x + gx, z + gz, wider
    return x, z


def sharp_corners(free: FreeSpace, path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the path [K, 2] with each rounded corner replaced by the intersection of its tangents, if that path is free.

    A shortest path follows an inflated corner in many short legs, and a person who turns on the spot before each leg
    would stutter.
    """
    short = np.hypot(*np.diff(path, axis=0).T) < WAYPOINTS.arc_step_m
    kept = [path[0]]
    k = 1
    while k < len(path) - 1:
        last = k
        while last < len(path) - 2 and short[last]:
            last += 1
        meeting = _tangents_meet(path[k - 1 : k + 1], path[last : last + 2]) if last > k else None
        if meeting is not None and _sees(free, kept[-1], meeting) and _sees(free, meeting, path[last + 1]):
            kept.append(meeting)
        else:
            kept += list(path[k : last + 1])
        k = last + 1
    return np.array([*kept, path[-1]])


def _tangents_meet(arriving: NDArray[np.float64], leaving: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return where the lines through two legs [2, 2] cross ahead of the first; None if the turn between them is too wide."""
    u, v = arriving[1] - arriving[0], leaving[1] - leaving[0]
    cross = u[0] * v[1] - u[1] * v[0]
    # a cross product of 0: parallel legs meet nowhere
    if abs(np.arctan2(cross, u @ v)) > WAYPOINTS.arc_turn_max or cross == 0:
        return None
    gap = leaving[0] - arriving[0]
    # a + s u = b + t v, solved for s by Cramer's rule
    return arriving[0] + u * ((gap[0] * v[1] - gap[1] * v[0]) / cross)


def _sees(free: FreeSpace, a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Return whether the straight way from a to b is free: then it is the shortest."""
    # hardly snapped: a point beside the floor would be moved onto it, and its way would pass as free
    return float(free.geodesic(a, b, max_snap_m=1e-3)) <= float(np.hypot(*(b - a))) + 1e-6


class HumanPlan(NamedTuple):
    """Plan of the scripted person, who does not react to the robot."""

    xz: NDArray[np.float64]
    """Positions of the person after each step, shape [steps, 2] [m]."""
    goals: list[NDArray[np.float64]]
    """Points that the person walks to, one after the other, ``(x, z)`` each [m]."""


def human_plan(
    free: FreeSpace,
    start_xz: NDArray[np.float64],
    heading: float,
    seed: int,
    spec: WalkerSpec,
    steps: int,
    given: Sequence[tuple[float, float]] = (),
) -> HumanPlan:
    """Return the scripted person's positions in each of ``steps`` steps, and their goals (first those ``given``)."""
    state = HumanState.zeros(1)
    state.xz[0], state.heading[0] = start_xz, heading
    human = WaypointHuman(free, seed, spec, given)
    track = np.empty((steps, 2))
    for k in range(steps):
        if spec.stride is None:
            walk_humans(state, human.target(state.xz[0])[None], spec)
        else:
            state.xz[0, 0], state.xz[0, 1], state.heading[0] = human.stride(state.xz[0], state.heading.item(0))
        track[k] = state.xz[0]
    return HumanPlan(track, human.goals)
