"""Policy that outputs single commands, and maneuvers out of places where it is stuck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_kinematic.avoidance.maneuvers import plan_maneuver
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import SocialNavView

NEAR_M = 2.0
"""Distance from the person below which a maneuver ends or does not start, as maneuvers do not avoid people [m]."""


class Maneuvering:
    """Policy that computes velocities from the view, and maneuvers out of places where the base is stuck.

    When the base has not moved for a moment, it makes a maneuver (`sim_kinematic.avoidance.maneuvers`) towards the
    person. A base 1.2 m long that is wedged between two walls needs several commands to get out, the first of which
    does not shorten the path. Without maneuvers, experts stood like that for the rest of 3% of the episodes.
    """

    def __init__(self, function: Callable[[SocialNavView, BaseSpec], Velocity], base: BaseSpec) -> None:
        self._function, self._base = function, base
        self.__name__ = function.__name__
        self._still = 0
        """Number of steps for which the base has not moved although it was to find or follow the person."""
        self._commands: list[tuple[float, float]] = []

    def act(self, view: SocialNavView) -> Velocity:
        """Return the function's command, or the next one of a maneuver."""
        wish = self._function(view, self._base)
        # a robot that waits or backs away may stand still on purpose
        if not self._base.maneuvers or wish.skill not in ("find", "follow"):
            self._still, self._commands = 0, []
            return wish
        # equal to the last bit: a base that is pressed against walls does not move at all
        before = view.robot_before
        rests = before is not None and (view.robot_xz == before[0]).all() and view.robot_heading == before[1]
        self._still = self._still + 1 if rests else 0
        if float(np.hypot(*(view.human_xz - view.robot_xz))) < NEAR_M:
            self._commands = []
        # again after every interval: a plan may have found nothing or not led out
        elif self._still and self._still % AVOIDANCE.maneuver_after_steps == 0:
            self._commands = [(forward, turn) for forward, turn in self._plan(view)]
        return Velocity(*self._commands.pop(0), wish.skill) if self._commands else wish

    def _plan(self, view: SocialNavView) -> list[list[float]]:
        """Return commands (forward, turn), one per step, that lead the base towards the person; empty: there are none."""
        # without discs of others: near the person the maneuver ends anyway (`NEAR_M`)
        nobody = np.zeros((0, 3))
        return plan_maneuver(view.free, self._base, view.robot_xz, view.robot_heading, view.human_xz, nobody).tolist()
