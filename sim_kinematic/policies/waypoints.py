"""Policies that walk or drive from one random point of the home to another."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.avoidance.robot_base import footprint_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import keep_clear
from sim_kinematic.avoidance.yielding import Seen, avoided, in_the_way, waits
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.policies.policy import StrideTo, Towards, Velocity
from sim_kinematic.policies.views import AgentView

ARRIVED_M = 0.3
"""A robot has reached its way point when it is this near."""
GIVES_UP_STEPS = 30
"""After this many steps without progress an agent goes elsewhere."""


class WaypointPolicy(WaypointHuman):
    """The scripted person of social navigation: shortest paths to random points (paper section 4.1). Reacts to nobody."""

    def act(self, view: AgentView) -> Towards | StrideTo:
        """The way point to walk to, or the next stride."""
        return self.move(np.asarray(view.xz, np.float64), view.heading)

    def move(self, xz: NDArray[np.float64], heading: float) -> Towards | StrideTo:
        """The same from ``xz`` [2] and ``heading``: all that this policy looks at."""
        if self.spec.stride is None:
            return Towards(self.target(xz))
        x, z, turned = self.stride(xz, heading)
        return StrideTo(np.array([x, z]), turned)


class WanderPolicy:
    """A robot or person that wanders about and gives way to the others."""

    def __init__(self, free: FreeSpace, seed: int, walker: WalkerSpec, number: int) -> None:
        self._walker = WaypointHuman(free, seed, walker)
        self._number, self._stood = number, 0

    def act(self, view: AgentView) -> Towards | StrideTo | Velocity:
        """A way point or a stride for a person, a velocity for a robot."""
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
        return self._drive(view, others) if view.kinds[k] == "robot" else self._walk(view, others)

    def _walk(self, view: AgentView, others: Sequence[Seen]) -> Towards | StrideTo:
        xz = np.asarray(view.xz, np.float64)
        if self._walker.spec.stride is not None:
            goes = partial(self._goes, xz, others)
            return StrideTo(*self._walker.careful_stride(xz, view.heading, goes))
        target = self._walker.target(xz)
        return Towards(target if self._goes(xz, others, target) else xz.copy())

    def _goes(self, xz: NDArray[np.float64], others: Sequence[Seen], target: Array) -> bool:
        """Whether nobody makes the person wait on the way to a point."""
        blocker = in_the_way(xz, target, others)
        if blocker is None:
            return True
        stands = float(np.hypot(*blocker.velocity)) <= AVOIDANCE.stands_mps
        is_close = float(np.hypot(*(blocker.xz - xz))) < AVOIDANCE.apart_m
        return not (stands or is_close or waits(self._number, blocker))

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
