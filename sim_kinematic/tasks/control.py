"""Control of a task's agents: the form of a choice, its execution, its recording and its repetition.

A task names one `Control` (`sim_kinematic.tasks.task.Task.control`). With `VelocityControl`, agents drive and walk. With
`sim_kinematic.tasks.skills.control.SkillControl` they have skills: they take things, put them down, open and close.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.recording import Agent, Recording
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.policy import GaitAction, PoseAction, RecordedPose, Still, Velocity, WaypointAction
from sim_kinematic.policies.recorded import RecordedTrack, RecordedVelocities, deciding_since, recorded_commands
from sim_kinematic.sensing.table import STATE_OBSERVATIONS
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.team import MotionTeam, Team


class Control:
    """Base class of controls. ``play`` is a `sim_kinematic.tasks.play.WorldRollout`, and ``number`` an agent's index."""

    has_skills: ClassVar[bool] = False
    """True if choices are skills that take many steps: then each rollout has one world, people are recorded joint by joint
    instead of as motion clips, and `sim_kinematic.policies.assignment.COMMON` makes no such choices."""

    observations: ClassVar[tuple[str, ...]] = STATE_OBSERVATIONS
    """Names of the sensors that an environment shows by default."""

    def __init__(self, skills: Mapping[str, tuple[str, ...]] | None = None) -> None:
        """Create the control.

        Args:
            skills: Names of skills that agents report, by kind; a kind without any has no skill column.
        """
        self.skills = dict(skills or {})

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raise an `InputError` if the control does not support an agent; by default it supports all."""

    def team(self, play: Any) -> Team:
        """Return the controllers of all agents of a `sim_kinematic.tasks.play.WorldRollout` that is about to begin."""
        raise NotImplementedError

    # --- choices from outside -----------------------------------------------------------------------------------------
    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a command from outside in the form that the play takes.

        Raises:
            InputError: it is malformed.
        """
        raise NotImplementedError

    def accepted(self, play: Any, number: int, choice: Any) -> Any:
        """Return a policy's choice in the form that the play takes; by default as `checked`.

        Raises:
            InputError: it is malformed.
        """
        return self.checked(play, number, choice)

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice of an agent controlled from outside without a new command; ``last`` is its latest command."""
        raise NotImplementedError

    def is_busy(self, play: Any, number: int) -> bool:
        """Return whether an agent continues an action until it ends or a command interrupts it."""
        del play, number
        return False

    def interrupts(self, play: Any, number: int, choice: Any) -> bool:
        """Return whether a command from outside interrupts what the agent is doing; by default all do."""
        del play, number, choice
        return True

    def refusal(self, play: Any, number: int, choice: Any) -> str | None:
        """Return in a sentence why a command, as `checked` returned it, would be refused now; None: it would not."""
        del play, number, choice
        return None

    # --- recordings ---------------------------------------------------------------------------------------------------
    def to_json(self, choice: Any) -> Any:
        """Return a choice as JSON types, for the recorded raw input."""
        raise NotImplementedError

    def from_json(self, data: Any) -> Any:
        """Return the choice that `to_json` wrote."""
        raise NotImplementedError

    def recorded_agent(self, member: AgentSpec, episode: Episode, *, is_external: bool) -> Agent:
        """Return how a recording names an agent, with the skills that it has in this episode."""
        del episode, is_external
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
        """Return columns without which a recording cannot be simulated again."""
        raise NotImplementedError

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the numbers of the agents whose decisions are all recorded, so that verification calls none of their policies.

        ``names`` are those of all agents' policies.
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
        """Return for each agent a policy that repeats its first ``until`` recorded decisions, then hands over to ``own``.

        ``changed`` is True for each agent whose own policy is another than the recorded one.
        """
        raise NotImplementedError

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Put people on their recorded tracks. Return facts about them for the info, and a function to call after each step.

        ``since`` is the step from which robots follow other policies.
        """
        raise NotImplementedError


class VelocityControl(Control):
    """Control of agents that drive and walk by velocities, waypoints or places."""

    def team(self, play: Any) -> Team:
        """Return the agents of W worlds, which are moved together."""
        return MotionTeam(play)

    def checked(self, play: Any, number: int, choice: Any) -> Any:
        """Return a velocity from a pair, or from anything with ``forward`` and ``turn``.

        Raises:
            InputError: it is malformed.
        """
        del play, number
        try:
            if not hasattr(choice, "forward") and np.shape(choice) == (2,):
                choice = Velocity(float(choice[0]), float(choice[1]))
            is_finite = math.isfinite(choice.forward) and math.isfinite(choice.turn)
        except (AttributeError, TypeError, ValueError):
            raise InputError(
                f"Expected a command (forward, turn) in -1..1, got {choice!r}.", code="H3-TASK-064"
            ) from None
        if not is_finite:
            raise InputError(f"Actions must be finite, got {(choice.forward, choice.turn)}.", code="H3-TASK-065")
        return choice

    def accepted(self, play: Any, number: int, choice: Any) -> Any:
        """Return a velocity as `checked`, or a waypoint, a place, a gait or a recorded pose.

        Raises:
            InputError: it is malformed.
        """
        if isinstance(choice, GaitAction):
            return choice
        if not isinstance(choice, WaypointAction | PoseAction | RecordedPose):
            return self.checked(play, number, choice)
        place = np.append(choice.xz, getattr(choice, "heading", 0.0))
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"Expected a place of 2 finite numbers [m], got {choice!r}.", code="H3-TASK-082")
        return choice

    def idle(self, play: Any, number: int, last: Any) -> Any:
        """Return the choice that keeps the agent as it is."""
        del play, number
        return Velocity(0.0, 0.0) if last is None else last

    def to_json(self, choice: Any) -> Any:
        """Return a velocity as JSON types."""
        return {"forward": float(choice.forward), "turn": float(choice.turn), "skill": choice.skill}

    def from_json(self, data: Any) -> Any:
        """Return the velocity that `to_json` wrote."""
        return Velocity(float(data["forward"]), float(data["turn"]), str(data.get("skill", "")))

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the columns of the velocities of robots, and of the skills that they report."""
        robots = [k for k, agent in enumerate(recording.agents) if agent.kind == "robot"]
        names = ("action", "skill") if self.skills.get("robot") else ("action",)
        return [f"agent_{k}.{name}" for k in robots for name in names]

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the robots, and the people who were controlled from outside."""
        commanded = recorded_commands(recording, self.from_json)
        decided = {
            k
            for k, agent in enumerate(recording.agents)
            if f"agent_{k}.action" in recording.columns and (agent.kind == "robot" or k in commanded)
        }
        # agents that wander make way for each other, so one of them can only decide again if the others do too
        wanderers = {k for k, name in enumerate(names) if name == "wander"}
        return decided if wanderers <= decided else decided - wanderers

    def still(self, episode: Episode, number: int) -> Any:
        """Return a policy that stands still."""
        del episode, number
        return Still()

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Return policies that repeat the recorded velocities.

        A scripted person has no recorded decisions: its own policy decides again.
        """
        commands, policies = recorded_commands(recording, self.from_json), []
        for k, (member, assigned, since) in enumerate(zip(episode.roster, own, deciding_since(recording), strict=True)):
            policy = assigned.policy
            if member.kind == "robot" or k in commands:
                # the policy that drove so far is asked about the past, to have its memory; a new one is not
                first = until if changed and changed[k] else min(since, until)
                policy = RecordedVelocities.of(recording, k, commands.get(k), until=until, own=policy, since=first)
            elif policy is None:
                raise InputError(
                    f"The person's own policy {assigned.name!r} is not at hand, and {member.name} was not controlled "
                    "from outside: nothing says how they decided.",
                    code="H3-TASK-066",
                )
            policies.append(assigned._replace(policy=policy))
        return policies

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Let people follow their recorded places and postures from the first step on."""
        del since
        for k, member in enumerate(play.episode.roster):
            if member.kind == "human":
                play.policies[k] = play.policies[k]._replace(policy=RecordedTrack(recording, k, member.body))
        return {}, None
