"""Codecs of episodes outside the simulator: records in files, entries in recordings, identity, and instruction.

A task has one `EpisodeCodec` (`sim_kinematic.tasks.task.Task.codec`), the only place where its episodes are written and
read. `TaskCodec` is the codec of all tasks whose episodes add nothing to an `Episode`.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import msgspec
import numpy as np

from h3data.bodies import load_robot
from h3data.bodies.names import JOIN, split_walk
from h3data.errors import InputError, SceneError
from h3data.geometry import Array
from h3data.plugins import names_from_data
from h3data.recording import Agent, Recording
from h3data.recording.assets.scenes import scene_attachment
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.stored_episodes import Start, StoredEpisode, info_block, plain, read_info_block
from h3data.scene import FreeSpace, Scene, scene_digest
from h3data.scene.sources import SceneSource
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, kinds_of, make_roster, with_motion
from sim_kinematic.policies.assignment import ENTRIES, AssignedPolicy
from sim_kinematic.tasks.episode import MAX_STEPS, Episode, rules_dict
from sim_kinematic.tasks.play import WorldRollout

SNAP_M = 0.05
"""Distance by which a stored point may be off the free floor [m], as files round to a centimetre and navigation meshes
to a cell."""

POLICY_ENTRIES = ("policy", "partner", "partner_plan", "population")
"""Entries of a recording's info that name policies, which change when a recording is continued with other policies."""
SceneAndMap = Callable[[float, float], tuple[Scene, FreeSpace]]
"""Function that returns the scene of a recording, and its free floor for agents of a radius [m] and a height [m]."""

R = TypeVar("R", bound=StoredEpisode)


@dataclass(frozen=True, kw_only=True)
class EpisodePlace:
    """Place in which a stored episode is played, with the user's changes to the file."""

    scene: Scene
    free: FreeSpace
    spec: Any
    """Rules of the episode."""
    agents: tuple[str, ...] | None = None
    """Roster that replaces the default one; None: the default one."""
    robot: str | None = None
    """Body that replaces the default body of robots that are named by their kind."""
    human: str | None = None
    """Body that replaces the default body of people who are named by their kind."""
    assets: tuple[str, ...] = ()
    """Asset folders for objects that the episode adds."""


class EpisodeCodec(Generic[R]):
    """Base class of codecs, which convert the episodes of a task to JSON and back, for episode files and recordings."""

    samples_starts: ClassVar[bool] = False
    """True if the codec reads files without starts, which are then sampled."""
    records_judgement: ClassVar[bool] = True
    """True if each step's reward and success are recorded (``metrics.reward``, ``metrics.success``), for the metrics
    profile ``task``. The built-in tasks do not record them, as their metrics follow from other columns."""

    foreign: ClassVar[str] = ""
    """Key in ``extra`` of episodes of other tools that the codec supports, such as PARTNR's; empty: none."""

    def __init__(self, task: Any) -> None:
        """Create the codec of a `sim_kinematic.tasks.task.Task`."""
        self.task = task

    # --- episode files ------------------------------------------------------------------------------------------------

    def record(self, episode: Episode) -> R:
        """Return the record of an episode, from which `episode` makes an identical one, bit for bit."""
        raise NotImplementedError

    def entry(self, record: R, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default") -> FileEntry:
        """Return the entry of an episode file with a record.

        The record is in the info of the entry, unless the task has a form of its own.
        """
        return FileEntry(
            episode_id=episode_id,
            scene_id=scene_id,
            scene_dataset_config=scene_dataset_config,
            info=info_block(self.task.name, record),
        )

    def read(self, entry: FileEntry, *, seed: int) -> R | None:
        """Return the record in an entry; None if the entry has no record of this task.

        ``seed`` determines everything that the file does not.

        Raises:
            FormatError: The record is damaged or from a newer version.
            InputError: The record cannot be played; the message says why.
        """
        raise NotImplementedError

    def is_complete(self, record: R) -> bool:
        """Return whether the record determines the episode without sampling."""
        return True

    def rules(self, record: R) -> Any:
        """Return the rules that a record names.

        Raises:
            InputError: The rules are not rules of this task.
        """
        raise NotImplementedError

    def stand_ins(self, record: R, source: SceneSource) -> tuple[str, ...]:
        """Return a sentence for each thing of the record that is replaced because its files are missing."""
        return ()

    def episode(self, record: R, place: EpisodePlace) -> Episode:
        """Return the episode that a record stores.

        Raises:
            SceneError: The episode does not fit the scene.
            InputError: There is no such body.
        """
        raise NotImplementedError

    # --- recordings ---------------------------------------------------------------------------------------------------
    def instruction(self, episode: Episode) -> str:
        """Return the instruction that a person would give to a robot, as recorded in ``info["instruction"]``.

        LeRobot datasets have the instruction for every frame, and language-conditioned policies are trained with it. By
        default it is the task's name in words.
        """
        return str(self.task.name).replace("_", " ").strip() or "act"

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return entries of a recording's info that are known at the start.

        Together with the scene and the bodies, they are enough for `restore`.
        """
        raise NotImplementedError

    def final_info(self, episode: Episode, play: WorldRollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return entries of a recording's info that are known only after the last step."""
        return {"ended": play.ended}

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return the identity of an episode's recording, which is the same for equal inputs."""
        raise NotImplementedError

    def restore(self, recording: Recording, scene: SceneAndMap) -> Episode:
        """Return the episode of a recording.

        Raises:
            InputError: The recording lacks something or its info is malformed; the message names it.
        """
        raise NotImplementedError

    def precompute(self, episode: Episode) -> dict[str, Any]:
        """Return entries of a recording's info that take long to compute and do not depend on how the episode is played.

        `final_info` also returns these entries. They are plain data, so that another process can compute them at the
        same time.
        """
        return {}

    def load_precomputed(self, episode: Episode, facts: Mapping[str, Any]) -> None:
        """Take over entries that `precompute` returned earlier, in another process or when the episode was recorded."""

    def policy_names(self, recording: Recording) -> list[str]:
        """Return the name of each agent's policy, as recorded."""
        info, names = recording.episode.info, []
        for kind, entry in ENTRIES.items():
            count = sum(agent.kind == kind for agent in recording.agents)
            listed = str(info.get(entry) or self.task.defaults[kind]).split(",")
            # a single name stands for all agents of the kind
            names += listed * count if len(listed) == 1 else listed
        return names

    def check_changes(self, recording: Recording, chosen: Mapping[str, Any]) -> None:
        """Raise an `InputError` if a recording cannot be continued with the policies ``chosen``; by default it can."""


def policy_entries(policies: Sequence[AssignedPolicy]) -> dict[str, str]:
    """Return the entries of a recording's info that name the policies of robots and of people."""
    return {entry: ",".join(p.name for p in policies if p.kind == kind) for kind, entry in ENTRIES.items()}


class TaskRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Record of an episode of a task that has no record class of its own."""

    starts: tuple[Start, ...]
    """Start of each agent."""
    agents: tuple[str, ...]
    """Roster of agents, with entries such as ``robot:quad_arm``."""
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Further data of the task (`Episode.extra`)."""
    seed: int = 0
    scene_sha256: str = ""
    scene_source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)


class TaskCodec(EpisodeCodec[TaskRecord]):
    """Codec of episodes that consist of starts, roster, seed, rules, and `Episode.extra`."""

    def record(self, episode: Episode) -> TaskRecord:
        """Return the record of an episode: starts, agents, seed, rules, scene and `Episode.extra`."""
        return TaskRecord(
            starts=tuple((float(x), float(z), float(heading)) for x, z, heading in episode.starts.tolist()),
            agents=tuple(f"{member.kind}:{split_walk(member.model)[0]}" for member in episode.roster),
            extra=plain(dict(episode.extra)),
            seed=episode.seed,
            scene_sha256=scene_digest(episode.scene),
            scene_source=plain(dict(episode.scene.source)),
            rules=plain(rules_dict(episode.spec)),
        )

    def read(self, entry: FileEntry, *, seed: int) -> TaskRecord | None:
        """Return the record in an entry of a file; None if the entry belongs to another task.

        Raises:
            InputError: The record is malformed or its starts are not finite.
        """
        record = read_info_block(entry, self.task.name, TaskRecord)
        if record is not None and not np.isfinite(np.array(record.starts, np.float64)).all():
            raise InputError(f"Expected finite starts, got {record.starts}.", code="H3-TASK-061")
        return record

    def rules(self, record: TaskRecord) -> Any:
        """Return the rules in a record, as the task's class of rules."""
        return read_rules(record.rules, self.task.Spec)

    def episode(self, record: TaskRecord, place: EpisodePlace) -> Episode:
        """Return the episode of a record in an opened scene, with the record's agents or those that the caller names.

        Raises:
            InputError: The number of starts and of agents differ, or a start is not on the free floor.
        """
        names = place.agents or record.agents
        if place.human is not None and place.human.startswith(JOIN):  # a motion alone, for everybody
            names = with_motion(names, place.human)
        if place.robot:
            # loaded outside of names_from_data: the user may name any file, and an episode file may not
            load_robot(place.robot)
        with nullcontext() if place.agents else names_from_data():
            roster = make_roster(names, robot=place.robot or ROBOT_BODY, human=place.human or HUMAN_BODY)
        self.task.control.check_roster(roster)
        starts = np.array(record.starts, np.float64).reshape(-1, 3)
        if len(starts) != len(roster):
            raise InputError(
                f"The episode has starts for {len(starts)} agents, agents= names {len(roster)}.", code="H3-TASK-062"
            )
        starts = starts_on_floor(place.free, record.starts)
        return Episode(
            scene=place.scene,
            free=place.free,
            seed=record.seed,
            spec=place.spec,
            roster=roster,
            starts=starts,
            extra=dict(record.extra),
        )

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the policies, rules, starts and `Episode.extra` for a recording's info."""
        info: dict[str, Any] = {
            **policy_entries(policies),
            "max_steps": episode.spec.max_steps,
            "spec": rules_dict(episode.spec),
            "starts": episode.starts.tolist(),
        }
        if episode.extra:
            info["extra"] = dict(episode.extra)
        return info

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return the identifier derived from task, scene, bodies, policies, seed, rules, starts and `Episode.extra`."""
        who = ",".join(f"{member.model}:{policy.name}" for member, policy in zip(episode.roster, policies, strict=True))
        what = f"{self.task.name}:{scene_attachment(episode.scene)[1]}:{who}:{episode.seed}:{episode.spec}"
        return uid_of(f"{what}:{episode.starts.tolist()}:{episode.extra}")

    def restore(self, recording: Recording, scene: SceneAndMap) -> Episode:
        """Return the episode of a recording, from the rules and starts in its info.

        Raises:
            InputError: The recording lacks one of them, or its info is malformed.
        """
        info, agents = recording.episode.info, recording.agents
        require_info(recording, "spec", "starts")
        try:
            # empty entries give the paper's base and walker, where the spec's defaults are the natural ones
            spec = msgspec.convert({"robot": {}, "human": {}, **info["spec"]}, self.task.Spec)
            starts = np.array(msgspec.convert(info["starts"], list[Start]), np.float64)
        except (msgspec.ValidationError, TypeError) as fault:
            raise malformed_info(fault) from None
        # a damaged or hostile file must not keep the simulator busy for days
        if not 0 < spec.max_steps <= MAX_STEPS:
            raise InputError(
                f"Expected 1 to {MAX_STEPS} steps, the recording's rules say {spec.max_steps}.", code="H3-TASK-063"
            )
        roster = recorded_roster(agents)
        home, free = scene(spec.agent_radius_m, spec.agent_height_m)
        require_on_floor(starts, free, len(roster))
        return Episode(
            scene=home,
            free=free,
            seed=recording.episode.seed,
            spec=spec,
            roster=roster,
            starts=starts,
            extra=dict(info.get("extra", {})),
        )


# --- parts of several codecs ------------------------------------------------------------------------------------------
def uid_of(what: str) -> str:
    """Return the identity of a recording, derived from a text that names all its inputs."""
    # uuid5 is a digest of the text: neither time nor chance is in it
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"h3data:{what}"))


def require_info(recording: Recording, *names: str) -> None:
    """Check that a recording's info has some required entries.

    Raises:
        InputError: The info lacks some of the entries; the message names them.
    """
    lacks = [name for name in names if name not in recording.episode.info]
    if lacks:
        raise InputError(f"The recording cannot be simulated again, it lacks: {', '.join(lacks)}.", code="H3-TASK-023")


def malformed_info(fault: Exception) -> InputError:
    """Return the error for a recording's info that cannot be converted."""
    return InputError(f"The recording's info is malformed: {str(fault).replace('`', '')}", code="H3-TASK-030")


def recorded_roster(agents: Sequence[Agent]) -> tuple[AgentSpec, ...]:
    """Return the roster of a recording's agents.

    Raises:
        InputError: People come before robots, or there is no such body.
    """
    roster, kinds = (
        make_roster([f"{agent.kind}:{agent.model.partition('/')[2]}" for agent in agents]),
        [a.kind for a in agents],
    )
    # make_roster puts robots first: in another order, columns would be those of other agents
    if list(kinds_of(roster)) != kinds:
        raise InputError(f"Expected robots, then people, got: {kinds}.", code="H3-TASK-024")
    return roster


def require_on_floor(starts: Array, free: FreeSpace, count: int) -> None:
    """Check recorded starts ``(x, z, heading)``.

    Raises:
        InputError: The starts are not ``count`` finite places on the free floor.
    """
    # nothing is moved onto the floor here: recordings keep starts exactly, only files round them
    if starts.shape != (count, 3) or not np.isfinite(starts).all() or not free.is_navigable(starts[:, :2]).all():
        raise InputError(
            f"Expected starts on the free floor for {count} agents, got: {starts.tolist()}.", code="H3-TASK-027"
        )


def read_rules(rules: Mapping[str, Any], kind: type[Any], **defaults: Any) -> Any:
    """Return rules from a file, where rules that the file does not name are those of the paper.

    Raises:
        InputError: The rules are not rules of this kind.
    """
    try:
        # empty entries give the paper's base and walker, where the spec's defaults are the natural ones
        spec = msgspec.convert({"robot": {}, "human": {}, **defaults, **rules}, kind)
    except (msgspec.ValidationError, InputError) as fault:
        raise InputError(
            f"The rules of the episode cannot be used: {str(fault).replace('`', '')}", code="H3-TASK-052"
        ) from None
    if not 1 <= spec.max_steps <= MAX_STEPS or not 0 < spec.human.speed_mps <= 4:
        raise InputError(
            f"The rules of the episode cannot be used: expected max_steps from 1 and a walking speed above 0 and at most "
            f"4 m/s, got {spec.max_steps} and {spec.human.speed_mps}.",
            code="H3-TASK-049",
        )
    return spec


def starts_on_floor(free: FreeSpace, starts: Sequence[Start]) -> Array:
    """Return starts [A, 3], where those that rounding has moved off the free floor are moved back onto it.

    Raises:
        SceneError: A start is farther off, so the scene must be another one.
    """
    places = np.array(starts, np.float64).reshape(-1, 3)
    off = ~free.is_navigable(places[:, :2])
    if off.any():
        places[off, :2] = free.snap(places[off, :2], max_distance_m=SNAP_M)
    # snap gives NaN where no floor is near enough
    if np.isnan(places).any():
        raise SceneError(
            "Starts of the episode are not on the free floor of this scene. Expected the scene for which the episode was "
            "made.",
            code="H3-TASK-060",
        )
    return places
