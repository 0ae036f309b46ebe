"""Observations of scripted policies, which are privileged: they contain the map and the poses of all agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.recording import Event
from h3data.scene import FreeSpace
from sim_kinematic.agents.skills import Action, SkillResult
from sim_kinematic.motion.spec import BaseSpec, WalkerSpec
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.sensing.sight import Places

if TYPE_CHECKING:
    from sim_kinematic.policies.crowd.crowds import Crowds
    from sim_kinematic.policies.traffic import Traffic

Observe = Callable[..., dict[str, NDArray[Any]]]
"""Function ``observe(names, size=None, light="flat")`` that returns the agent's present observations by name, equal to
those of training environments (h3data docs environments). ``size`` is that of pictures
(`sim_kinematic.sensing.eyes.PictureSize`)."""


class AgentView(NamedTuple):
    """Observation of privileged policies in any task: the map, and all agents' poses now and one step ago."""

    step: int
    seed: int
    """Seed of the episode, which with ``step`` determines all random numbers of a policy."""
    agent: int
    """Number of the agent that decides."""
    kinds: tuple[str, ...]
    """Kind of each agent, ``robot`` or ``human``, robots first."""
    free: FreeSpace
    places: Array
    """Place ``(x, z, heading)`` of each agent, [A, 3]."""
    before: Array
    """Place ``(x, z, heading)`` of each agent one step ago, [A, 3]."""
    bases: tuple[BaseSpec, ...]
    """Discs and limits of each robot."""
    walker: WalkerSpec
    extra: Mapping[str, Any]
    """Further data of the task (`Episode.extra`)."""
    traffic: Callable[[], Traffic]
    """Function that returns the traffic of this world, by which agents that wander give way to each other."""
    crowds: Callable[[], Crowds]
    """Function that returns the crowds of this world, which people with a crowd model share."""
    observe: Observe | None = None
    """Function that returns the agent's observations by name; None if observations are not computed."""

    @property
    def xz(self) -> Array:
        """Position of the agent that decides, [2] [m]."""
        return self.places[self.agent, :2]

    @property
    def base(self) -> BaseSpec:
        """Discs and limits of the agent that decides."""
        return self.bases[self.agent]

    @property
    def heading(self) -> float:
        """Heading of the agent that decides [rad]."""
        return float(self.places[self.agent, 2])


class SocialNavView(NamedTuple):
    """Observation of privileged policies of social navigation: the map and the poses of both agents."""

    free: FreeSpace
    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    geodesic_m: float
    """Length of the shortest path from robot to human [m]; infinite if there is none."""
    met: bool
    """True if the robot has found the person before."""
    seed: int = 0
    """Seed of the episode, which with ``step`` determines all random numbers of a policy."""
    step: int = 0
    robot_before: tuple[NDArray[np.float64], float] | None = None
    """Position [2] [m] and heading [rad] of the robot before the last step; None at the start."""
    human_before: NDArray[np.float64] | None = None
    """Position of the person before the last step, [2] [m]; None at the start."""
    future: Callable[[], NDArray[np.float64]] | None = None
    """Function that returns the positions of the person after this step and each later one, [K, 2] [m], for
    `future_oracle` alone; None if unknown."""
    pictures: Callable[..., dict[str, NDArray[Any]]] | None = None
    """Function that takes pictures with the robot's cameras, as `sim_kinematic.sensing.eyes.see` does:
    ``pictures(names, size, light="flat")`` with a size (width, height) or None. Pictures are costly, so only policies
    with pictures call it. None: there are no pictures."""
    observe: Observe | None = None
    """Function that returns the agent's observations by name; None if observations are not computed."""


class CloseView(NamedTuple):
    """Reduced observation, with which policies with ``interrupts_only_when_close`` may interrupt a skill.

    A policy with a method ``may_interrupt(close_view)`` is asked to interrupt only where that returns True.
    """

    action: Action
    """Skill that is running."""
    close: bool = True
    step: int = 0
    held_by_other: bool = False
    """True if another agent holds the object of the skill."""


class RearrangeView(NamedTuple):
    """Observation of privileged policies of rearrangement: everything except the other agent's plan."""

    step: int
    free: FreeSpace
    agent: int
    """Number of the agent that decides."""
    xz: NDArray[np.float64]
    heading: float
    other_xz: NDArray[np.float64]
    """Position of the other agent, or of the nearest of several, [2] [m]; NaN if there is none."""
    other_track: NDArray[np.float64]
    """Past positions of the other agent, the latest last, shape [N, 2] [m]."""
    close: bool
    """True if the other agent is inside the ellipse in which skills may be interrupted (``agents_within_threshold``)."""
    objects: NDArray[np.float64]
    """Positions of the objects, shape [K, 3] [m]."""
    goals: NDArray[np.float64]
    held_by: NDArray[np.int64]
    at_goal: NDArray[np.bool_]
    action: Action | None
    """Present action of the agent or, between two actions, its last action."""
    last: SkillResult | None
    """Result of the agent's last action; None while it is running."""
    starts: NDArray[np.float64]
    """Initial positions of the objects, shape [K, 3] [m]."""
    hand: Callable[[], NDArray[np.floating]]
    """Function that returns the pose (pose7) [7] of the hand in the world: a robot's hand, or a person's right palm."""
    arm: NDArray[np.float64]
    """Positions of the arm's joints of a robot [n] [rad or m]; empty [0] for a person."""
    start: NDArray[np.float64]
    """Pose of the agent at the start of the episode, ``(x, z, heading)`` [3]."""
    before: NDArray[np.float64]
    """Pose of the agent one step ago, ``(x, z, heading)`` [3]."""
    contact: bool
    """True if the robot's base touched an obstacle in the last step."""
    collision: bool
    """True if agents touch each other now."""
    barrier: Callable[[int, bool], int] = lambda k, at_goal: -1
    """Function that returns the number of the door or drawer that has to be opened first to take an object or, with
    True, to bring it from there to its goal; -1 if there is none."""
    observe: Observe | None = None
    """Function that returns the agent's observations by name; None if observations are not computed."""
    places: Places | None = None
    """Surfaces on which objects may lie, for an agent that knows only what it has seen; None for an agent that knows
    everything. The positions of unknown objects are then NaN, and these objects count as not at their goals and in
    nobody's hand."""
    messages: Sequence[Event] = ()
    """Messages so far that the agent has sent or received (`h3data.recording.log_lines.SAY`)."""
    parts: tuple[int, ...] = ()
    """Joints of the M doors and drawers that the agent can choose to open by number."""
    open_parts: NDArray[np.bool_] = np.zeros(0, np.bool_)
    """True for doors and drawers that are at least ajar, [M]."""
    handles: NDArray[np.float64] = np.zeros((0, 3))
    """Positions of the handles of doors and drawers at rest, [M, 3] [m]."""

    def is_known(self, k: int) -> bool:
        """Return whether the agent knows where an object is."""
        return bool(np.isfinite(self.objects[k, 0]))

    def left_to_do(self) -> list[int]:
        """Return the objects that are known, not at their goals and not in the other agent's hand."""
        some = range(len(self.objects))
        mine = (NOBODY, self.agent)
        return [k for k in some if not self.at_goal[k] and self.held_by[k] in mine and self.is_known(k)]
