"""Habitat's pick and place of a humanoid, step for step: its hand moves to the object and back (spec/habitat.md 2.4)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from h3data_habitat.motion.habitat_humanoid import HabitatHumanoid

HAND_START_M = np.array([0.2, 0.2, 0.0])
"""Point at which the hand's path begins, in the base frame [m]."""
HAND_STEP_M = 0.04
SNAP_M = 0.02


class HabitatPick:
    """Action of habitat-lab's ``HumanoidPickAction`` (main): `step` moves the hand of a `HabitatHumanoid`.

    Habitat's error is reproduced: the hand goes ``int(distance / HAND_STEP_M)`` steps, so where the remainder is
    `SNAP_M` or more it stops short and never takes hold (8 of 14 recorded runs). Our own people pick by
    `h3data.bodies.people.reach`.
    """

    def __init__(self, person: HabitatHumanoid, *, step_m: float = HAND_STEP_M, snap_m: float = SNAP_M) -> None:
        self.person, self.step_m, self.snap_m = person, step_m, snap_m
        self.retracting = False
        """True if the hand is on its way back."""
        self.steps = 0
        """Number of steps by which the hand is ahead of its start."""
        self.done = False
        """True if the last `step` ended a pick or place."""

    def reset(self) -> None:
        """Start a new episode with the hand at its initial position."""
        self.steps = 0
        self.done = False

    def step(self, position: ArrayLike, *, pick: bool, holding: bool) -> Literal["take", "put"] | None:
        """Move the hand by one step; the person's pose is then that of this step.

        Args:
            position: Position of the object, or of its destination, shape [3] [m] in the world.
            pick: True picks the object; False places it.
            holding: True if the person holds something.

        Returns:
            ``take`` if the object is now held, ``put`` if the held object is now at ``position``, or None if nothing
                changes.
        """
        self.done = False
        target = np.asarray(position, np.float64)
        start = self.person.base[:3, :3] @ HAND_START_M + self.person.base[:3, 3]
        distance = float(np.linalg.norm(target - start))
        # before the step is counted, as in habitat-lab: the hand is a step behind
        hand = start + self.steps * self.step_m * (target - start) / distance
        event: Literal["take", "put"] | None = None
        if self.retracting:
            self.steps = max(0, self.steps - 1)
            if np.linalg.norm(hand - start) < self.snap_m:
                self.retracting, self.done, self.steps = False, True, 0
        elif pick and holding:
            self.person.stop()
            return None
        else:
            self.steps = min(self.steps + 1, int(distance / self.step_m))
            if np.linalg.norm(target - hand) < self.snap_m:
                self.retracting = True
                event = "take" if pick else "put"
        self.person.reach(hand, "left")
        return event
