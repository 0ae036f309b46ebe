"""A task: how episodes are sampled, what a step is judged to be worth, which policies play it.

A task of one's own is a subclass of `Task` with a frozen `TaskSpec`, found by entry point (group ``h3data.tasks``) or as
``module:Class``. `sample` and `judge` are enough; recording, resuming, environments, datasets, metrics and reports follow
(h3data docs extending).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError
from h3data.geometry import Array
from h3data.recording import Agent, Body, Recording
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, common_floor, make_roster, sample_places
from sim_kinematic.motion.randomness import generator
from sim_kinematic.policies.assignment import Assigned, AssignedPolicy, PolicyMaker, assign, make_policy
from sim_kinematic.policies.policy import Still, Velocity
from sim_kinematic.policies.recorded import RecordedTrack, RecordedVelocities, deciding_since, recorded_commands
from sim_kinematic.tasks.codec import EpisodeCodec, TaskCodec
from sim_kinematic.tasks.episode import Episode, StepOutcome, TaskSpec
from sim_kinematic.tasks.play import Rollout, WorldRollout

if TYPE_CHECKING:
    from h3data.scene.scene_sets import SceneSet
    from sim_kinematic.sensing.table import Sensor

_MOVED = {
    **{
        name: f"EpisodeCodec.{name}, of Task.codec,"
        for name in (
            "instruction",
            "info",
            "uid",
            "final_info",
            "precompute",
            "load_precomputed",
            "restore",
            "records_judgement",
        )
    },
    "foresight": "EpisodeCodec.precompute, of Task.codec,",
    "hindsight": "EpisodeCodec.final_info, of Task.codec,",
    "recall": "EpisodeCodec.load_precomputed, of Task.codec,",
    "storage": "Task.codec",
    "recorded_names": "EpisodeCodec.policy_names, of Task.codec,",
    "changed_policies": "EpisodeCodec.check_changes, of Task.codec,",
}
"""Where members of tasks of earlier versions are now."""


class Task:
    """Base class of tasks. Class attributes declare; methods have defaults that suit robots and people who move about.

    Hooks take W worlds at once; ``batched = False`` promises W = 1 only.
    """

    name: ClassVar[str] = ""
    """Name in recordings and on the command line; by default the class's name in snake case."""
    Spec: ClassVar[type[Any]] = TaskSpec
    agents: ClassVar[tuple[str, ...]] = ("robot", "human")
    """Default roster (`sim_kinematic.agents.roster.make_roster`)."""
    batched: ClassVar[bool] = True
    profile: ClassVar[str] = ""
    """Metrics profile of its recordings: a name or ``module:name``; empty: the profile of its name, else the generic one."""
    columns: ClassVar[Mapping[str, Any]] = {}
    """dtype of each column in `StepOutcome.columns`."""
    skills: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Names of what agents of a kind report to be doing; a kind without any has no skill column."""
    commanded: ClassVar[Mapping[str, Mapping[str, tuple[str, ...]]]] = {}
    """Fields of the recorded `Agent` that differ for an agent controlled from outside, by kind of agent."""
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Policies by kind of agent and name, beside those that every task has (`sim_kinematic.policies.policy`)."""
    defaults: ClassVar[Mapping[str, str]] = {"robot": "wander", "human": "waypoints"}
    """Name of the policy of each kind where none is chosen."""
    uses_common_policies: ClassVar[bool] = True
    """Whether `sim_kinematic.policies.assignment.COMMON` fit its agents."""

    env_defaults: ClassVar[Mapping[str, Any]] = {}
    """Options of its environments that differ from the usual ones."""
    env_options: ClassVar[tuple[str, ...]] = ()
    """Names of further options of its environments, which it finds in ``WorldRollout.options``."""

    def __init_subclass__(cls) -> None:
        for old, new in _MOVED.items():
            if old in vars(cls):  # it would never be called
                raise H3DataError(f"The member {cls.__name__}.{old} of a task is {new} now.", code="H3-TASK-070")
        if "name" not in vars(cls):
            cls.name = "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")

    # --- episodes -----------------------------------------------------------------------------------------------------
    def sample(self, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: tuple[AgentSpec, ...]) -> Episode:
        """Samples an episode; everything follows from the arguments.

        Raises:
            SceneError: the scene has no room for it.
        """
        free = common_floor(roster, free)
        return Episode(
            scene=scene,
            free=free,
            seed=seed,
            spec=spec,
            roster=roster,
            starts=self.sample_starts(scene, free, seed, spec, roster),
        )

    def episode(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        spec: Any = None,
        agents: str | Sequence[str] | None = None,
        free: FreeSpace | None = None,
        robot: str = ROBOT_BODY,
        human: str = HUMAN_BODY,
    ) -> Episode:
        """`sample` with defaults: the default rules and roster, and the map of the scene.

        ``robot`` and ``human`` are the bodies of agents named by their kind.
        """
        spec = self.Spec() if spec is None else spec
        free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
        roster = make_roster(self.agents if agents is None else agents, robot=robot, human=human)
        return self.sample(scene, free, seed, spec, roster)

    def check_roster(self, roster: Sequence[AgentSpec]) -> None:
        """Raises an `InputError` if an agent cannot play the task; by default all can."""

    def sample_starts(
        self, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: Sequence[AgentSpec], stream: str = "starts"
    ) -> Array:
        """Random free starts [A, 3], at least ``spec.spawn_distance_m`` apart where there is room."""
        rng = generator(seed, stream)
        return sample_places(scene, free, roster, rng, apart_m=spec.spawn_distance_m, rules=spec.robot)

    # --- rules --------------------------------------------------------------------------------------------------------
    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> None:
        """Prepares the worlds ``rows`` [n], whose episodes have just begun; keeps what it needs in ``play.memory``."""

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Judges the step that all worlds have just made.

        By default nothing is rewarded and an episode lasts ``max_steps``.
        """
        worlds = play.world.worlds
        return StepOutcome(
            reward=np.zeros(worlds), terminated=np.zeros(worlds, np.bool_), success=np.zeros(worlds, np.bool_)
        )

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Observation of an agent's policy, by default an `AgentView`."""
        return play.agent_view(agent, world)

    def end_reason(self, play: WorldRollout, world: int) -> str:
        """The word in ``info["ended"]`` for an episode that the rules end."""
        return "success" if bool(play.outcome.success[world]) else "terminated"

    def sensors(self, kind: str) -> Mapping[str, Sensor]:
        """Observations of agents of a kind, beyond pictures, by name; by default `sim_kinematic.sensing.table.SENSORS`."""
        from sim_kinematic.sensing.table import sensors_of

        return sensors_of(kind)

    def info_of(self, play: WorldRollout) -> dict[str, NDArray[Any]]:
        """Entries of an environment's ``info`` beyond its reward, [W] each."""
        return {"success": play.outcome.success.copy()}

    def check_env_options(self, options: Mapping[str, Any]) -> None:
        """Raises an `InputError` if the value of one of `env_options` is not allowed; by default all are."""

    # --- what it is elsewhere -----------------------------------------------------------------------------------------
    @property
    def codec(self) -> EpisodeCodec[Any]:
        """Writes and reads its episodes: in episode files, in recordings, in words; by default a `TaskCodec`."""
        return TaskCodec(self)

    # --- datasets and evaluations -------------------------------------------------------------------------------------
    bodies_in_agents: ClassVar[bool] = False
    """Whether the body that ``--human`` names is written into the roster, for each person of it."""
    crosses_partners: ClassVar[bool] = False
    """Whether an evaluation plays every policy with every partner by default."""
    can_be_solo: ClassVar[bool] = False
    """Whether an episode can be played without its robots (policy ``solo``)."""

    def default_spec(self) -> Any:
        """The rules of generated datasets."""
        return self.Spec()

    def set_rules(self, scenes: SceneSet) -> Any:
        """The rules by which a scene set samples starts, whatever the user changes of them; None: the task's own."""
        del scenes

    def recorded_default(self, kind: str) -> str | None:
        """The default policy of a kind as a job names it; None where jobs name none."""
        return self.defaults[kind] if kind in {"robot", "human"} & {*self.defaults} else None

    def without_robots(self, episode: Episode, policy: str | None) -> Episode:
        """The episode without its robots, if the policy says so."""
        del policy
        return episode

    # --- playing ------------------------------------------------------------------------------------------------------
    def play(self, episode: Episode, policies: Sequence[AssignedPolicy] = (), *, measure: bool = True) -> Rollout:
        """One episode, ready for `sim_kinematic.tasks.runner.run`.

        ``measure=False`` leaves out what only rewards need.
        """
        play = WorldRollout(self, episode.spec, episode.roster, measure=measure)
        play.begin([episode])
        play.policies = list(policies)
        return play

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """What makes the policy that a name means in this task beyond its tables; None: look in the tables.

        ``spec`` are the rules that it must fit, None where they are not known yet.

        Raises:
            InputError: what the name means cannot play this task.
        """
        del kind, name, spec
        return None

    def assign(self, episode: Episode, chosen: Assigned | None = None) -> list[AssignedPolicy]:
        """A policy for each agent of an episode.

        ``chosen`` names or gives them by agent (``robot``, ``human_2``, ``person``) or by kind; the others get `defaults`.

        Raises:
            InputError: no such policy, or no such agent.
        """
        return assign(self, episode, chosen or {})

    # --- commands from outside ----------------------------------------------------------------------------------------
    def checked_choice(self, play: Rollout, number: int, choice: Any) -> Any:
        """A command from outside in the form that the play takes.

        Raises:
            InputError: it is malformed.
        """
        if not hasattr(choice, "forward") and np.shape(choice) == (2,):
            choice = Velocity(float(choice[0]), float(choice[1]))
        if not (hasattr(choice, "forward") and hasattr(choice, "turn")):
            raise InputError(f"Expected a command (forward, turn) in -1..1, got {choice!r}.", code="H3-TASK-064")
        if not np.isfinite([choice.forward, choice.turn]).all():
            raise InputError(f"Actions must be finite, got {(choice.forward, choice.turn)}.", code="H3-TASK-065")
        return choice

    def idle_choice(self, play: Rollout, number: int, last: Any) -> Any:
        """The choice of an agent controlled from outside that was told nothing new: to go on as before."""
        return Velocity(0.0, 0.0) if last is None else last

    def is_busy(self, play: Rollout, number: int) -> bool:
        """Whether an agent goes on with something by itself until it ends or a command interrupts it."""
        del play, number
        return False

    def interrupts_running(self, play: Rollout, number: int, choice: Any) -> bool:
        """Whether a command from outside interrupts what the agent is doing; by default all do."""
        del play, number, choice
        return True

    def refusal(self, play: Rollout, number: int, choice: Any) -> str | None:
        """Why a command, as `checked_choice` returned it, would be refused now, as a sentence; None: it would not."""
        del play, number, choice
        return None

    def choice_to_json(self, choice: Any) -> Any:
        """A choice as JSON types, for the recorded raw input."""
        return {"forward": float(choice.forward), "turn": float(choice.turn), "skill": choice.skill}

    def choice_from_json(self, data: Any) -> Any:
        """The choice that `choice_to_json` wrote."""
        return Velocity(float(data["forward"]), float(data["turn"]), str(data.get("skill", "")))

    def last_reward(self, play: Rollout) -> float:
        """Reward of the last step of a play of one world."""
        return float(play.outcome.reward[0])  # type: ignore[attr-defined]

    # --- recording ----------------------------------------------------------------------------------------------------
    clip_coded: ClassVar[bool] = True
    """Whether people are recorded as motion clips, else joint by joint."""

    def bodies(self, episode: Episode, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
        """The recording's bodies: those of the scene, of which a task may say which ones move."""
        del episode
        return bodies

    def recorded_agents(self, episode: Episode, agents: tuple[Agent, ...]) -> tuple[Agent, ...]:
        """The recording's agents, which may have more to tell in some episodes."""
        del episode
        return agents

    # --- simulating again (sim_kinematic.tasks.resume) -----------------------------------------------------------------
    def needed_columns(self, recording: Recording) -> list[str]:
        """Columns without which a recording cannot be simulated again."""
        robots = [k for k, agent in enumerate(recording.agents) if agent.kind == "robot"]
        names = ("action", "skill") if self.skills.get("robot") else ("action",)
        return [f"agent_{k}.{name}" for k in robots for name in names]

    def recorded_policy(self, episode: Episode, number: int, name: Any) -> AssignedPolicy:
        """The policy with a recorded name, or one that is chosen instead."""
        if name == "external":
            return AssignedPolicy(Still(), "external", episode.roster[number].kind)
        return make_policy(self, episode, number, name)

    def agents_with_recorded_decisions(self, recording: Recording) -> set[int]:
        """Numbers of the agents whose every decision is recorded, so that verifying asks no policy of theirs."""
        commanded = recorded_commands(recording, self.choice_from_json)
        decided = {
            k
            for k, agent in enumerate(recording.agents)
            if f"agent_{k}.action" in recording.columns and (agent.kind == "robot" or k in commanded)
        }
        # those who wander share how they heed each other, so that one of them who is asked needs the others asked too
        wanderers = {k for k, name in enumerate(self.codec.policy_names(recording)) if name == "wander"}
        return decided if wanderers <= decided else decided - wanderers

    def recorded_policies(
        self,
        recording: Recording,
        episode: Episode,
        own: Sequence[AssignedPolicy],
        *,
        until: int,
        changed: Sequence[bool] = (),
    ) -> list[AssignedPolicy]:
        """For each agent a policy that repeats its first ``until`` recorded decisions, then hands over to ``own``.

        A scripted person has no recorded decisions: its own policy decides again.
        """
        commands, policies = recorded_commands(recording, self.choice_from_json), []
        for k, (member, assigned, since) in enumerate(zip(episode.roster, own, deciding_since(recording), strict=True)):
            policy = assigned.policy
            if member.kind == "robot" or k in commands:
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
        self, play: Rollout, recording: Recording, since: int
    ) -> tuple[dict[str, Any], Callable[[int], object] | None]:
        """Puts people on their recorded tracks; returns facts about that for the info, and what to call after each step."""
        del since
        for k, member in enumerate(play.episode.roster):
            if member.kind == "human":
                play.policies[k] = play.policies[k]._replace(policy=RecordedTrack(recording, k, member.body))
        return {}, None
