"""Social rearrangement: a robot helps a person to bring objects to their goals; other casts can play it too.

The rules follow the paper (section 4.2 and appendix) and habitat-lab (spec/habitat.md 2). There are two layers:
high-level policies (`sim_kinematic.policies.rearrange`) choose skills (`sim_kinematic.agents.skills`), and skills move
bodies.
"""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import msgspec
import numpy as np

from h3data.bodies import Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.recording import Agent, Body, Recording, SkillSpan
from h3data.recording.task_episodes.stored_rearrangements import StoredGoal
from h3data.scene import FreeSpace, Scene, joint_names
from sim_kinematic.agents.driven.commands import STAND, action_of, command_from_json, command_to_json, interrupts_skill
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.robots.skills import checked_command
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, common_floor, kinds_of, make_roster
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
    population_of,
    robot_policy,
)
from sim_kinematic.policies.recorded import (
    RecordedCommands,
    RecordedPolicy,
    deciding_since,
    is_remote,
    recorded_choices,
    recorded_commands,
)
from sim_kinematic.tasks.episode import MAX_STEPS, Episode
from sim_kinematic.tasks.play import Rollout
from sim_kinematic.tasks.rearrange.episode import (
    PAIR,
    RearrangeEpisode,
    RearrangeSpec,
    body_indices,
    draw_episode,
    rules_in,
    starts_of,
)
from sim_kinematic.tasks.rearrange.kept_track import KeptTrack, follow_track
from sim_kinematic.tasks.rearrange.play import RearrangeRollout
from sim_kinematic.tasks.rearrange.storage import RearrangeStorage, goal_record, rules_to_json, target_of
from sim_kinematic.tasks.recorder import scene_attachment
from sim_kinematic.tasks.resimulation import is_counterfactual
from sim_kinematic.tasks.runner import run
from sim_kinematic.tasks.social_nav.episode import Starts
from sim_kinematic.tasks.task import Task

SOLO = "solo"
"""Policy of recordings in which no robot is beside the person."""
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
    cut_span: ClassVar[Mapping[str, Any]] = {"outcome": "running", "reason": ""}

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

    def storage(self) -> RearrangeStorage:
        """Storage of episodes with objects and goals, in our files and Habitat's."""
        return RearrangeStorage()

    def restore(
        self, recording: Recording, scene: Callable[[float, float], tuple[Scene, FreeSpace]]
    ) -> RearrangeEpisode:
        """Episode of a recording, from the rules, starts and goals in its info.

        Raises:
            InputError: the recording lacks one of them.
        """
        info, agents = recording.episode.info, recording.agents
        lacks = [name for name in ("spec", "goals") if name not in info]
        if lacks:
            raise InputError(
                f"The recording cannot be simulated again, it lacks: {', '.join(lacks)}.", code="H3-TASK-023"
            )
        kinds = tuple(agent.kind for agent in agents)
        own = {"robot": "robot_start", "human": "human_start"}
        try:
            rules = dict(msgspec.convert(info["spec"], dict[str, Any]))
            rules["arm_rad_s"] = np.inf if rules.get("arm_rad_s", 0.0) is None else rules.get("arm_rad_s", 8.0)
            rules = {"robot": {}, "human": {}, "people_give_way": False, **rules}  # as before there were such rules
            spec = msgspec.convert(rules, RearrangeSpec)
            goals = msgspec.convert(info["goals"], list[StoredGoal])
            listed = info["starts"] if "starts" in info else [info[own[kind]] for kind in kinds]
            starts = np.array(msgspec.convert(listed, list[tuple[float, float, float]]), np.float64)
        except (msgspec.ValidationError, KeyError) as fault:
            raise InputError(
                f"The recording's info is malformed: {str(fault).replace('`', '')}", code="H3-TASK-030"
            ) from None
        roster = make_roster([f"{agent.kind}:{agent.model.partition('/')[2]}" for agent in agents])
        if kinds_of(roster) != kinds:
            raise InputError(f"Expected robots, then people, got: {list(kinds)}.", code="H3-TASK-024")
        if spec.max_steps > MAX_STEPS or len(goals) != spec.objects:
            raise InputError(
                f"Expected at most {MAX_STEPS} steps and a goal for each of {spec.objects} objects, got "
                f"{spec.max_steps} steps and {len(goals)} goals.",
                code="H3-TASK-025",
            )
        home, free = scene(spec.agent_radius_m, spec.agent_height_m)
        things = {instance.name for instance in home.instances}
        numbers = [[*goal.start, *goal.position] for goal in goals]
        if not all(len(n) == 10 and np.isfinite(n).all() for n in numbers) or not {g.object for g in goals} <= things:
            raise InputError(
                "Expected goals of things in the scene, with a pose7 start and a position [3] of finite numbers.",
                code="H3-TASK-026",
            )
        fits = starts.shape == (len(roster), 3) and np.isfinite(starts).all()
        if not fits or not free.is_navigable(starts[:, :2]).all():
            raise InputError(
                f"Expected starts on the free floor for {len(roster)} agents, got: {starts.tolist()}.",
                code="H3-TASK-027",
            )
        first = [starts[kinds.index(kind)] if kind in kinds else np.full(3, np.nan) for kind in PAIR]
        return RearrangeEpisode(
            scene=home,
            free=free,
            seed=recording.episode.seed,
            spec=spec,
            roster=roster,
            starts=starts,
            targets=tuple(map(target_of, goals)),
            pair=pair_of(roster),
            pair_starts=Starts.of(np.array(first)),
            wording=str(info.get("instruction") or ""),
        )

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

    def instruction(self, episode: Episode) -> str:
        """Instruction of the episode file, or one sentence that names each object and its goal."""
        assert isinstance(episode, RearrangeEpisode)
        if episode.wording:
            return episode.wording
        errands = [f"bring the {spoken(t.name) or 'object'} to {_there(t.destination)}" for t in episode.targets]
        return " and ".join(errands)

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Policies, rules, starts, objects and goals for the recording's info."""
        assert isinstance(episode, RearrangeEpisode)
        return {
            **self.run_info(episode, policies),
            "max_steps": episode.spec.max_steps,
            "spec": rules_to_json(episode.spec),
            **({"skills": episode.spec.skills} if episode.spec.skills else {}),
            **_starts(episode),
            "goal_objects": body_indices(episode),
            "goals": [msgspec.to_builtins(goal_record(target)) for target in episode.targets],
        }

    def run_info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Names of the robots' policy, of the partners, of their plans and of their population."""
        partner = ",".join(p.name for p in policies if p.kind == "human")
        return {
            "policy": _robots_policy(policies),
            "partner": partner,
            "partner_plan": ",".join(p.plan for p in policies if p.plan),
            "population": population_of(partner),
        }

    def run_names(self, policies: Sequence[AssignedPolicy]) -> list[str]:
        """Names of the robots' policy and of the partners, which tell apart two continuations of one recording."""
        return [_robots_policy(policies), ",".join(p.name for p in policies if p.kind == "human")]

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Identifier derived from scene, agents, seed, policies and rules; for episodes from files also from their places."""
        assert isinstance(episode, RearrangeEpisode)
        digest, kinds = scene_attachment(episode.scene)[1], kinds_of(episode.roster)
        (policy, partner), (robot, human) = self.run_names(policies), episode.pair
        what = f"h3data:rearrange:{digest}:{robot}:{human}:{episode.seed}:{policy}:{partner}:{episode.spec}"
        if kinds not in (PAIR, ("human",)):
            what += ":" + ",".join(member.model for member in episode.roster)
        if not episode.is_sampled:
            what += f":{episode.pair_starts.places.tolist()}:{[goal_record(target) for target in episode.targets]}"
        return str(uuid.uuid5(uuid.NAMESPACE_URL, what))

    def final_info(self, episode: Episode, play: Rollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """``solo_steps`` is ``L_human``, by which relative efficiency is measured."""
        assert isinstance(play, RearrangeRollout)
        assert isinstance(episode, RearrangeEpisode)
        alone = [policy.plan for policy in policies] == ["both"]
        return {"ended": play.ended, "solo_steps": play.step + 1 if alone else solo_steps_of(episode)}

    def precompute(self, episode: Episode) -> dict[str, Any]:
        """Number of steps in which the first person alone would finish, for relative metrics."""
        assert isinstance(episode, RearrangeEpisode)
        return {"solo_steps": solo_steps_of(episode)}

    def load_precomputed(self, episode: Episode, facts: Mapping[str, Any]) -> None:
        """Stores the solo steps that another process has computed with `precompute`."""
        if "solo_steps" in facts:
            vars(episode)[_SOLO_STEPS] = int(facts["solo_steps"])

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
                    begins = until if changed[k] or is_remote(assigned.policy) else min(since, until)
                    policy.own, policy.since = assigned.policy, begins
            if k in commands or on_track:  # of a recording that was continued, only the steps before
                policy = RecordedCommands(commands.get(k, []), until=min(since or until, until), own=policy)
            policies.append(assigned._replace(policy=policy))
        return policies

    def kept_info(self, recording: Recording, episode: Episode, play: Rollout) -> dict[str, Any]:
        """Solo steps of the recording, which a continuation takes over."""
        assert isinstance(episode, RearrangeEpisode)
        solo = recording.episode.info.get("solo_steps")
        return {"solo_steps": solo_steps_of(episode) if solo is None else solo}

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

    def is_kept_column(self, name: str, people: Sequence[int]) -> bool:
        """Whether a column belongs to a person who keeps the recorded track; what they hold is simulated again."""
        return any(name.startswith(f"agent_{k}.") for k in people) and not name.endswith("grasp_body")

    def merged_spans(self, robots: Sequence[SkillSpan], people: Sequence[SkillSpan]) -> tuple[SkillSpan, ...]:
        """Skills of robots and of people who keep their tracks, by the step in which they end."""
        return tuple(sorted((*robots, *people), key=lambda span: span.end_step))


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


_SOLO_STEPS = "_solo_steps"


def solo_steps_of(episode: RearrangeEpisode) -> int:
    """Number of steps in which one person alone brings all objects to their goals, ``L_human`` in the paper.

    It is at most ``max_steps``, and is computed by simulating the first person, or the first robot where there are no
    people. The episode object caches it.
    """
    if _SOLO_STEPS not in vars(episode):
        vars(episode)[_SOLO_STEPS] = _simulated_solo_steps(episode)
    return vars(episode)[_SOLO_STEPS]


def _simulated_solo_steps(episode: RearrangeEpisode) -> int:
    kinds = kinds_of(episode.roster)
    first = kinds.index("human") if "human" in kinds else 0
    alone = episode.only(first)
    plan = AssignedPolicy(planner("both", episode.seed, len(episode.targets)), "both", kinds[first], "both")
    play = RearrangeRollout(alone, [plan])
    run(play)
    return play.step + 1


def spoken(name: str) -> str:
    """The kind of thing that an instance or receptacle is named after: ``tv_stand_0|top_left`` is a "tv stand".

    Habitat's names have numbers at both ends and colons (``003_cracker_box_:0000``), or are hashes, which have no words.
    """
    instance = name.partition("|")[0].partition(":")[0].rpartition("/")[2]
    words = [word for word in re.split(r"[_\W]+", instance) if word and not _HASH.fullmatch(word)]
    return re.sub(r"^(\d+ )+|( \d+)+$", "", " ".join(words)) or ("" if _HASH.search(instance) else instance)


_HASH = re.compile(r"(?=[0-9a-f]*\d)[0-9a-f]{12,}")


def _there(destination: str) -> str:
    words = spoken(destination)
    return f"the {words}" if words else "its goal"


def pair_of(roster: Sequence[AgentSpec]) -> tuple[str, str]:
    """Bodies of the first robot and the first person; the default ones where there is none."""
    models = {member.kind: member.model for member in reversed(roster)}
    return models.get("robot", ROBOT_BODY), models.get("human", HUMAN_BODY)


def _robots_policy(policies: Sequence[AssignedPolicy]) -> str:
    """Names of the robots' policies; `SOLO` for a person alone, and nothing for several people."""
    alone = [policy.kind for policy in policies] == ["human"]
    return SOLO if alone else ",".join(policy.name for policy in policies if policy.kind == "robot")


def _starts(episode: RearrangeEpisode) -> dict[str, list[Any]]:
    """Starts ``(x, z, heading)``: of robot and person as sampled, else of each agent."""
    if kinds_of(episode.roster) in (PAIR, ("human",)):
        robot, human = episode.pair_starts.places.tolist()
        return {"robot_start": robot, "human_start": human}
    return {"starts": episode.starts.tolist()}


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
