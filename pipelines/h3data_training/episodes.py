"""Training episodes in many homes, made by several processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

from h3data.errors import InputError
from h3data.progress import progress
from h3data.render.sheets.scene_map import render_scene
from h3data.scene.open import NamedScene, named_scenes
from h3data.scene.sources import SceneSource
from h3data_training.settings import Settings
from h3data_training.torch.cameras import lit_home
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.step import refuse_stairs
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.motion.spec import WALKERS, SocialNavSpec
from sim_kinematic.tasks.episode import with_options
from sim_kinematic.tasks.social_nav import TRAINING

MOST_WORKERS = 32
Task = TypeVar("Task")
Bank = TypeVar("Bank")


def rules(settings: Settings) -> SocialNavSpec:
    """Return the paper's rules for training, with the set of rules that the settings name.

    Raises:
        InputError: the settings name an unknown walk.
    """
    if settings.walk not in WALKERS:
        raise InputError(f"Unknown walk {settings.walk!r}. Expected one of: {', '.join(WALKERS)}.", code="H3-TRAIN-020")
    return with_options(TRAINING, rules=settings.walk)


def make_bank(settings: Settings, *, seed: int, workers: int | None = None) -> EpisodeBank:
    """Return the episodes of a run, the same number in each home.

    Call this function before CUDA is initialised, because the processes are forked.

    Args:
        settings: Homes, bodies and rules.
        seed: Seed that, with the number of their home, determines the episodes.
        workers: Number of processes; None is one for each core, and 1 uses this process.

    Raises:
        InputError: there are no such homes, or one has stairs.
        SceneError: a home has no room for an episode.
    """
    names = [named.name for named in listed_scenes(settings.scenes)]
    tasks = [(settings, name, episode_seed(seed, k)) for k, name in enumerate(names)]
    return EpisodeBank.merged(by_home(_home_bank, tasks, workers=workers))


def by_home(make: Callable[[Task], Bank], tasks: Sequence[Task], *, workers: int | None = None) -> list[Bank]:
    """Call ``make`` for each home in several processes (None: one for each core, 1: this process)."""
    count = min(workers or min(len(os.sched_getaffinity(0)), MOST_WORKERS), len(tasks))
    with progress(desc="homes", total=len(tasks), unit="home", delay=1.0, leave=False) as done:

        def counted(made: Iterable[Bank]) -> Iterator[Bank]:
            for bank in made:
                done.update()
                yield bank

        if count == 1 or len(tasks) <= 2:
            return list(counted(map(make, tasks)))
        with ProcessPoolExecutor(count, mp_context=get_context("fork")) as pool:
            # one process compiles and leaves the code on disk for the others; not this one: threads do not survive a fork
            first = list(counted([pool.submit(make, tasks[0]).result()]))
            # sets list their homes by size: were the largest last, one process would work on it while all others wait
            rest = list(counted(pool.map(make, tasks[:0:-1])))
    return first + rest[::-1]


def _home_bank(task: tuple[Settings, str, int]) -> EpisodeBank:
    settings, name, seed = task
    bank = EpisodeBank.draw(
        name, settings.episodes_per_home, seed=seed, spec=rules(settings), robot=settings.robot, human=settings.human
    )
    refuse_stairs(bank.floors, home=name)
    if settings.light == "baked":  # kept in the cache, where the renderer finds it
        for home in bank.scenes:
            drawn = render_scene(home)
            lit_home(home, drawn.meshes, drawn.instances, range(len(drawn.instances)))
    for floor in bank.floors:
        _ = floor.lattice  # built at first use, and needed on the device
    return bank


def listed_scenes(text: str) -> tuple[NamedScene, ...]:
    """Return the scenes of several names separated by commas, as in ``h3-homes/train,h3-homes-v2/train``, in that order.

    Raises:
        InputError, FormatError: as for `named_scenes`, or two names mean the same scene.
    """
    names = [text] if Path(text).exists() else [name.strip() for name in text.split(",")]
    found = tuple(named for name in names for named in named_scenes(name))
    seen: set[SceneSource] = set()
    for named in found:
        if named.source in seen:
            raise InputError(f"Expected each scene once, got {named.name} again. Scenes: {text}", code="H3-HABITAT-109")
        seen.add(named.source)
    return found
