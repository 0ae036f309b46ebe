"""Controller of agents who choose a velocity, a way point, a place or a gait anew in every step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.policy import GaitAction, PoseAction, RecordedPose, WaypointAction
from sim_kinematic.world import (
    Command,
    DriveCommand,
    GaitCommand,
    PoseCommand,
    Posture,
    RecordedPoseCommand,
    WaypointCommand,
    World,
)


class MotionController:
    """Controller of one agent in each world, which chooses in every step."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.status: Literal["choosing", "acting"] = "choosing"
        self.word = ""
        """Word by which the agent of the first world reports what it is doing."""
        self._choices: Sequence[Any] = ()

    def begin(self, step: int) -> None:
        """Begin a step, in which the agent has to choose."""
        del step
        self.status = "choosing"

    def start(self, world: World, agent: int, rows: NDArray[np.intp], action: Sequence[Any]) -> None:
        """Take over the choices of a step."""
        del world, agent, rows
        self._choices, self.word, self.status = action, getattr(action[0], "skill", ""), "acting"

    def step(self, world: World, agent: int, rows: NDArray[np.intp]) -> Command:
        """Return the command that carries the choices out.

        Raises:
            InputError: A choice is of no known kind.
        """
        del world, agent, rows
        return command_of(self._choices, self._name)


def command_of(choices: Sequence[Any], name: str) -> Command:
    """Return the command for an agent of W worlds from its choices, all of one kind.

    Velocities are rounded to float32, as they are recorded. ``name`` is the agent's, for the error.

    Raises:
        InputError: A choice is of no known kind.
    """
    first = choices[0]
    if isinstance(first, WaypointAction):
        return WaypointCommand(_rows([choice.xz for choice in choices]))
    if isinstance(first, PoseAction):
        headings, seats = (
            np.array([choice.heading for choice in choices]),
            np.array([choice.seat for choice in choices]),
        )
        return PoseCommand(_rows([choice.xz for choice in choices]), headings, seats)
    if isinstance(first, GaitAction):
        if len(choices) == 1:
            return GaitCommand(first.gait)
        gait = HumanState.zeros(len(choices))
        for w, choice in enumerate(choices):
            gait.put([w], choice.gait)
        return GaitCommand(gait)
    if isinstance(first, RecordedPose):
        parts = ([getattr(choice, part) for choice in choices] for part in Posture._fields)
        posture = Posture(*map(np.array, parts))
        return RecordedPoseCommand(
            _rows([choice.xz for choice in choices]), np.array([c.heading for c in choices]), posture
        )
    if not hasattr(first, "forward"):
        raise InputError(f"Expected {name} to choose a Velocity or WaypointAction, got {first!r}.", code="H3-TASK-069")
    # rounded, so that a replay of the recorded velocities moves the agent by the same bits
    return DriveCommand(np.array([[choice.forward, choice.turn] for choice in choices], np.float32).astype(np.float64))


def _rows(values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return vectors [2] of W worlds as rows [W, 2]."""
    # for one world a view takes a tenth of the time
    return values[0][None] if len(values) == 1 else np.array(values)
