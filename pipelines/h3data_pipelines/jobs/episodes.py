"""Jobs that each simulate one episode of any task, sampled in scenes from a seed or taken from scene sets."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import msgspec

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.records import agent_numbers
from h3data.scene.scene_sets import SceneSet
from h3data.scene.sources import SceneFile, SceneSource

if TYPE_CHECKING:
    from h3data.recording.task_episodes.stored_episodes import StoredEpisode
    from h3data.scene.open import NamedScene
    from sim_kinematic.tasks.episode import Episode
    from sim_kinematic.tasks.task import Task

SAMPLED_BODIES = ("any", "random")
"""Names of bodies that are sampled: each episode samples a built-in body, or makes a body from its seed."""
SOLO = "solo"
"""Name of the policy for episodes without robots."""


@dataclass(frozen=True)
class Job:
    """Job that simulates one episode, with all data that a worker needs."""

    index: int
    seed: int
    scene: str
    """Name of the scene on the command line."""
    source: SceneSource
    task: str
    """Name of the task, or ``module:Class``."""
    spec: Any
    """Rules of the task."""
    policy: str | None = None
    """Policies of robots; None for the task's default."""
    partner: str | None = None
    """Policies of people."""
    agents: tuple[str, ...] | None = None
    """Agents of the episode (`sim_kinematic.agents.roster.make_roster`); None for the task's roster."""
    human: str | None = None
    """Body of agents of the kind ``human``; None for the body in the episode, or the default."""
    robot: str | None = None
    """Body of agents of the kind ``robot``."""
    drawn_with: Any = None
    """Rules with which a set's starts and goals are sampled, regardless of changes in ``spec``."""
    stored: StoredEpisode | None = None
    """Record of the episode from a file, in the form of the task's codec."""
    origin: dict[str, Any] | None = None
    """Episode set or file from which the episode comes, and its number in it, as in the recording."""
    sensors: tuple[str, ...] | None = None
    """Sensors of robots that are recorded with every step."""

    def to_json(self) -> dict[str, Any]:
        """Return everything that determines the episode, as JSON types.

        A stored episode is identified by its ``origin``. Fields that are not set are left out.
        """
        from sim_kinematic.tasks.episode import rules_dict

        apart = ("stored", "origin", "task")
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in apart}
        if self.human is not None:
            values["human"] = stored_person(self.human)
        if self.agents is not None:
            agents = tuple(map(stored_person, self.agents))
            values["agents"] = agents if self.found_task.usage.bodies_in_agents else ",".join(agents)
        values |= {name: rules_dict(values[name]) for name in ("spec", "drawn_with") if values.get(name) is not None}
        told = json.loads(msgspec.json.encode({name: value for name, value in values.items() if value is not None}))
        # Datasets made before homes had generations, or could open, keep their identity.
        for home in (v for v in told.values() if isinstance(v, dict) and "preset" in v):
            if home.get("generation") == 1:
                del home["generation"], home["style"]
            for name, before in (("articulated", False), ("storeys", 1), ("doors", False)):
                if home.get(name) == before:
                    del home[name]
        return told

    @cached_property
    def found_task(self) -> Task:
        """Return the task of the job."""
        from sim_kinematic.tasks.registry import find_task

        return find_task(self.task)

    def episode(self) -> Episode:
        """Return the episode with scene, starts and rules, ready to be played."""
        from h3data.scene.open import open_free_space, open_scene
        from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, make_roster
        from sim_kinematic.tasks.codec import EpisodePlace

        task, spec = self.found_task, self.spec
        scene = open_scene(self.source)
        free = open_free_space(self.source, spec.agent_radius_m, spec.agent_height_m)
        stored = self.stored
        if self.drawn_with is not None:
            rules, robot = self.drawn_with, self.robot or ROBOT_BODY
            floor = open_free_space(self.source, rules.agent_radius_m, rules.agent_height_m)
            stored = task.codec.record(task.episode(scene, seed=self.seed, spec=rules, free=floor, robot=robot))
        if stored is not None:
            place = EpisodePlace(
                scene=scene,
                free=free,
                spec=spec,
                agents=self.agents,
                robot=self.robot,
                human=self.human,
                assets=self.source.assets if isinstance(self.source, SceneFile) else (),
            )
            return self._cast(task.codec.episode(stored, place))
        roster = make_roster(self.agents or task.agents, robot=self.robot or ROBOT_BODY, human=self.human or HUMAN_BODY)
        return self._cast(task.sample(scene, free, self.seed, spec, roster))

    def _cast(self, episode: Episode) -> Episode:
        """Return the episode, without its robots if the policy is `SOLO`."""
        people = agent_numbers(episode.roster, "human")
        return episode.only(*people) if self.policy == SOLO else episode

    def record(self, *, max_steps: int | None = None) -> Recording:
        """Play the episode, or its first ``max_steps`` steps, and return its recording."""
        from sim_kinematic.tasks.recorder import simulate

        chosen = {"robot": None if self.policy == SOLO else self.policy, "human": self.partner}
        episode = self.episode()
        return simulate(
            self.found_task,
            episode if max_steps is None else replace(episode, spec=replace(episode.spec, max_steps=max_steps)),
            {kind: name for kind, name in chosen.items() if name is not None},
            episode_id=f"{self.index:06d}",
            sensors=self.sensors or (),
        )


# --- where they come from ---------------------------------------------------------------------------------------------
ORACLE = "oracle"
"""Name of the skills under simple rules, which a GPU also supports."""


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Choices of the user; fields that are None are decided by the episode or the task."""

    task: str
    policy: str | None = None
    partner: str | None = None
    agents: tuple[str, ...] | None = None
    human: str | None = None
    motion: str | None = None
    """Motion file with the gait of people."""
    robot: str | None = None
    rules: str | None = None
    """Name of a set of rules."""
    human_speed: float | None = None
    max_steps: int | None = None
    spawn_distance: float | None = None
    overrides: tuple[tuple[str, Any], ...] = ()
    """Single fields of the task's rules, by name."""
    sensors: tuple[str, ...] | None = None
    """Sensors of robots that are recorded with every step."""
    oracle: bool = False
    """True for oracle skills in rearrangement (`sim_kinematic.tasks.rearrange.episode.ORACLE_RULES`)."""

    @cached_property
    def found_task(self) -> Task:
        """Return the task that the user has chosen."""
        from sim_kinematic.tasks.registry import find_task

        return find_task(self.task)

    def spec(self, base: Any = None) -> Any:
        """Return the rules: ``base`` (default: the task's) with the changes that the user has chosen."""
        from sim_kinematic.tasks.episode import rule_value, with_options

        base = dataset_rules(self.found_task) if base is None else base
        if self.oracle:
            from sim_kinematic.tasks.rearrange.episode import with_oracle_skills

            base = with_oracle_skills(base)
        overrides = {name: rule_value(base, name, value) for name, value in self.overrides}
        for name, option in (("max_steps", "max_steps"), ("spawn_distance_m", "spawn_distance")):
            if (asked := getattr(self, option)) is None:
                continue
            if name in overrides:
                raise InputError(
                    f"Expected --{option.replace('_', '-')} or --set {name}=..., got both.", code="H3-JOB-048"
                )
            overrides[name] = asked
        return with_options(base, rules=self.rules, human_speed=self.human_speed, **overrides)

    def job(self, drawn: SampledEpisode, **more: Any) -> Job:
        """Return the job of one sampled episode."""
        given = {"human": self._human(drawn.seed), "agents": self._agents(drawn.seed), **more}
        if "spec" not in given:
            given["spec"] = self.spec()
        return Job(
            drawn.index,
            drawn.seed,
            drawn.scene,
            drawn.source,
            self.task,
            policy=self.policy,
            partner=self.partner,
            robot=self.robot,
            sensors=self.sensors,
            origin=drawn.origin,
            **given,
        )

    @property
    def _motion(self) -> str:
        """Suffix of a person's name that names the motion file of their walk; empty without one."""
        from h3data.bodies.names import JOIN

        return "" if self.motion is None else JOIN + self.motion

    def _human(self, seed: int) -> str | None:
        motion = self._motion
        if self.found_task.usage.bodies_in_agents:
            return motion or None
        body = sampled_body(self.human, seed) if self.human in SAMPLED_BODIES else self.human
        return (body or "") + motion if motion else body

    def _agents(self, seed: int) -> tuple[str, ...] | None:
        """Return the roster; of tasks that may have many people, with a body for each of them."""
        from sim_kinematic.agents.roster import HUMAN_BODY, with_motion

        motion, agents = self._motion, self.agents
        if self.found_task.usage.bodies_in_agents:
            bodies = [self.human or HUMAN_BODY] * len(agents := agents or self.found_task.agents)
            if (sampled := self.human) in SAMPLED_BODIES:
                bodies = [sampled_body(sampled, seed, k) for k in range(len(agents))]
            agents = tuple(body if name == "human" else name for name, body in zip(agents, bodies, strict=True))
        return with_motion(agents, motion) if motion and agents is not None else agents


def with_skills(choices: Choices, skills: str) -> Choices:
    """Return rules with learned skills or `ORACLE` skills, or without either if ``skills`` is empty.

    Raises:
        InputError: the task has no skills, or there are no such files.
    """
    from sim_kinematic.policies.skills.names import recorded_skills

    if not skills:
        return choices
    if not hasattr(dataset_rules(choices.found_task), "skills"):
        raise InputError(f"--skills is for rearrange, not for {choices.task}.", code="H3-JOB-016")
    if skills == ORACLE:
        if choices.rules == "natural" or choices.human_speed is not None:
            raise InputError(
                "--skills oracle has the paper's people: no --rules natural or --human-speed.", code="H3-JOB-024"
            )
        return replace(choices, oracle=True)
    return replace(choices, overrides=(*choices.overrides, ("skills", recorded_skills(skills))))


@dataclass(frozen=True)
class SampledEpisode:
    """Episode of any task that is sampled from its seed."""

    index: int
    seed: int
    scene: str
    """Name of the scene on the command line."""
    source: SceneSource
    origin: dict[str, Any] | None = None
    """Episode set from which the episode comes, and its number in that set."""


def check_numbers(
    *, episodes: int | None, homes: int, max_steps: int | None, seed: int, human_speed: float | None
) -> None:
    """Check the numbers among the options of a job.

    Raises:
        InputError: a number is out of range; the message names its option.
    """
    for name, value, least in (
        ("--episodes", episodes, 1),
        ("--homes", homes, 1),
        ("--max-steps", max_steps, 1),
        ("--seed", seed, 0),
    ):
        if value is not None and value < least:
            raise InputError(f"{name} must be at least {least}, got {value}.", code="H3-JOB-025")
    if episodes is not None and episodes > sys.maxsize:
        raise InputError(f"--episodes must be at most {sys.maxsize}, got {episodes}.", code="H3-JOB-017")
    if human_speed is not None and not 0 < human_speed <= 4:
        raise InputError(f"--human-speed must be above 0 and at most 4 m/s, got {human_speed}.", code="H3-JOB-018")


def make_jobs(
    choices: Choices,
    scenes: str | Sequence[str],
    *,
    episodes: int | None,
    seed: int,
    homes: int = 4,
    assets: Sequence[str | Path] = (),
    allow_missing: bool = False,
) -> Sequence[Job]:
    """Return jobs for episodes in the given scenes.

    By default, all episodes of a set are played, or 10 episodes in the scenes in turn.

    If ``scenes`` has several names, the scenes of all of them are used. A set has the same episodes as when it is the
    only name.

    Raises:
        InputError: a task, scene, agent or policy does not exist (the message lists what does), or a set has fewer episodes.
    """
    from h3data.scene.open import named_scenes
    from h3data.scene.scene_sets import find_scene_set

    choices = checked(choices)
    names = (scenes,) if isinstance(scenes, str) else scenes
    label, _, which = names[0].partition("#")
    found = find_scene_set(label) if len(names) == 1 else None
    if found is not None:
        chosen = replace(found, scenes=(found.entry(which),)) if "#" in names[0] else found
        set_rules = choices.found_task.usage.set_rules
        drawn_with = set_rules(chosen) if set_rules is not None else None
        more = {} if drawn_with is None else {"drawn_with": drawn_with, "spec": choices.spec(drawn_with)}
        return [
            choices.job(drawn, **more)
            for drawn in set_episodes(chosen, choices.found_task.name, episodes=episodes, seed=seed)
        ]
    options: dict[str, Any] = {"homes": homes, "assets": assets, "allow_missing": allow_missing}
    named = [scene for name in names for scene in named_scenes(name, **options)]
    return SampledJobs(choices, named, range(10 if episodes is None else episodes), seed=seed)


class SampledJobs(Sequence[Job]):
    """Lazy sequence of jobs distributed over some scenes in turn, so that a billion episodes need no memory."""

    def __init__(self, choices: Choices, places: Sequence[NamedScene], numbers: range, *, seed: int) -> None:
        self._choices, self._places, self._numbers, self._seed = choices, places, numbers, seed
        self._spec = choices.spec()

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, index: int) -> Job: ...
    @overload
    def __getitem__(self, index: slice) -> SampledJobs: ...
    def __getitem__(self, index: int | slice) -> Job | SampledJobs:
        from sim_kinematic.motion.randomness import episode_seed

        if isinstance(index, slice):
            return SampledJobs(self._choices, self._places, self._numbers[index], seed=self._seed)
        number = self._numbers[index]
        place = self._places[number % len(self._places)]
        drawn = SampledEpisode(number, episode_seed(self._seed, number), place.name, place.source)
        return self._choices.job(drawn, spec=self._spec)

    @property
    def one_round(self) -> SampledJobs:
        """First episodes, one in each scene; all others differ from these only in their number and seed."""
        return self[: len(self._places)]


def scenes_of(jobs: Sequence[Job]) -> list[str]:
    """Return the names of the scenes, in the order in which they are first played."""
    return list(dict.fromkeys(job.scene for job in (jobs.one_round if isinstance(jobs, SampledJobs) else jobs)))


def most_steps(jobs: Sequence[Job]) -> int:
    """Return the total number of steps of the episodes if each is as long as its rules allow."""
    if isinstance(jobs, SampledJobs):
        return len(jobs) * jobs[0].spec.max_steps
    return sum(job.spec.max_steps for job in jobs)


def set_episodes(scenes: SceneSet, task: str, *, episodes: int | None, seed: int) -> Iterator[SampledEpisode]:
    """Yield the first ``episodes`` episodes of a set in a task, or new episodes if ``seed`` is not 0."""
    for i in range(chosen_count(episodes, scenes.episodes, scenes.label)):
        entry, index = scenes.place(i, "" if seed else task)
        origin = {
            "set": scenes.name,
            "split": scenes.split,
            "scene": entry.id,
            "episode": index,
            "seed": seed,
            "sha256": scenes.sha256,
        }
        drawn = scenes.episode_seed(entry.id, index, seed=seed)
        yield SampledEpisode(i, drawn, f"{scenes.label}#{entry.id}", entry.source, origin)


def refuse_beside(option: str, **given: bool) -> None:
    """Raise an `InputError` for options that a stored episode already determines."""
    for name, is_given in given.items():
        if is_given:
            raise InputError(
                f"{option} says where the episodes start: leave out --{name.replace('_', '-')}.", code="H3-JOB-026"
            )


def checked(choices: Choices) -> Choices:
    """Check all names, and return the choices with learned policies named by the digest of their weights.

    Raises:
        InputError: there is no such task, agent, policy or body.
    """
    from h3data.bodies import load_humanoid
    from sim_kinematic.agents.roster import HUMAN_BODY, kinds_of, make_roster
    from sim_kinematic.policies.assignment import each_of, resolve_policy
    from sim_kinematic.policies.learned import stamped

    task, spec = choices.found_task, choices.spec()
    human = None if choices.human in SAMPLED_BODIES else choices.human
    if human is not None:
        load_humanoid(human)
    bodies = {name: body for name, body in (("robot", choices.robot), ("human", human)) if body is not None}
    roster = make_roster(task.agents if choices.agents is None else choices.agents, **bodies)
    task.control.check_roster(roster)
    kinds = kinds_of(roster)
    if choices.motion is not None:
        if "human" not in kinds:
            raise InputError(
                f"--motion is how people walk, but there are none in --agents {','.join(choices.agents or ())}.",
                code="H3-JOB-027",
            )
        load_humanoid(f"{human or HUMAN_BODY}+{choices.motion}")
    named = {"robot": choices.policy, "human": choices.partner}
    for kind, option in (("robot", "--policy"), ("human", "--partner")):
        names = named[kind]
        if names is None or (kind, names) == ("robot", SOLO):
            continue
        if kind not in kinds:
            who = ",".join(choices.agents or task.agents)
            raise InputError(
                f"{option} {names} is for a {kind}, but there is none in --agents {who}.", code="H3-JOB-028"
            )
        named[kind] = ",".join(map(stamped, names.split(",")))
        for name in each_of(names, kinds.count(kind), kind):
            resolve_policy(task, kind, name, spec)
    if choices.policy == SOLO and ("human" not in kinds or not task.usage.can_be_solo):
        raise InputError(
            f"The policy {SOLO} leaves robots away, so somebody else must be there. Expected a person in --agents."
            if task.usage.can_be_solo
            else f"{task.name} needs a robot: the policy {SOLO} is for rearrange.",
            code="H3-JOB-019",
        )
    return replace(
        choices,
        policy=named["robot"] or _named_default(task, "robot"),
        partner=named["human"] or _named_default(task, "human"),
    )


def dataset_rules(task: Task) -> Any:
    """Return the default rules for datasets of a task."""
    return task.Spec() if task.usage.dataset_rules is None else task.usage.dataset_rules


def _named_default(task: Task, kind: str) -> str | None:
    """Return the default policy of a kind, where jobs of the task name it."""
    return task.defaults.get(kind) if kind in task.usage.named_kinds else None


def stored_person(name: str) -> str:
    """Return the name of a person in the identity of episodes, where a digest represents a motion."""
    from h3data.bodies.names import JOIN

    if JOIN not in name:
        return name
    from h3data.bodies.names import stored_name

    return stored_name(name)


def sampled_body(choice: str, seed: int, person: int = 0) -> str:
    """Return the body that an episode samples for a person: ``any`` of the twelve adults, or a ``random`` new body."""
    from h3data.bodies.people.humanoid_file import ADULTS
    from h3data.bodies.people.random_humanoid import PREFIX
    from sim_kinematic.motion.randomness import generator

    rng = generator(seed, "body", world=person)
    if choice == "random":
        return f"{PREFIX}{int(rng.integers(1 << 31))}"
    return ADULTS[int(rng.integers(len(ADULTS)))]


def chosen_count(wanted: int | None, there: int, label: str) -> int:
    """Return the number of existing episodes to play: the requested number, or all of them."""
    if there < 1:
        raise InputError(f"There are no episodes in {label}.", code="H3-JOB-022")
    if wanted is not None and wanted > there:
        raise InputError(
            f"--episodes must be at most {there}, which is all of {label}; got {wanted}.", code="H3-JOB-023"
        )
    return there if wanted is None else wanted
