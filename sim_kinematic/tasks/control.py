"""Base classes of the teams of agents in a rollout, and of the controls by which tasks define them.

A task names one `Control` (`sim_kinematic.tasks.task.Task.control`), which defines the form of a choice, how it is
carried out, and how it is recorded and repeated. The control makes the `Team` of each rollout. With
`sim_kinematic.tasks.motion.VelocityControl`, agents drive and walk. With
`sim_kinematic.tasks.skills.control.SkillControl`, they have skills: they take objects, put them down, and open and
close doors and drawers.
"""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Robot
from h3data.geometry import Array
from h3data.recording import Agent, Event, Recording
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.sensing.table import STATE_OBSERVATIONS, Sensor
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.world import Command

Columns = dict[str, NDArray[Any]]


class Team(ABC):
    """Base class of the agents of a rollout, where ``play`` is the `sim_kinematic.tasks.play.WorldRollout`."""

    def __init__(self, play: Any) -> None:
        # no circle of references: policies with open connections are freed with the last use of their rollout
        self.play: Any = weakref.proxy(play)
        self.controllers: Sequence[Any] = ()
        """A controller for each agent.

        In every step ``begin(step)`` is called first. While ``status`` is ``choosing``, a choice of the policy is given to
        ``start(choice)``. Then ``step()`` returns the command of this step, or None if the agent has been moved already or
        has to choose once more.
        """
        self.order: Sequence[int] = range(len(play.world.roster))
        """Numbers of the agents in the order in which they act."""

    @abstractmethod
    def begin(self, rows: NDArray[np.intp]) -> None:
        """Start episodes in the worlds ``rows`` [n]."""

    def begin_step(self) -> None:
        """Start a step of the only world."""
        for controller in self.controllers:
            controller.begin(self.play.step)

    def begin_turn(self, number: int) -> None:  # noqa: B027
        """Prepare an agent before it is asked for a choice or moved."""

    def end_turn(self, number: int) -> None:  # noqa: B027
        """Update the team after an agent has made its step."""

    @abstractmethod
    def move(self, commands: Sequence[Command | None]) -> None:
        """Complete a step with one command per agent; None for an agent that its controller has already moved."""

    def finish(self) -> None:  # noqa: B027
        """Close activities that are still running, such as skills."""

    @abstractmethod
    def view(self, agent: int, world: int) -> Any:
        """Return the observation of an agent's policy, for any task."""

    @abstractmethod
    def exact(
        self, agent: int, names: Sequence[str], sensors: Mapping[str, Sensor], *, beside: Sequence[Team] = ()
    ) -> dict[str, Array]:
        """Return exact values of the named observations, [W, n] each, followed by the rows of the teams ``beside``."""

    @abstractmethod
    def scenery(self, world: int) -> dict[str, Any]:
        """Return the arguments of `sim_kinematic.sensing.eyes.see` that describe the present state of a world."""

    def new_events(self) -> Sequence[Event]:
        """Return the events of agents in the first world in the last step, except those that the task reports."""
        return ()

    @abstractmethod
    def snapshot(self) -> Any:
        """Return the last step of the first world in the form that `columns` takes."""

    @abstractmethod
    def columns(self, snapshots: Sequence[Any]) -> tuple[Columns, list[Array], NDArray[np.bool_] | None]:
        """Return columns of consecutive steps, agents' places [T, 2], and whether a robot touched an obstacle [T]."""


class Control:
    """Base class of controls, where ``play`` is a `sim_kinematic.tasks.play.WorldRollout` and ``number`` an agent."""

    has_skills: ClassVar[bool] = False
    """True if choices are skills that take many steps: then each rollout has one world, people are recorded joint by joint
    instead of as motion clips, and `sim_kinematic.policies.assignment.COMMON` makes no such choices."""

    observations: ClassVar[tuple[str, ...]] = STATE_OBSERVATIONS
    """Names of the sensors that are an environment's observations by default."""

    def __init__(self, skills: Mapping[str, tuple[str, ...]] | None = None) -> None:
        """Create the control.

        Args:
            skills: Names of skills that agents report, by kind; a kind without any has no skill column.
        """
        self.skills = dict(skills or {})

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raise an `InputError` if the control does not support an agent; by default it supports all."""

    def team(self, play: Any) -> Team:
        """Return the controllers of all agents of a `sim_kinematic.tasks.play.WorldRollout` that is about to start."""
        raise NotImplementedError

    # --- choices from outside -----------------------------------------------------------------------------------------
    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a command from outside in the form that the play takes, after checking it.

        Raises:
            InputError: the command is malformed.
        """
        raise NotImplementedError

    def accepted(self, play: Any, number: int, choice: Any) -> Any:
        """Return a policy's choice in the form that the play takes; by default as `checked` returns it.

        Raises:
            InputError: the choice is malformed.
        """
        return self.checked(play, number, choice)

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice of an agent controlled from outside without a new command; ``last`` is its latest command."""
        raise NotImplementedError

    def is_busy(self, play: Any, number: int) -> bool:
        """Return whether an agent continues an action until it ends or a command interrupts it."""
        return False

    def interrupts(self, play: Any, number: int, choice: Any) -> bool:
        """Return whether a command from outside interrupts the agent's present activity; by default it always does."""
        return True

    def refusal(self, play: Any, number: int, choice: Any) -> str | None:
        """Return, as a sentence, why a command from `checked` would be refused now; None if it would not."""
        return None

    # --- recordings ---------------------------------------------------------------------------------------------------
    def to_json(self, choice: Any) -> Any:
        """Return a choice as JSON types, for the recorded raw input."""
        raise NotImplementedError

    def from_json(self, data: Any) -> Any:
        """Return the choice that `to_json` converted."""
        raise NotImplementedError

    def recorded_agent(self, member: AgentSpec, episode: Episode, *, is_external: bool) -> Agent:
        """Return the entry of an agent in a recording, with the skills that it has in this episode."""
        body, skills = member.body, self.skills.get(member.kind, ())
        if isinstance(body, Robot):
            return Agent(
                name=member.name,
                kind="robot",
                model=f"robot/{member.model}",
                semantic_id=200,
                joint_names=tuple(body.joint_names),
                action_names=("forward", "turn_left"),
                skill_names=skills,
            )
        return Agent(
            name=member.name,
            kind="human",
            model=f"humanoid/{member.model}",
            # Habitat's id of people, whose pixels its detector counts
            semantic_id=100,
            # people with skills are recorded joint by joint, so they have no clips to name
            motion_names=tuple(clip.name for clip in body.clips) if not self.has_skills else (),
            skill_names=skills,
        )

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the columns that a recording needs to be simulated again."""
        raise NotImplementedError

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the numbers of the agents whose decisions are all recorded, so that their policies are not needed.

        ``names`` are the names of all agents' policies.
        """
        raise NotImplementedError

    def still(self, episode: Episode, number: int) -> Any:
        """Return a policy that does nothing, for an agent whose policy is not available."""
        raise NotImplementedError

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Return, for each agent, a policy that repeats its recorded decisions, then hands over to ``own``.

        The policies repeat the first ``until`` steps. ``changed`` is True for each agent whose own policy is not the
        recorded one.
        """
        raise NotImplementedError

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Put people on their recorded tracks; return facts for the info, and a function to call after each step.

        ``since`` is the step from which robots follow other policies.
        """
        raise NotImplementedError
