"""People of one world who walk from goal to goal and choose their velocities among others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.crowd.step import step_crowd
from sim_kinematic.crowd.traits import CrowdSpec, Traits
from sim_kinematic.motion.spec import STEP_S, StrideSpec
from sim_kinematic.motion.step import discs_at

CrowdModel = Literal["social_force", "orca"]
FindPath = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Returns the path [K, 2] to a person's next goal from a place [2]; K < 2: there is none."""
ARRIVED_M = 0.4
"""A goal counts as reached within this distance."""
ATTEMPTS = 8
"""Goals that are tried in one step, some of which may be reached already."""
STUCK_PATHS, AWAY_M = 4, 1.0
"""People who are stuck compare so many goals by how near others are to the path at this distance."""


class Discs(NamedTuple):
    """Agents around a crowd as discs."""

    xz: Array
    """Centres now [N, 2] [m],"""
    before: Array
    """and one step ago [N, 2] [m]."""
    radius: Array
    """Radii [N] [m]."""


NO_DISCS = Discs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def robot_discs(
    xz: Array, heading: float, before: Array, heading_before: float, offsets: Sequence[float], radius_m: float
) -> Discs:
    """Discs of a robot's base at a place [2] and heading [rad], now and one step ago."""
    now, was = (
        discs_at(place[None], np.array([angle]), tuple(offsets), radius_m)[0]
        for place, angle in ((xz, heading), (before, heading_before))
    )
    return Discs(now[:, :2], was[:, :2], now[:, 2])


def _room_on(path: Array, others: Array) -> float:
    """Distance [m] of the nearest of ``others`` [N, 2] to a path [K, 2] at `AWAY_M` from its beginning."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.array([np.interp(AWAY_M, along, path[:, k]) for k in range(2)])
    return float(np.hypot(*(others - at).T).min()) if len(others) else np.inf


class Crowd:
    """M people on one floor, all of whom follow one model.

    Positions are those of the world and are given anew in each step; goals, paths and chosen velocities are remembered.
    """

    def __init__(
        self,
        free: FreeSpace,
        traits: Sequence[Traits],
        find_paths: Sequence[FindPath],
        model: CrowdModel,
        *,
        spec: CrowdSpec | None = None,
        stride: StrideSpec | None = None,
    ) -> None:
        """Creates a crowd that stands still and has no goals yet.

        Args:
            free: Floor on which all of them walk.
            traits: Traits of each person [M].
            find_paths: Function of each person that finds the path to their next goal [M].
            model: ``orca`` (reciprocal avoidance) or ``social_force``.
            spec: Constants of avoidance.
            stride: Limits of walking.
        """
        people = len(traits)
        self._grid = free.sdf, free.origin, free.cell_m
        self._traits, self._find_paths = np.array(traits, np.float64).reshape(people, 6), list(find_paths)
        self._forces, self._rules = model == "social_force", (spec or CrowdSpec()).numbers
        self._limits = (stride or StrideSpec()).limits
        self._paths, self._lengths = np.zeros((people, 2, 2)), np.zeros((people, 2))
        self._counts = np.zeros(people, np.int64)
        self._along, self._best = np.zeros(people), np.zeros((people, 2))
        self._claims, self._body = np.zeros((people, 6)), np.zeros((people, 4))
        self._chosen, self._began = np.zeros((people, 2)), False

    @property
    def goals(self) -> Array:
        """Goal of each person [M, 2] [m]."""
        return self._paths[np.arange(len(self._counts)), np.maximum(self._counts - 1, 0)]

    def step(self, xz: Array, heading: Array, before: Array, others: Discs, step: int) -> tuple[Array, Array]:
        """Returns positions [M, 2] [m] and headings [M] [rad] after one more step.

        Args:
            xz: Positions now [M, 2] [m].
            heading: Headings now [M] [rad].
            before: Positions one step ago [M, 2] [m].
            others: Robots and people who are not of this crowd.
            step: Number of the step.
        """
        people = len(xz)
        if not self._began:
            self._body[:, 0] = self._body[:, 3] = heading
            self._began = True
        self._body[:, 0] = heading
        self._choose_goals(xz, step)
        places = np.concatenate([xz, others.xz])
        velocities = (places - np.concatenate([before, others.before])) / STEP_S
        radii = np.concatenate([self._traits[:, 3], others.radius])
        step_crowd(
            *self._grid,
            places,
            velocities,
            radii,
            self._paths,
            self._counts,
            self._lengths,
            self._along,
            self._best,
            self._claims,
            self._body,
            self._chosen,
            self._traits,
            self._forces,
            self._rules,
            self._limits,
            step,
            STEP_S,
        )
        return places[:people], self._body[:, 0].copy()

    def _choose_goals(self, xz: Array, step: int) -> None:
        """Gives a path to those who have arrived, are stuck or have been pushed off theirs."""
        arrived = np.hypot(*(self.goals - xz).T) < ARRIVED_M
        stuck = (step - self._best[:, 1]) * STEP_S > self._traits[:, 5]
        for m in np.flatnonzero(arrived | stuck | (self._counts < 2)).tolist():
            paths = self._paths_from(m, xz[m], STUCK_PATHS if stuck[m] else 1)
            if paths:  # who is stuck turns to where the others are not
                others = np.delete(xz, m, axis=0)
                self._set_path(m, max(paths, key=lambda path: _room_on(path, others)) if len(paths) > 1 else paths[0])
            elif self._counts[m] < 2:  # who finds no goal at all stands where they are
                self._set_path(m, np.array([xz[m], xz[m]], np.float64))
            self._best[m] = 0.0, step

    def _paths_from(self, m: int, xz: Array, most: int) -> list[NDArray[np.float64]]:
        """Up to ``most`` paths of a person to goals that they have not reached already."""
        paths: list[NDArray[np.float64]] = []
        for _ in range(ATTEMPTS):
            path = np.asarray(self._find_paths[m](np.asarray(xz, np.float64)), np.float64)
            if len(path) > 1 and np.hypot(*(path[-1] - xz)) >= ARRIVED_M:
                paths.append(path)
            if len(paths) == most:
                break
        return paths

    def _set_path(self, m: int, path: NDArray[np.float64]) -> None:
        if len(path) > self._paths.shape[1]:
            more = 2 * len(path) - self._paths.shape[1]
            self._paths = np.pad(self._paths, ((0, 0), (0, more), (0, 0)))
            self._lengths = np.pad(self._lengths, ((0, 0), (0, more)))
        count = len(path)
        self._paths[m, :count], self._counts[m] = path, count
        self._lengths[m, :count] = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        self._along[m] = self._claims[m, 0] = 0.0
