"""Interface between an agent's choices and its body.

In every step a rollout (`sim_kinematic.tasks.play.WorldRollout`) asks an agent whose controller is ``choosing``, gives the
choice to `Controller.start` and calls `Controller.step`, until the controller has something for this step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_kinematic.world import Command, World

Status = Literal["choosing", "acting"]
"""State of a controller: it needs a choice of the policy, or it continues by itself."""


class Controller(Protocol):
    """Turns the choices of one agent into its motion. ``rows`` [n] are the worlds concerned."""

    @property
    def status(self) -> Status:
        """Return whether the agent has to choose before it can make its step."""
        ...

    def begin(self, step: int) -> None:
        """Begin step number ``step`` of the episode."""

    def start(self, world: World, agent: int, rows: NDArray[np.intp], action: Sequence[Any]) -> None:
        """Take over the choices of the agent, one for each of the worlds."""

    def step(self, world: World, agent: int, rows: NDArray[np.intp]) -> Command | None:
        """Return the command of this step; None: the agent has been moved, or has to choose once more (`status`)."""
