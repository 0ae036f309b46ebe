"""Social rearrangement: a robot helps a person to bring objects to their goals; other casts can play it too.

The rules follow the paper (section 4.2 and appendix) and habitat-lab (spec/habitat.md 2). There are two layers:
high-level policies (`sim_kinematic.policies.rearrange`) choose skills (`sim_kinematic.agents.skills`), and skills move
bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from h3data.bodies import Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.recording import Agent, Body, Recording
from h3data.scene import FreeSpace, Scene, joint_names
from sim_kinematic.agents.driven.commands import STAND, action_of, command_from_json, command_to_json, interrupts_skill
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.robots.skills import checked_command
from sim_kinematic.agents.roster import AgentSpec, common_floor, kinds_of
from sim_kinematic.agents.skills import ALL_SKILLS, CONTROL, DRIVEN_SKILLS, OPENING_SKILLS, SKILLS, Action, sentence
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, PolicyMaker
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy
from sim_kinematic.policies.learned import SHIPPED_IN, SHIPPED_PARTNERS, naming
from sim_kinematic.policies.rearrange import (
    PARTNERS,
    ROBOT_POLICIES,
    partner_plan,
    partner_policy,
    planner,
    robot_policy,
)
from sim_kinematic.policies.recorded import (
    RecordedCommands,
    RecordedPolicy,
    deciding_since,
    recorded_choices,
    recorded_commands,
)
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import Rollout
from sim_kinematic.tasks.rearrange.codec import RearrangeCodec
from sim_kinematic.tasks.rearrange.episode import (
    RearrangeEpisode,
    RearrangeSpec,
    draw_episode,
    pair_of,
    rules_in,
    starts_of,
)
from sim_kinematic.tasks.rearrange.kept_track import KeptTrack, follow_track
from sim_kinematic.tasks.rearrange.play import RearrangeRollout
from sim_kinematic.tasks.rearrange.solo import SOLO
from sim_kinematic.tasks.resimulation import is_counterfactual
from sim_kinematic.tasks.task import Task

SHORT_WAIT = Action("wait", steps=1)


class Rearrange(Task):
    """Bring objects to their goals (paper section 4.2). One world at a time."""

    name: ClassVar[str] = "rearrange"
    Spec: ClassVar[type[Any]] = RearrangeSpec
    batched: ClassVar[bool] = False
    can_be_solo: ClassVar[bool] = True
    crosses_partners: ClassVar[bool] = True
    clip_coded: ClassVar[bool] = False
    uses_common_policies: ClassVar[bool] = False
    skills: ClassVar[Mapping[str, tuple[str, ...]]] = {"robot": SKILLS, "human": SKILLS[:5]}
    commanded: ClassVar[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
        "human": {"skill_names": DRIVEN_SKILLS, "action_names": ("forward", "turn_left")}
    }
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "robot": {**ROBOT_POLICIES, **SHIPPED_IN["rearrange"]},
        "human": dict.fromkeys((*PARTNERS, *SHIPPED_PARTNERS), partner_policy),
    }
    defaults: ClassVar[Mapping[str, str]] = {"robot": "complement", "human": "both"}

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raises an `InputError` if a robot of the roster has no arm."""
        for agent in roster:
            if isinstance(agent.body, Robot):
                agent.body.require_arm()

    # --- episodes -----------------------------------------------------------------------------------------------------
    def sample(
        self, scene: Scene, free: FreeSpace, seed: int, spec: RearrangeSpec, roster: tuple[AgentSpec, ...]
    ) -> RearrangeEpisode:
        """Samples an episode for the first robot and the first person of the roster.

        The default bodies stand in for a missing robot or person, so that objects, goals and the starts of these two
        are the same whoever else plays the episode.
        """
        self.check_roster(roster)
        robot, human = pair_of(roster)
        free = common_floor(roster, free)
        spec = rules_in(scene, spec)
        starts, targets = draw_episode(scene, free, seed, spec, load_robot(robot), load_humanoid(human))
        return RearrangeEpisode(
            scene=scene,
            free=free,
            seed=seed,
            spec=spec,
            roster=roster,
            starts=starts_of(scene, free, seed, spec, starts, roster),
            targets=targets,
            pair=(robot, human),
            pair_starts=starts,
        )

    @property
    def codec(self) -> RearrangeCodec:
        """Codec of episodes with objects and goals, in our files and Habitat's."""
        return RearrangeCodec(self)

    def assign(self, episode: Episode, chosen: Assigned | None = None) -> list[AssignedPolicy]:
        """Policies of all agents; ``solo``, which removes the robots beforehand, needs none."""
        return super().assign(episode, {k: v for k, v in (chosen or {}).items() if (k, v) != ("robot", SOLO)})

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Maker of the learned or planning policy of a name, with the agent's own seed; None for other names."""
        from sim_kinematic.policies.learned import is_learned
        from sim_kinematic.policies.learned_chooser import learned_chooser

        if is_learned(name):
            if spec is not None:
                learned_chooser(name, spec.objects, robot=kind == "robot")
        elif name not in ROBOT_POLICIES and name not in PARTNERS:
            return None
        return partial(_made_policy, name)

    def without_robots(self, episode: Episode, policy: str | None) -> Episode:
        """Episode with its people only if the policy is ``solo``, otherwise the episode itself."""
        assert isinstance(episode, RearrangeEpisode)
        people = [k for k, kind in enumerate(kinds_of(episode.roster)) if kind == "human"]
        return episode.only(*people) if policy == SOLO else episode

    def play(
        self, episode: Episode, policies: Sequence[AssignedPolicy] = (), *, measure: bool = True
    ) -> RearrangeRollout:
        """Run of an episode with the given policies."""
        assert isinstance(episode, RearrangeEpisode)
        return RearrangeRollout(episode, list(policies))

    # --- commands from outside ----------------------------------------------------------------------------------------
    def checked_choice(self, play: Rollout, number: int, choice: Any) -> Action:
        """Skill, robot command or person command from outside as an `Action`.

        Raises:
            InputError: the choice is malformed or names an object or skill that does not exist.
        """
        assert isinstance(play, RearrangeRollout)
        body = play.episode.roster[number].body
        if not isinstance(choice, Action):
            choice = _robot_action(choice, body) if isinstance(body, Robot) else action_of(choice, play.objects, number)
        elif choice.skill in (*SKILLS, *OPENING_SKILLS) or isinstance(body, Robot):
            play.objects.why_not(number, choice)
        if choice.skill == CONTROL and isinstance(body, Robot):
            checked_command(choice.command, body)  # type: ignore[arg-type]
        return choice

    def idle_choice(self, play: Rollout, number: int, last: Any) -> Action:
        """Choice to continue the running skill or the last velocity, otherwise to stand for a step."""
        assert isinstance(play, RearrangeRollout)
        runner = play.runner(number)
        if runner.skill is not None:
            return runner.action
        if last is not None and last.skill == CONTROL:
            return last
        return Action(CONTROL, command=STAND) if isinstance(runner.actor, DrivenPerson) else SHORT_WAIT

    def is_busy(self, play: Rollout, number: int) -> bool:
        """Whether a skill other than ``wait`` is running."""
        assert isinstance(play, RearrangeRollout)
        runner = play.runner(number)
        return not runner.is_free and runner.action.skill != "wait"

    def interrupts_running(self, play: Rollout, number: int, choice: Any) -> bool:
        """Whether the choice is a skill that interrupts, and not the one that is running already."""
        assert isinstance(play, RearrangeRollout)
        return interrupts_skill(choice) and choice != play.runner(number).action

    def refusal(self, play: Rollout, number: int, choice: Any) -> str | None:
        """Reason why a choice is infeasible now, as a sentence; None if it is feasible."""
        assert isinstance(play, RearrangeRollout)
        actor = play.actors[number]
        why = actor.refusal(choice) if isinstance(actor, DrivenPerson) else actor.infeasible(choice)
        return sentence(why) if why else None

    def choice_to_json(self, choice: Any) -> Any:
        """Skill or command as JSON types, for the recorded raw input."""
        return command_to_json(choice)

    def choice_from_json(self, data: Any) -> Any:
        """Skill or command that `choice_to_json` wrote."""
        return command_from_json(data)

    def last_reward(self, play: Rollout) -> float:
        """Reward of the last step."""
        assert isinstance(play, RearrangeRollout)
        return play.reward

    # --- recording ----------------------------------------------------------------------------------------------------
    def bodies(self, episode: Episode, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
        """Bodies of the recording: those of the scene, with the objects to bring marked as moving and at their starts."""
        assert isinstance(episode, RearrangeEpisode)
        moving = {target.name: k for k, target in enumerate(episode.targets)}
        return tuple(
            replace(b, pose=episode.targets[moving[b.name]].start.astype(np.float32), moving=moving[b.name])
            if b.name in moving
            else b
            for b in bodies
        )

    def recorded_agents(self, episode: Episode, agents: tuple[Agent, ...]) -> tuple[Agent, ...]:
        """Agents of the recording; in scenes with doors or drawers their skills include opening and closing."""
        if not episode.scene.articulations:
            return agents
        return tuple(replace(agent, skill_names=ALL_SKILLS) for agent in agents)

    # --- simulating again ---------------------------------------------------------------------------------------------
    def recorded_policy(self, episode: Episode, number: int, name: Any) -> AssignedPolicy:
        """Policy with a recorded name; an agent that was controlled from outside stands still."""
        assert isinstance(episode, RearrangeEpisode)
        if name == "external":  # whoever that was, they are not here: the agent stands still
            kind = episode.roster[number].kind
            return AssignedPolicy(planner("still", episode.seed, len(episode.targets)), "external", kind)
        return super().recorded_policy(episode, number, name)

    def needed_columns(self, recording: Recording) -> list[str]:
        """Skill and skill target of every agent."""
        return [f"agent_{k}.{name}" for k in range(len(recording.agents)) for name in ("skill", "skill_target")]

    def agents_with_recorded_decisions(self, recording: Recording) -> set[int]:
        """Numbers of all agents, since every skill that is chosen is recorded."""
        return set(range(len(recording.agents)))

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """Policies that repeat the recorded skills of each agent until step ``until``, then continue with ``own``."""
        assert isinstance(episode, RearrangeEpisode)
        if until and not recording.episode.plants_feet and "human" in {agent.kind for agent in recording.agents}:
            raise InputError(
                f"People in recordings of schema 1.5 and later walk with planted feet, this one is of "
                f"{recording.episode.schema_version}: it replays as it was recorded, but its people cannot be simulated "
                f"again. Hint: verify or resume it with the version that made it ({recording.episode.created_by}).",
                code="H3-TASK-028",
            )
        objects, joints = tuple(target.name for target in episode.targets), joint_names(episode.scene)
        commands, policies = recorded_commands(recording, self.choice_from_json), []
        for k, (assigned, since) in enumerate(zip(own, deciding_since(recording), strict=True)):
            policy: Any = assigned.policy
            # a driven person on a recorded track is asked nothing after the commands that came before it
            agent = recording.agents[k]
            on_track = is_counterfactual(recording) and agent.kind == "human" and bool(agent.action_names)
            if not on_track and (k not in commands or 0 < since < until):
                policy = RecordedPolicy(
                    *_checked(recording, k, objects, since if k in commands else 0, joints), until=until, since=since,
                    joints=joints,
                )  # fmt: skip
                if assigned.policy is not None:
                    policy.own, policy.since = assigned.policy, until if changed[k] else min(since, until)
            if k in commands or on_track:  # of a recording that was continued, only the steps before
                policy = RecordedCommands(commands.get(k, []), until=min(since or until, until), own=policy)
            policies.append(assigned._replace(policy=policy))
        return policies

    def keep_people(
        self, play: Rollout, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """People take things and put them down as recorded, except what is not there."""
        assert isinstance(play, RearrangeRollout)
        first = min(since, _track_from(recording))
        tracks = [KeptTrack.of(recording, person.number, play.bodies) for person in play.people]

        def keep(_: int) -> None:
            if play.steps == first:
                for actor, track in zip(play.people, tracks, strict=True):
                    follow_track(play, actor, track, play.steps)

        keep(0)
        return {"track_from": first}, keep


def _robot_action(command: Any, robot: Robot) -> Action:
    """The action by which a robot follows a velocity (forward, turn): its arm and its grip stay as they are."""
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
    """The step from which people keep their tracks; the end where they react throughout."""
    if not is_counterfactual(recording):
        return len(recording)
    step = recording.episode.info.get("counterfactual", {}).get("track_from")
    if not isinstance(step, int) or not 0 <= step <= len(recording):
        raise InputError(
            f"Expected counterfactual.track_from in the info, a step up to {len(recording)}, got {step!r}.",
            code="H3-TASK-022",
        )
    return step


def _checked(
    recording: Recording, k: int, objects: tuple[str, ...], since: int, joints: tuple[str, ...]
) -> tuple[Any, tuple[str, ...], Any]:
    spans, now = recorded_choices(recording, k, objects, since, joints=joints)
    return spans, objects, now


def _made_policy(name: str, episode: Episode, number: int) -> AssignedPolicy:
    from sim_kinematic.policies.learned import stamped

    assert isinstance(episode, RearrangeEpisode)
    kinds, objects = kinds_of(episode.roster), len(episode.targets)
    kind = kinds[number]
    nth = number - (0 if kind == "robot" else kinds.count("robot"))
    seed = episode.seed if not nth else episode_seed(episode.seed, nth)
    plans = name in PARTNERS if kind == "robot" else name not in ROBOT_POLICIES or name in PARTNERS
    if plans and not (kind == "robot" and name in ROBOT_POLICIES):
        policy, plan = partner_policy(name, seed, objects), partner_plan(name, seed)
    else:
        policy, plan = robot_policy(name, objects), ""
    if isinstance(policy, RecurrentSkillPolicy):
        policy.seed = seed
        if kind == "robot":
            with naming(name):
                policy.require_body(episode.roster[number].model)
    return AssignedPolicy(policy, stamped(name), kind, plan)
