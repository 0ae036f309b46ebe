"""Episodes of a task in episode files: a class of five methods converts them to records and back."""

from __future__ import annotations

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
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.stored_episodes import Start, StoredEpisode, info_block, plain, read_info_block
from h3data.scene import FreeSpace, Scene, scene_digest
from h3data.scene.sources import SceneSource
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, make_roster, with_motion
from sim_kinematic.tasks.episode import MAX_STEPS, Episode, rules_dict

SNAP_M = 0.05
"""A stored point may be this far off the free floor: files round to a centimeter, navigation meshes to a cell."""

R = TypeVar("R", bound=StoredEpisode)


@dataclass(frozen=True, kw_only=True)
class EpisodePlace:
    """Where a stored episode is played, and what the user wants other than the file."""

    scene: Scene
    free: FreeSpace
    spec: Any
    """The rules."""
    agents: tuple[str, ...] | None = None
    """Another roster."""
    robot: str | None = None
    """Another body of robots named by their kind."""
    human: str | None = None
    """Another body of people named by their kind."""
    assets: tuple[str, ...] = ()
    """Asset folders for objects that the episode adds."""


class EpisodeStorage(Generic[R]):
    """Converts the episodes of a task to records in files and back. A base class."""

    samples_starts: ClassVar[bool] = False
    """Whether it reads files without starts, which are sampled then."""

    def record(self, episode: Episode) -> R:
        """The record of an episode, from which `episode` makes the same one, bit for bit."""
        raise NotImplementedError

    def entry(self, record: R, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default") -> FileEntry:
        """The entry of an episode file that carries a record."""
        raise NotImplementedError

    def read(self, entry: FileEntry, *, seed: int) -> R | None:
        """The record that an entry carries; None if it says nothing about this task.

        ``seed`` is for what the file leaves to chance.

        Raises:
            FormatError: it is damaged or from a newer version.
            InputError: it cannot be played; the message says why.
        """
        raise NotImplementedError

    def is_complete(self, record: R) -> bool:
        """Whether the record leaves nothing to chance."""
        del record
        return True

    def rules(self, record: R) -> Any:
        """The rules that a record names.

        Raises:
            InputError: they are none of this task.
        """
        raise NotImplementedError

    def stand_ins(self, record: R, source: SceneSource) -> tuple[str, ...]:
        """A sentence on each thing of the record that is replaced because its files are missing."""
        del record, source
        return ()

    def episode(self, record: R, place: EpisodePlace) -> Episode:
        """The episode that a record stores.

        Raises:
            SceneError: it does not fit the scene.
            InputError: its bodies are none that we know.
        """
        raise NotImplementedError


class TaskRecord(msgspec.Struct, frozen=True, kw_only=True):
    """An episode of a task without a record of its own."""

    starts: tuple[Start, ...]
    """Start of each agent."""
    agents: tuple[str, ...]
    """The roster, as ``robot:quad_arm``."""
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """`Episode.extra`."""
    seed: int = 0
    scene_sha256: str = ""
    scene_source: Mapping[str, Any] = msgspec.field(default_factory=dict)
    rules: Mapping[str, Any] = msgspec.field(default_factory=dict)


class TaskStorage(EpisodeStorage[TaskRecord]):
    """Stores what every episode has: starts, roster, seed, rules, and `Episode.extra`."""

    def __init__(self, task: str, rules: type[Any], check_roster: Callable[[Sequence[AgentSpec]], None]) -> None:
        self._task, self._rules, self._check_roster = task, rules, check_roster

    def record(self, episode: Episode) -> TaskRecord:
        """Record of an episode: starts, agents, seed, rules, scene and `Episode.extra`."""
        return TaskRecord(
            starts=tuple((float(x), float(z), float(heading)) for x, z, heading in episode.starts.tolist()),
            agents=tuple(f"{member.kind}:{split_walk(member.model)[0]}" for member in episode.roster),
            extra=plain(dict(episode.extra)),
            seed=episode.seed,
            scene_sha256=scene_digest(episode.scene),
            scene_source=plain(dict(episode.scene.source)),
            rules=plain(rules_dict(episode.spec)),
        )

    def entry(
        self, record: TaskRecord, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        """Entry of an episode file that holds the record in its info."""
        return FileEntry(
            episode_id=episode_id,
            scene_id=scene_id,
            scene_dataset_config=scene_dataset_config,
            info=info_block(self._task, record),
        )

    def read(self, entry: FileEntry, *, seed: int) -> TaskRecord | None:
        """Record in an entry of a file; None if the entry belongs to another task.

        Raises:
            InputError: the record is malformed or its starts are not finite.
        """
        del seed
        record = read_info_block(entry, self._task, TaskRecord)
        if record is not None and not np.isfinite(np.array(record.starts, np.float64)).all():
            raise InputError(f"Expected finite starts, got {record.starts}.", code="H3-TASK-061")
        return record

    def rules(self, record: TaskRecord) -> Any:
        """Rules in a record, as the task's class of rules."""
        return read_rules(record.rules, self._rules)

    def episode(self, record: TaskRecord, place: EpisodePlace) -> Episode:
        """Episode of a record in an opened scene, with the agents of the record or those that the caller names.

        Raises:
            InputError: the number of starts and of agents differ, or a start is not on the free floor.
        """
        names = place.agents or record.agents
        if place.human is not None and place.human.startswith(JOIN):  # a motion alone, for everybody
            names = with_motion(names, place.human)
        if place.robot:
            load_robot(place.robot)  # of the user, as a name of the file may not be
        with nullcontext() if place.agents else names_from_data():
            roster = make_roster(names, robot=place.robot or ROBOT_BODY, human=place.human or HUMAN_BODY)
        self._check_roster(roster)
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


def read_rules(rules: Mapping[str, Any], kind: type[Any], **defaults: Any) -> Any:
    """Rules from a file; what they do not name is as in the paper.

    Raises:
        InputError: they are none of this kind.
    """
    try:
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
    """Starts [A, 3]; those that rounding has put beside the free floor are moved onto it.

    Raises:
        SceneError: one is farther off: it is another scene.
    """
    places = np.array(starts, np.float64).reshape(-1, 3)
    off = ~free.is_navigable(places[:, :2])
    if off.any():
        places[off, :2] = free.snap(places[off, :2], max_distance_m=SNAP_M)
    if np.isnan(places).any():
        raise SceneError(
            "Starts of the episode are not on the free floor of this scene. Expected the scene for which the episode was "
            "made.",
            code="H3-TASK-060",
        )
    return places
