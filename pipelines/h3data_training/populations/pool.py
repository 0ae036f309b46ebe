"""Pool of episodes that a run plays repeatedly, sampled by several processes and stored in a file."""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from h3data.errors import FormatError, InputError, SceneError
from h3data.files import part_file
from h3data.progress import progress
from h3data.recording.task_episodes.stored_rearrangements import StoredGoal
from h3data.scene.open import named_scenes, open_scene
from h3data_training.checkpoints import differences
from h3data_training.episodes import by_home, listed_scenes
from h3data_training.populations.settings import LONGEST, PopulationSettings, rules_of
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.episode import Starts
from sim_kinematic.tasks.rearrange.codec import goal_record, target_of
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.sources import Home

if TYPE_CHECKING:
    from h3data_training.torch.rearrange.bank import RearrangeBank

T = TypeVar("T")
HomeTask = tuple[PopulationSettings, str, int]
"""Settings of a pool, and the name and number of a home."""
FORMAT = "h3data.pool/1"
SEED = 1_000_003
"""Seed of all pools, so that runs differ only in what they learn from the same episodes."""
TRIES = 3
"""Number of seeds of an episode that are tried in a home."""


class PoolEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Episode of the pool."""

    home: str
    walk: str
    """Gait of the person."""
    seed: int
    starts: list[list[float]]
    """Starts ``(x, z, heading)`` of robot and person [m, m, rad]."""
    goals: list[StoredGoal]


class Pool(msgspec.Struct, frozen=True, kw_only=True):
    """All episodes of a file, and the settings by which they were sampled."""

    format: str
    drawn_by: dict[str, Any]
    entries: list[PoolEntry]


def drawn_by(settings: PopulationSettings) -> dict[str, Any]:
    """Return the settings that determine the episodes of a pool."""
    return {
        "scenes": settings.scenes,
        "episodes_per_home": settings.episodes_per_home,
        "robot": settings.robot,
        "human": settings.human,
        "walk": settings.walk,
    }


def pool_of(settings: PopulationSettings, file: Path, *, workers: int = 1) -> Pool:
    """Return the episodes in a file, or sample them and write the file if it does not exist.

    Raises:
        FormatError: the file is not a pool of episodes, or is damaged.
        InputError: the file was sampled with other settings.
        SceneError: a home has no room for an episode.
    """
    if not file.exists():
        pool = draw_pool(settings, workers=workers)
        with part_file(file) as part:
            part.write_bytes(gzip.compress(msgspec.json.encode(pool), mtime=0))
        return pool
    try:
        pool = msgspec.json.decode(gzip.decompress(file.read_bytes()), type=Pool)
        fits = pool.format == FORMAT and all(np.shape(e.starts) == (2, 3) and e.walk in LONGEST for e in pool.entries)
    except (OSError, EOFError, zlib.error, ValueError) as fault:  # msgspec's are ValueErrors
        raise FormatError(
            f"Expected a file of episodes ({FORMAT}), this is none ({fault}). File: {file}", code="H3-TRAIN-029"
        ) from None
    if not fits or not pool.entries:
        raise FormatError(f"Expected a file of episodes {FORMAT}, got {pool.format}. File: {file}", code="H3-TRAIN-025")
    _require_drawn_by(settings, pool.drawn_by, file)
    return pool


def _require_drawn_by(settings: PopulationSettings, kept: Mapping[str, Any], file: Path) -> None:
    other = differences(kept, drawn_by(settings))
    if other:
        raise InputError(
            f"These episodes were drawn with {other}. Hint: another file. File: {file}", code="H3-TRAIN-026"
        )


def draw_pool(settings: PopulationSettings, *, workers: int = 1) -> Pool:
    """Sample the same number of episodes in each home, in several processes."""
    return Pool(format=FORMAT, drawn_by=drawn_by(settings), entries=_of_homes(_drawn, settings, workers))


def _of_homes(make: Callable[[HomeTask], list[T]], settings: PopulationSettings, workers: int) -> list[T]:
    """Return the lists that ``make`` returns for all homes, one after the other."""
    names = [named.name for named in listed_scenes(settings.scenes)]
    drawn = by_home(make, [(settings, name, k) for k, name in enumerate(names)], workers=workers)
    if not any(drawn):
        raise SceneError(f"No home of {settings.scenes} has room for an episode.", code="H3-TRAIN-027")
    return [one for of_home in drawn for one in of_home]


def _drawn(task: HomeTask) -> list[PoolEntry]:
    settings, name, number = task
    return _entries(settings, name, _home(name), number)


def _entries(settings: PopulationSettings, name: str, home: Home, number: int) -> list[PoolEntry]:
    """Return the episodes of a home, which may have room for fewer than are asked for."""
    roster = make_roster(Rearrange.agents, robot=settings.robot, human=settings.human)
    entries = []
    for index in range(settings.episodes_per_home):
        walk = settings.walks[index % len(settings.walks)]
        for attempt in range(TRIES):
            seed = episode_seed(episode_seed(SEED, number), index * TRIES + attempt)
            try:
                episode = Rearrange().sample(home.scene, home.free, seed, rules_of(walk), roster)
            except SceneError:
                continue
            goals = [goal_record(target) for target in episode.targets]
            places = episode.pair_starts.places.tolist()
            entries.append(PoolEntry(home=name, walk=walk, seed=seed, starts=places, goals=goals))
            break
    return entries


def episodes_of(pool: Pool, settings: PopulationSettings) -> list[RearrangeEpisode]:
    """Return the episodes of a pool with their homes built, ready to be played.

    Raises:
        InputError: a home does not exist, or lacks an object.
    """
    roster = make_roster(Rearrange.agents, robot=settings.robot, human=settings.human)
    homes: dict[str, Home] = {}
    episodes = []
    names = list(dict.fromkeys(entry.home for entry in pool.entries))
    with progress(desc="homes", total=len(names), unit="home", delay=1.0, leave=False) as done:
        for entry in pool.entries:
            if entry.home not in homes:
                homes[entry.home] = home = _home(entry.home)
                home.free.geodesic(
                    *np.array(entry.starts)[:, :2]
                )  # what is built at first use is then shared by processes
                done.update()
            episodes.append(_episode(entry, homes[entry.home], settings, roster))
    return episodes


def _episode(entry: PoolEntry, home: Home, settings: PopulationSettings, roster: Any) -> RearrangeEpisode:
    missing = {goal.object for goal in entry.goals} - {i.name for i in home.scene.instances}
    if missing:
        raise InputError(
            f"The home {entry.home} has no {sorted(missing)[0]}: the episodes are of another version.",
            code="H3-TRAIN-028",
        )
    places = np.array(entry.starts, np.float64)
    return RearrangeEpisode(
        scene=home.scene,
        free=home.free,
        seed=entry.seed,
        spec=rules_of(entry.walk),
        roster=roster,
        starts=places,
        targets=tuple(map(target_of, entry.goals)),
        pair=(settings.robot, settings.human),
        pair_starts=Starts.of(places),
    )


def _home(name: str) -> Home:
    (named,) = named_scenes(name)
    return Home(named.source, RearrangeSpec.agent_radius_m, RearrangeSpec.agent_height_m)


def pool_order(size: int, seed: int, episode: int) -> int:
    """Return the pool entry that a training episode plays.

    All entries are played once in random order, then in another order.
    """
    from sim_kinematic.motion.randomness import generator

    around, place = divmod(episode, size)
    return int(generator(seed, "pool", step=around).permutation(size)[place])


def default_workers() -> int:
    """Return the default number of processes, one for each core that this process may use."""
    return len(os.sched_getaffinity(0))


def bank_of(settings: PopulationSettings, file: Path, *, workers: int = 1) -> RearrangeBank:
    """Load the episodes and paths in a file for worlds on a device, or sample and store them if there is no file.

    Raises:
        FormatError: the file is damaged or of another kind.
        InputError: its episodes were sampled with other settings.
        SceneError: a home has no room for an episode.
    """
    from h3data_training.torch.rearrange.bank import RearrangeBank
    from h3data_training.torch.rearrange.bank_file import load_bank, save_bank

    if file.exists():
        bank, kept = load_bank(file)
        _require_drawn_by(settings, kept, file)
        return bank
    bank = RearrangeBank.merged(_of_homes(_home_bank, settings, workers))
    save_bank(bank, file, drawn_by=drawn_by(settings))
    return bank


def _home_bank(task: HomeTask) -> list[RearrangeBank]:
    """Return the bank of a home; none where it has no room."""
    from h3data_training.torch.rearrange.bank import RearrangeBank

    settings, name, number = task
    home, roster = _home(name), make_roster(Rearrange.agents, robot=settings.robot, human=settings.human)
    entries = _entries(settings, name, home, number)
    episodes = [replace(_episode(entry, home, settings, roster), spec=ORACLE_RULES) for entry in entries]
    return [replace(RearrangeBank.of(episodes), scenes=(), names=(name,))] if episodes else []


def with_scenes(bank: RearrangeBank, file: Path) -> RearrangeBank:
    """Return a bank with its homes opened, as rendering needs them.

    Raises:
        InputError: the file does not name the homes, because it is from a version before 0.3.
    """
    if len(bank.names) != len(bank.floors):
        raise InputError(
            f"This bank of episodes does not name its homes, so they cannot be drawn. Hint: another file. File: {file}",
            code="H3-TRAIN-016",
        )
    with progress(desc="homes", total=len(bank.names), unit="home", delay=1.0, leave=False) as done:
        scenes = []
        for name in bank.names:
            (named,) = named_scenes(name)
            scenes.append(open_scene(named.source))
            done.update()
    return replace(bank, scenes=tuple(scenes))
