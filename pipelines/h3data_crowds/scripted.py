"""Policy of the people of scenario cards, who walk to given places at given times and avoid others as a crowd does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import walking_path
from sim_kinematic.crowd.errands import Errand
from sim_kinematic.crowd.roles import ALONE
from sim_kinematic.crowd.traits import Traits
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.policies.crowd.crowds import CrowdMember
from sim_kinematic.policies.policy import PoseAction
from sim_kinematic.policies.views import AgentView

THERE_M = 0.5
"""Distance within which a place counts as reached [m]."""
BEHIND_M, LOST_M = 1.3, 6.0
"""Distances at which people who follow the robot stop behind it, and beyond which they no longer follow [m]."""
PASSED_M = 1.2
"""Distance of the robot past the frame's origin or past the people at which people who yield start walking [m]."""
YIELD_S = 15.0
"""Time after which people who yield start walking in any case [s]."""


class ScriptedPerson:
    """A person with a role: ``walk``, ``stand``, ``yield`` to the robot, or ``follow`` it (see `docs/scenarios.md`)."""

    unversioned = 8
    """Version of the rules of people (`sim_kinematic.crowd.crowd.VERSION`) in recordings that hold none."""

    def __init__(
        self, free: FreeSpace, person: Mapping[str, Any], extra: Mapping[str, Any], traits: Traits, walker: WalkerSpec
    ) -> None:
        """Create the policy of one person.

        Args:
            free: Free floor of the scene.
            person: ``role``, ``path`` [K, 2] [m], ``speed`` [m/s] and ``delay`` [s].
            extra: `Episode.extra`: ``origin`` and ``goal`` of the robot.
            traits: Traits of the person, whose speed becomes that of the card.
            walker: Rules of walking.
        """
        self._role, self._delay = str(person["role"]), float(person["delay"])
        self._path, self._next = np.array(person["path"], np.float64).reshape(-1, 2), 0
        self._origin, self._goal = np.array(extra["origin"]), np.array(extra["goal"])
        self._time, self._robot = 0.0, np.full(2, np.nan)
        self.member = CrowdMember(
            model="orca",
            free=free,
            traits=traits._replace(speed_mps=float(person["speed"])),
            walker=walker,
            guide=self._guide,
            role=ALONE,
            seed=0,  # conversations alone depend on it
        )

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the person in recordings, as those of other people of crowds."""
        return self.member.facts

    def repeat(self, version: int) -> None:
        """Decide by a version of the rules, as in a recording."""
        self.member = replace(self.member, version=version)

    def act(self, view: AgentView) -> PoseAction:
        """Return the person's place after the next step."""
        if self._role == "stand":
            return PoseAction(view.xz.copy(), view.heading)
        self._time, self._robot = view.step * STEP_S, view.places[0, :2].copy()
        return view.crowds().move(self.member, view.agent, view.step)

    def _guide(
        self, xz: NDArray[np.float64], _group_goal: NDArray[np.float64] | None, _taken: Sequence[Array]
    ) -> Errand:
        goal = self._find_goal(xz)
        if goal is None:
            return Errand(np.zeros((0, 2)))
        path = walking_path(self.member.free, xz, np.asarray(goal, np.float64), self.member.walker)
        return Errand(_shortened(path, BEHIND_M) if self._role == "follow" else path)

    def _find_goal(self, xz: Array) -> Array | None:
        if self._role == "follow":
            away = float(np.hypot(*(self._robot - xz)))
            return self._robot if BEHIND_M + 0.4 < away < LOST_M else None
        while self._next < len(self._path) and np.hypot(*(self._path[self._next] - xz)) < THERE_M:
            self._next += 1
        if self._next == len(self._path) or self._time < self._delay:
            return None
        if self._role == "yield" and not self._has_passed():
            return None
        return self._path[self._next]

    def _has_passed(self) -> bool:
        out = self._goal - self._origin
        out = out / max(float(np.hypot(*out)), 1e-9)
        return float((self._robot - self._origin) @ out) > PASSED_M or self._time > YIELD_S


def _shortened(path: NDArray[np.float64], by_m: float) -> NDArray[np.float64]:
    """Return the path [K, 2] without its last ``by_m`` [m]."""
    left = by_m
    for k in range(len(path) - 1, 0, -1):
        length = float(np.hypot(*(path[k] - path[k - 1])))
        if length > left:
            end = path[k] + (path[k - 1] - path[k]) * (left / length)
            return np.vstack([path[:k], end])
        left -= length
    return np.zeros((0, 2))
