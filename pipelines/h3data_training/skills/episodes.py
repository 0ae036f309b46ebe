"""Starts for training a skill in many homes, made by several processes and stored in a file."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.files import part_file
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes
from h3data_training.episodes import by_home, listed_scenes
from h3data_training.skills.settings import SkillSettings
from h3data_training.torch.skills.bank import COLUMNS, SkillBank
from sim_kinematic.agents.roster import AgentSpec, make_roster
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.skills.skill_starts import draw_starts
from sim_kinematic.tasks.sources import Home

FILE_FORMAT = "h3data.skill_starts/1"
DECIDING = ("scenes", "skill", "episodes_per_home", "starts", "path_m", "robot", "human")
"""Settings that, together with the seed, determine starts."""


def make_skill_bank(
    settings: SkillSettings, *, seed: int, workers: int | None = None, file: Path | None = None
) -> SkillBank:
    """Sample the starts of a run from the same number of rearrangement episodes in each home.

    Call it before CUDA is initialised, since the processes are forked.

    Args:
        settings: homes, bodies and numbers.
        seed: seed that, with the number of their home, determines the starts.
        workers: number of processes; None is one for each core, 1 uses this process.
        file: file of starts. It is read if it has the same settings, so that only the homes are built; otherwise it is
            written.

    Raises:
        InputError: there are no such homes.
        SceneError: no home has room for an episode.
    """
    about = _about(settings, seed)
    kept = None if file is None else _read(file, about)
    if kept is not None:
        tasks = [(settings, name) for name in kept.pop("homes").tolist()]
        scenes, floors = zip(*by_home(_place_of, tasks, workers=workers), strict=True)
        return SkillBank(floors=floors, scenes=scenes, **kept)
    names = [named.name for named in listed_scenes(settings.scenes)]
    drawn = by_home(
        _home_bank, [(settings, name, episode_seed(seed, k)) for k, name in enumerate(names)], workers=workers
    )
    found = {name: bank for name, bank in zip(names, drawn, strict=True) if bank is not None}
    if not found:
        raise SceneError(f"No home of {settings.scenes} has room for an episode.", code="H3-TRAIN-027")
    bank = SkillBank.merged(list(found.values()))
    if file is not None:
        columns = {name: getattr(bank, name) for name in COLUMNS}
        with part_file(file, shared=True) as part, part.open("wb") as stream:
            np.savez(stream, about=np.array(about), homes=np.array(list(found)), **columns)
    return bank


def _about(settings: SkillSettings, seed: int) -> str:
    return json.dumps({"format": FILE_FORMAT, "seed": seed, **{name: getattr(settings, name) for name in DECIDING}})


def _read(file: Path, about: str) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of a file of starts; None where it holds no starts, or others."""
    if not file.is_file():
        return None
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, TypeError, ValueError):  # damaged, or no npz file
        return None
    return arrays if str(arrays.pop("about", "")) == about and set(arrays) == {"homes", *COLUMNS} else None


def _opened(settings: SkillSettings, name: str) -> tuple[Home, tuple[AgentSpec, ...], FreeSpace]:
    """Return a home, those who are in it, and the floor for the robot's base, with the lattice that the device needs."""
    (named,) = named_scenes(name)
    rules = RearrangeSpec()
    home = Home(named.source, rules.agent_radius_m, rules.agent_height_m)
    roster = make_roster(Rearrange.agents, robot=settings.robot, human=settings.human)
    body = roster[0].robot
    floor = floor_of(body, base_of(body, rules.robot), home.scene, home.free)
    _ = floor.lattice  # built at first use
    return home, roster, floor


def _place_of(task: tuple[SkillSettings, str]) -> tuple[Scene, FreeSpace]:
    home, _, floor = _opened(*task)
    return home.scene, floor


def _home_bank(task: tuple[SkillSettings, str, int]) -> SkillBank | None:
    settings, name, seed = task
    home, roster, floor = _opened(settings, name)
    found = []
    for k in range(settings.episodes_per_home):
        try:
            episode = Rearrange().sample(home.scene, home.free, episode_seed(seed, k), RearrangeSpec(), roster)
        except SceneError:
            continue  # a home may have room for fewer episodes
        rng = np.random.default_rng(episode_seed(seed, k))
        starts = draw_starts(episode, settings.skill, settings.starts, rng, path_m=settings.path_m, any_spot=True)
        found.append((episode, floor, starts))
    return SkillBank.of(found) if any(starts for *_, starts in found) else None
