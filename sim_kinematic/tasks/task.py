"""Base class of tasks, which defines the sampling of episodes, the evaluation of steps, and the available policies.

A custom task is a subclass of `Task` with a frozen `TaskSpec`, which is found by an entry point (group
``h3data.tasks``) or as ``module:Class``. Only `sample` and `judge` are needed; recording, resuming, environments,
datasets, metrics and reports then work for it (h3data docs extending).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, common_floor, make_roster
from sim_kinematic.policies.assignment import PolicyMaker
from sim_kinematic.sensing.table import SENSORS, Sensor
from sim_kinematic.tasks.codec import EpisodeCodec, TaskCodec
from sim_kinematic.tasks.control import Control, VelocityControl
from sim_kinematic.tasks.episode import Episode, StepOutcome, TaskSpec, sample_starts
from sim_kinematic.tasks.play import WorldRollout

if TYPE_CHECKING:
    from h3data.scene.scene_sets import SceneSet

_MOVED = {
    **{
        # a member is called as before, or else its present name follows an equals sign
        member.partition("=")[0]: f"{owner}.{member.rpartition('=')[2]}, of Task.{place},"
        for owner, place, members in (
            (
                "EpisodeCodec",
                "codec",
                "instruction info uid final_info precompute load_precomputed restore records_judgement foresight=precompute "
                "hindsight=final_info recall=load_precomputed recorded_names=policy_names changed_policies=check_changes",
            ),
            (
                "Control",
                "control",
                "skills check_roster is_busy refusal needed_columns recorded_policies keep_people checked_choice=checked "
                "idle_choice=idle interrupts_running=interrupts choice_to_json=to_json choice_from_json=from_json "
                "batched=has_skills clip_coded=has_skills uses_common_policies=has_skills commanded=recorded_agent "
                "recorded_agents=recorded_agent agents_with_recorded_decisions=decided recorded_policy=still play=team",
            ),
            (
                "TaskUsage",
                "usage",
                "env_options set_rules bodies_in_agents crosses_partners can_be_solo "
                "check_env_options=env_options info_of=env_info "
                "env_defaults=env_rules default_spec=dataset_rules recorded_default=named_kinds",
            ),
        )
        for member in members.split()
    },
    "storage": "Task.codec",
    "bodies": "Episode.moving",
    "last_reward": "WorldRollout.reward",
    "end_reason": "StepOutcome.ended",
    "without_robots": "Episode.only",
    "sample_starts": "sim_kinematic.tasks.episode.sample_starts, and Task.sample decides which starts there are,",
    "assign": "sim_kinematic.policies.assignment.assign",
}
"""Members of tasks in earlier versions, with their present places."""


@dataclass(frozen=True, kw_only=True)
class TaskUsage:
    """Settings of a task for its use by datasets, evaluations and environments."""

    dataset_rules: Any = None
    """Rules of generated datasets; None: `Task.Spec` with its defaults."""
    env_rules: Any = None
    """Rules of environments; None: `Task.Spec` with its defaults."""
    device_rules: Any = None
    """Rules of environments on a device; None: the rules of other environments."""
    set_rules: Callable[[SceneSet], Any] | None = None
    """Function that returns the rules by which a scene set samples starts, regardless of the user's changes; None: the
    rules of datasets."""
    env_options: Mapping[str, Callable[[Any], object]] = field(default_factory=dict)
    """Further options of environments by name, which the task finds in ``WorldRollout.options``. The value is a
    function that raises an `InputError` for a value that is not allowed."""
    env_info: Mapping[str, Callable[[WorldRollout], NDArray[Any]]] = field(default_factory=dict)
    """Entries of an environment's ``info`` besides ``success``, for agents without skills: functions by name that
    return an array [W]."""
    env_partners: Mapping[str, str] = field(default_factory=dict)
    """Policies of the agents that do not act in an environment, by kind, if they differ from `Task.defaults`."""
    named_kinds: tuple[str, ...] = ("robot", "human")
    """Kinds of agents whose policies are named in a job even if they are the default."""
    bodies_in_agents: bool = False
    """True if the body given by ``--human`` is written into the roster for each person."""
    crosses_partners: bool = False
    """True if an evaluation plays every policy with every partner by default."""
    can_be_solo: bool = False
    """True if an episode can be played without its robots (policy ``solo``)."""


class Task:
    """Base class of tasks, whose default attributes and methods suit robots and people that move about.

    Hooks take W worlds at once, or one world if `Task.control` plays one at a time.
    """

    name: ClassVar[str] = ""
    """Name of the task in recordings and on the command line; by default the class name in snake case."""
    Spec: ClassVar[type[Any]] = TaskSpec
    agents: ClassVar[tuple[str, ...]] = ("robot", "human")
    """Default roster of agents (`sim_kinematic.agents.roster.make_roster`)."""
    profile: ClassVar[str] = ""
    """Metrics profile of the task's recordings: a name or ``module:name``. If empty, it is the profile named like the
    task, or else the generic one."""
    control: ClassVar[Control] = VelocityControl()
    """Control of the task's agents, by velocities and waypoints or by skills. It determines how choices are carried out
    and recorded, and what agents report."""
    columns: ClassVar[Mapping[str, Any]] = {}
    """Type (dtype) of each column in `StepOutcome.columns`."""
    sensors: ClassVar[Mapping[str, Sensor]] = SENSORS
    """Sensors of the agents by name, except pictures; by default those of agents without skills."""
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Policies by kind of agent and name, in addition to those of every task
    (`sim_kinematic.policies.assignment.COMMON`)."""
    defaults: ClassVar[Mapping[str, str]] = {"robot": "wander", "human": "waypoints"}
    """Name of the default policy, by kind of agent."""
    usage: ClassVar[TaskUsage] = TaskUsage()
    """Use of the task by datasets, evaluations and environments, if it differs from the default."""

    def __init_subclass__(cls) -> None:
        for old, new in _MOVED.items():
            # an old hook would never be called, and the task would play by the defaults
            if old in vars(cls):
                raise H3DataError(f"The member {cls.__name__}.{old} of a task is {new} now.", code="H3-TASK-070")
        if callable(vars(cls).get("sensors")):
            raise H3DataError(
                f"{cls.__name__}.sensors of a task is a mapping of sensors by name now, and no method.",
                code="H3-TASK-093",
            )
        # not hasattr: a subclass of a task with a name gets one of its own
        if "name" not in vars(cls):
            cls.name = "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")

    # --- episodes -----------------------------------------------------------------------------------------------------
    def sample(self, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: tuple[AgentSpec, ...]) -> Episode:
        """Sample an episode, which is determined by the arguments.

        Raises:
            SceneError: The scene has no room for the episode.
        """
        free = common_floor(roster, free)
        return Episode(
            scene=scene,
            free=free,
            seed=seed,
            spec=spec,
            roster=roster,
            starts=sample_starts(scene, free, seed, spec, roster),
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
        """Sample an episode with `sample`, by default for the rules and roster of the task and the map of the scene.

        ``robot`` and ``human`` are the bodies of agents named by their kind.
        """
        spec = self.Spec() if spec is None else spec
        free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
        roster = make_roster(self.agents if agents is None else agents, robot=robot, human=human)
        return self.sample(scene, free, seed, spec, roster)

    # --- rules --------------------------------------------------------------------------------------------------------
    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any] | None:
        """Prepare the worlds ``rows`` [n], whose episodes have just started, and store state in ``play.memory``.

        Instead of storing state, the method may return arrays by name, [W, ...], with the initial values; only those of
        the worlds ``rows`` are used. A task that runs on a device stores its state in this manner.
        """

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Evaluate the step that all worlds have just made.

        By default rewards are 0 and an episode lasts ``max_steps``.
        """
        never, nothing = play.steps < 0, 0.0 * play.steps  # of any array namespace
        return StepOutcome(reward=nothing, terminated=never, success=never)  # type: ignore[arg-type]

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Return the observation of an agent's policy, by default an `AgentView`."""
        return play.agent_view(agent, world)

    # --- what it is elsewhere -----------------------------------------------------------------------------------------
    @property
    def codec(self) -> EpisodeCodec[Any]:
        """Codec of the task's episodes for files, recordings and instructions; by default a `TaskCodec`."""
        return TaskCodec(self)

    # --- policies -----------------------------------------------------------------------------------------------------
    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return a maker of the policy that a name stands for in this task; None if only the tables have it.

        The method is for policies that are not in the task's tables. ``spec`` has the rules that the policy must fit;
        None if they are not known yet.

        Raises:
            InputError: The policy of this name cannot play this task.
        """
        return None
