"""Starts for training a skill in many homes, made by several processes."""

from __future__ import annotations

import numpy as np

from h3data.bodies import Robot
from h3data.errors import SceneError
from h3data.habitat.scene_names import named_scenes
from h3data_training.episodes import by_home
from h3data_training.skills.settings import SkillSettings
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.skill_starts import draw_starts
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.sources import Home
from sim_kinematic.torch.skills.bank import SkillBank


def make_skill_bank(settings: SkillSettings, *, seed: int, workers: int | None = None) -> SkillBank:
    """The starts of a run, in as many episodes of rearrangement in each home. Call it before CUDA begins: the processes are
    forked.

    Raises:
        InputError: there are no such homes.
        SceneError: no home has room for an episode.
    """
    names = [named.name for named in named_scenes(settings.scenes)]
    tasks = [(settings, name, episode_seed(seed, k)) for k, name in enumerate(names)]
    banks = [bank for bank in by_home(_home_bank, tasks, workers=workers) if bank is not None]
    if not banks:
        raise SceneError(f"No home of {settings.scenes} has room for an episode.")
    return SkillBank.merged(banks)


def _home_bank(task: tuple[SkillSettings, str, int]) -> SkillBank | None:
    settings, name, seed = task
    (named,) = named_scenes(name)
    rules = RearrangeSpec()
    home = Home(named.source, rules.agent_radius_m, rules.agent_height_m)
    roster = make_roster(Rearrange.agents, robot=settings.robot, human=settings.human)
    found = []
    for k in range(settings.episodes_per_home):
        try:
            episode = Rearrange().sample(home.scene, home.free, episode_seed(seed, k), rules, roster)
        except SceneError:
            continue  # a home may have room for fewer episodes
        body = roster[0].body
        assert isinstance(body, Robot)
        floor = floor_of(body, base_of(body, rules.robot), home.scene, home.free)
        rng = np.random.default_rng(episode_seed(seed, k))
        starts = draw_starts(episode, settings.skill, settings.starts, rng, path_m=settings.path_m, any_spot=True)
        _ = floor.lattice  # built at first use, and needed on the device
        found.append((episode, floor, starts))
    return SkillBank.of(found) if any(starts for *_, starts in found) else None
