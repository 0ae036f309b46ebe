"""Policies that walk or drive from one random point of the home to another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.avoidance.robot_base import footprint_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import keep_clear
from sim_kinematic.avoidance.yielding import Seen, avoided, in_the_way, waits
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.policies.policy import Towards, Velocity
from sim_kinematic.policies.views import AgentView

ARRIVED_M = 0.3
"""A robot has reached its way point when it is this near."""
GIVES_UP_STEPS = 30
"""After this many steps without progress an agent goes elsewhere."""


class WaypointPolicy(WaypointHuman):
    """The scripted person of social navigation: shortest paths to random points (paper section 4.1). Reacts to nobody."""

    def act(self, view: AgentView) -> Towards:
        """The way point to walk to."""
        return Towards(self.target(np.asarray(view.xz, np.float64)))


class WanderPolicy:
    """A robot or person that wanders about and gives way to the others."""

    def __init__(self, free: FreeSpace, seed: int, walker: WalkerSpec, number: int) -> None:
        self._walker = WaypointHuman(free, seed, walker)
        self._number, self._stood = number, 0

    def act(self, view: AgentView) -> Towards | Velocity:
        """A way point for a person, a velocity for a robot."""
        seen = [
            Seen(
                k,
                now[:2].copy(),
                (now[:2] - was[:2]) / STEP_S,
                False,
                kind == "robot",
                footprint=footprint_of(base) if kind == "robot" else AVOIDANCE.person,
            )
            for k, (now, was, kind, base) in enumerate(
                zip(view.places, view.before, view.kinds, view.bases, strict=True)
            )
        ]
        k = self._number
        others = sorted((s for s in seen if s.number != k), key=lambda s: float(np.hypot(*(s.xz - view.xz))))
        self._stood = self._stood + 1 if np.hypot(*seen[k].velocity) < AVOIDANCE.stands_mps else 0
        if self._stood > GIVES_UP_STEPS:
            self._stood, self._walker.leg = 0, 1_000_000  # the next goal
        return self._drive(view, others) if view.kinds[k] == "robot" else Towards(self._walk(view, others))

    def _walk(self, view: AgentView, others: Sequence[Seen]) -> NDArray[np.float64]:
        xz = np.asarray(view.xz, np.float64)
        target = self._walker.target(xz)
        blocker = in_the_way(xz, target, others)
        if blocker is None:
            return target
        stands = float(np.hypot(*blocker.velocity)) <= AVOIDANCE.stands_mps
        is_close = float(np.hypot(*(blocker.xz - xz))) < AVOIDANCE.apart_m
        return xz.copy() if stands or is_close or waits(self._number, blocker) else target

    def _drive(self, view: AgentView, others: Sequence[Seen]) -> Velocity:
        xz, base = np.asarray(view.xz, np.float64), view.base
        target = self._walker.target(xz)
        while np.hypot(*(target - xz)) < ARRIVED_M:
            self._walker.leg += 1
            target = self._walker.target(xz)
        dx, dz = target - xz
        error = float(wrap_angle(np.arctan2(-dz, dx) - view.heading))
        turn = float(np.clip(error / (base.max_turn_rad_s * STEP_S), -1, 1))
        command = max(0.0, float(np.cos(error))) ** 4, turn
        return Velocity(*keep_clear(view.free, base, xz.copy(), view.heading, command, target, avoided(others)))
