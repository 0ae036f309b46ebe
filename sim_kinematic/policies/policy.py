"""Protocol of policies, which decide for agents, and the choices that they can return.

To a runner, a script, a planner, a network, a recorded track and a controller outside are all the same: a `Policy`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import HumanState


# --- choices ----------------------------------------------------------------------------------------------------------
class Velocity(NamedTuple):
    """Base velocity of a robot or a person, with the policy's word for its activity."""

    forward: float
    """Speed as a share of the limit, -1..1; people do not walk backwards."""
    turn: float
    """Turn rate as a share of the limit, -1..1, positive to the left."""
    skill: str = ""
    """For a person, a gesture (`h3data.bodies.people.gestures.GESTURES`) or a captured motion of the body, which begins and
    ends with this word."""


class WaypointAction(NamedTuple):
    """Choice of a point that a person walks straight to."""

    xz: NDArray[np.float64]
    """Place on the floor ``(x, z)`` [m]."""


class PoseAction(NamedTuple):
    """Choice of the place of a person, who walks along a path, after this step."""

    xz: Array
    """Place on the floor ``(x, z)`` [m]."""
    heading: float
    seat: tuple[float, float] = (0.0, 0.0)
    """Height of a seat above the floor [m], and share of the path from standing (0) to sitting (1) and lying (2) on it."""


class GaitAction(NamedTuple):
    """Choice of the place of a person after this step, with their phase in the walking cycle."""

    gait: HumanState
    """Gait of the person, as a state of one world."""


class RecordedPose(NamedTuple):
    """Choice that repeats one step of a recorded person unchanged."""

    xz: NDArray[np.float64]
    heading: float
    clip: int
    phase: float
    blend: float
    arms: tuple[float, float]
    seat: tuple[float, float] = (0.0, 0.0)


# --- the protocol -----------------------------------------------------------------------------------------------------
@runtime_checkable
class Policy(Protocol):
    """Protocol of a policy, which decides for one agent in one episode."""

    def act(self, view: Any) -> Any:
        """Return the choice for the next step, given an observation from `Task.view`."""
        ...


class External:
    """Placeholder for a controller outside, which acts through `sim_kinematic.tasks.sessions.Session.act`.

    In tasks with skills, ``interrupts_when_close`` says whether the agent may choose again at every step while another
    agent is close, as Habitat's learned policies must.
    """

    takes_commands = True
    sits = True
    """True if people can sit down, so that recordings by motion clips hold the column ``motion_seat``."""

    def __init__(self, *, interrupts_when_close: bool = True) -> None:
        self.interrupts_when_close = interrupts_when_close

    def act(self, view: Any) -> Any:
        """Raise an error, because a session answers for this agent."""
        raise InputError(
            f"Agent {getattr(view, 'agent', '')} is controlled from outside. Hint: play it with h3data.session.",
            code="H3-POLICY-037",
        )

    interrupts_only_when_close = True
    """True if `interrupts` returns a reason only if ``view.close`` is true, so that it is called only then, with a
    `CloseView`."""

    def interrupts(self, view: Any) -> str:
        """Return the reason to interrupt the running action and choose again; empty if there is none."""
        action = view.action
        # a command of the lower layer lasts one step, so there is nothing to interrupt
        going_on = action is None or action.skill == "control"
        return "agents_close" if self.interrupts_when_close and view.close and not going_on else ""


class FunctionPolicy:
    """Policy that is a function of the view and of the robot's base; the function may hold a memory."""

    def __init__(self, function: Callable[[Any, BaseSpec], Any], base: BaseSpec) -> None:
        self._function, self._base = function, base
        self.__name__ = getattr(function, "__name__", type(function).__name__)

    def act(self, view: Any) -> Any:
        """Return the choice for the next step."""
        return self._function(view, self._base)


class Still:
    """Policy that stands still, as a lower-bound baseline."""

    def act(self, view: Any) -> Velocity:
        """Return a velocity of 0."""
        return Velocity(0.0, 0.0)
