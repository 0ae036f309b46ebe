"""Control of agents by skills: they go to objects, take them, put them down, and open and close doors and drawers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.recording import Agent, Recording
from h3data.scene import joint_names
from sim_kinematic.agents.driven.commands import STAND, action_of, command_from_json, command_to_json, interrupts_skill
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.robots.skills import checked_command
from sim_kinematic.agents.roster import AgentSpec
from sim_kinematic.agents.skills import ALL_SKILLS, CONTROL, OPENING_SKILLS, SKILLS, Action, Message, sentence
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.rearrange import (
    planner,
)
from sim_kinematic.policies.recorded import (
    RecordedCommands,
    RecordedPolicy,
    deciding_since,
    is_remote,
    recorded_choices,
    recorded_commands,
    told_in,
)
from sim_kinematic.sensing.sight import surface_names
from sim_kinematic.sensing.table import STATE_SENSES
from sim_kinematic.tasks.control import Control
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.rearrange.episode import (
    RearrangeEpisode,
)
from sim_kinematic.tasks.resimulation import is_counterfactual
from sim_kinematic.tasks.skills.household import Household
from sim_kinematic.tasks.skills.kept_track import SkillTrack, follow_track


class SkillControl(Control):
    """Control of agents with skills, for one world at a time."""

    has_skills: ClassVar[bool] = True
    observations: ClassVar[tuple[str, ...]] = STATE_SENSES

    def __init__(self) -> None:
        """Create the control with the skills of robots and people."""
        # people without a robot's primitives, which come after the first five
        super().__init__({"robot": SKILLS, "human": SKILLS[:5]})

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raise an `InputError` if a robot of the roster has no arm."""
        for agent in roster:
            agent.body.require_arm()

    def team(self, play: Any) -> Household:
        """Return the agents and things of one world."""
        return Household(play)

    # --- choices from outside -----------------------------------------------------------------------------------------
    def checked(self, play: Any, number: int, choice: Any) -> Action:
        """Return a skill, robot command or person command from outside as an `Action`, after checking it.

        Raises:
            InputError: The choice is malformed or names an object or skill that does not exist.
        """
        body = play.episode.roster[number].body
        robot = body if isinstance(body, Robot) else None
        if not isinstance(choice, Action):
            choice = _robot_action(choice, robot) if robot else action_of(choice, play.team.objects, number)
        elif not isinstance(choice.target, int | np.integer):
            raise InputError(
                f"Expected the number of an object or a joint as the target, got {choice!r}.", code="H3-TASK-084"
            )
        elif choice.skill in (*SKILLS, *OPENING_SKILLS) or robot:
            # only for its check: it raises if there is no such skill, object or joint
            play.team.objects.why_not(number, choice)
        if isinstance(choice.command, Message):
            choice.command.check([member.name for member in play.episode.roster])
        if choice.skill == CONTROL and robot:
            checked_command(choice.command, robot)  # type: ignore[arg-type]
        return choice

    def accepted(self, play: Any, number: int, choice: Any) -> Action:
        """Return a choice in the form that `checked` returns, except that a driven person takes any `Action`.

        The recorded commands of driven people may be impossible; in a replay they are refused again.
        """
        if isinstance(choice, Action) and isinstance(play.team.actors[number], DrivenPerson):
            return choice
        return self.checked(play, number, choice)

    def idle(self, play: Any, number: int, last: Any) -> Action:
        """Return the choice to continue the running skill or the last velocity, or else to stand for one step."""
        runner = play.team.controllers[number]
        if runner.skill is not None:
            # choosing the running skill again lets it continue
            return runner.action
        if last is not None and last.skill == CONTROL:
            return last
        # choice of a robot without a command, which lasts one step, so that the next command is followed at
        # once
        return Action(CONTROL, command=STAND) if isinstance(runner.actor, DrivenPerson) else Action("wait", steps=1)

    def is_busy(self, play: Any, number: int) -> bool:
        """Return whether a skill other than ``wait`` is running."""
        runner = play.team.controllers[number]
        return not runner.is_free and runner.action.skill != "wait"

    def interrupts(self, play: Any, number: int, choice: Any) -> bool:
        """Return whether the choice is a skill that interrupts and is not the skill that is already running."""
        return interrupts_skill(choice) and choice != play.team.controllers[number].action

    def refusal(self, play: Any, number: int, choice: Any) -> str | None:
        """Return, as a sentence, the reason why a choice is infeasible now; None if it is feasible."""
        actor = play.team.actors[number]
        why = actor.refusal(choice) if isinstance(actor, DrivenPerson) else actor.infeasible(choice)
        return sentence(why) if why else None

    def to_json(self, choice: Any) -> Any:
        """Return a skill or command as JSON types, for the raw input in recordings."""
        return command_to_json(choice)

    def from_json(self, data: Any) -> Any:
        """Return the skill or command that `to_json` converted."""
        return command_from_json(data)

    # --- recordings ---------------------------------------------------------------------------------------------------
    def recorded_agent(self, member: AgentSpec, episode: Episode, *, is_external: bool) -> Agent:
        """Return an agent with its skills, which include opening and closing in scenes with doors or drawers."""
        agent = super().recorded_agent(member, episode, is_external=is_external)
        if is_external and agent.kind == "human":
            agent = replace(agent, skill_names=ALL_SKILLS, action_names=("forward", "turn_left"))
        seen = getattr(episode.spec, "observe", "full") == "seen"
        return replace(agent, skill_names=ALL_SKILLS) if seen or episode.scene.articulations else agent

    def needed_columns(self, recording: Recording) -> list[str]:
        """Return the names of the columns for the skill and the skill target of every agent."""
        return [f"agent_{k}.{name}" for k in range(len(recording.agents)) for name in ("skill", "skill_target")]

    def decided(self, recording: Recording, names: Sequence[str]) -> set[int]:
        """Return the numbers of all agents, since every chosen skill is recorded."""
        return set(range(len(recording.agents)))

    def still(self, episode: Episode, number: int) -> Any:
        """Return a policy that waits."""
        assert isinstance(episode, RearrangeEpisode)
        return planner("still", episode.seed, len(episode.targets))

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Return policies that repeat the recorded skills of each agent until step ``until``, then continue with ``own``."""
        assert isinstance(episode, RearrangeEpisode)
        objects, joints = tuple(target.name for target in episode.targets), joint_names(episode.scene)
        surfaces = surface_names(episode.scene) if episode.spec.observe == "seen" else ()
        commands, policies = recorded_commands(recording, self.from_json), []
        for k, (assigned, since) in enumerate(zip(own, deciding_since(recording), strict=True)):
            policy: Any = assigned.policy
            # a driven person on a recorded track is asked nothing after the commands that came before it
            agent = recording.agents[k]
            on_track = is_counterfactual(recording) and agent.kind == "human" and bool(agent.action_names)
            if not on_track and (k not in commands or 0 < since < until):
                begins = since if k in commands else 0
                spans, now = recorded_choices(recording, k, objects, begins, joints=joints, surfaces=surfaces)
                policy = RecordedPolicy(
                    spans,
                    objects,
                    now,
                    until=until,
                    since=since,
                    joints=joints,
                    surfaces=surfaces,
                    commands=told_in(recording, k, objects),
                )
                if assigned.policy is not None:
                    # a new policy or a server is not asked about the past; the old one is, to have its memory
                    begins = until if (changed and changed[k]) or is_remote(assigned.policy) else min(since, until)
                    policy.own, policy.since = assigned.policy, begins
            # a recording that was continued has commands only for the steps before
            if k in commands or on_track:
                policy = RecordedCommands(commands.get(k, []), until=min(since or until, until), own=policy)
            policies.append(assigned._replace(policy=policy))
        return policies

    def keep_people(
        self, play: Any, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Let people take objects and put them down as recorded, except objects that are elsewhere."""
        first = min(since, _track_from(recording))
        tracks = [SkillTrack.of(recording, person.number, play.team.bodies) for person in play.team.people]

        def keep(_: int) -> None:
            if play.step == first:
                for actor, track in zip(play.team.people, tracks, strict=True):
                    follow_track(play, actor, track, play.step)

        # for a track that begins at once; later ones begin after the step before them
        keep(0)
        return {"track_from": first}, keep


def _robot_action(command: Any, robot: Robot) -> Action:
    """Return the action by which a robot follows a velocity (forward, turn) while its arm and its grip stay as they are."""
    if np.shape(command) == (2,):
        forward, turn = command
    elif hasattr(command, "forward") and hasattr(command, "turn"):
        forward, turn = command.forward, command.turn
    else:
        raise InputError(
            f"Expected an Action (sim_kinematic.agents.skills), a Velocity or a pair (forward, turn), got {command!r}.",
            code="H3-TASK-029",
        )
    return Action(CONTROL, command=(float(forward), float(turn), *[0.0] * (len(robot.require_arm()) + 1)))


def _track_from(recording: Recording) -> int:
    """Return the step from which people keep their tracks; the end where they react throughout."""
    if not is_counterfactual(recording):
        return len(recording)
    step = recording.episode.info.get("counterfactual", {}).get("track_from")
    if not isinstance(step, int) or not 0 <= step <= len(recording):
        raise InputError(
            f"Expected counterfactual.track_from in the info, a step up to {len(recording)}, got {step!r}.",
            code="H3-TASK-022",
        )
    return step
