"""The laser scanner of robots: CPU time of 360 rays, per robot, of one process and everything warm.

``lidar.<preset>.w<worlds>_people<n>_us`` sees people as discs, ``_legs_us`` by their legs.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from h3data_homes.spec import Preset
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.sensing.lidar import scan
from sim_kinematic.sensing.table import SensorContext
from sim_kinematic.world import World

Emit = Callable[[str, float, str], None]
ROUNDS = 60


def run(emit: Emit) -> None:
    """Emit ``lidar.*``."""
    cases: tuple[tuple[Preset, int, int], ...] = (("medium", 1, 1), ("large", 1, 6), ("large", 16, 6))
    for preset, worlds, people in cases:
        free = FreeSpace.from_scene(build_home(HomeSpec(preset=preset, seed=2)))
        for legs in (False, True):
            name = f"lidar.{preset}.w{worlds}_people{people}{'_legs' if legs else ''}_us"
            emit(name, 1e6 * _seconds(free, worlds, people, legs=legs), "us")


def _seconds(free: FreeSpace, worlds: int, people: int, *, legs: bool) -> float:
    """Return the median CPU time of a scan of one world [s]."""
    world = World(make_roster(["robot", *["human"] * people]), worlds=worlds)
    rng, taken = np.random.default_rng(0), []
    for _ in range(ROUNDS):
        places = free.sample(rng, worlds * (people + 1)).reshape(worlds, people + 1, 2)
        headings = rng.uniform(-np.pi, np.pi, (worlds, people + 1, 1))
        world.place(np.concatenate([places, headings], -1), [free] * worlds)
        own = world.state.agents[0]
        moment = SensorContext(
            None, world.bases[0], None, (), world, 0, own, own, own, own, own,
            world.blocked[:, 0], world.blocked[:, 0], np.zeros((worlds, 0)), lambda: (np.zeros(0), np.zeros(0)),
        )  # fmt: skip
        begun = time.process_time()
        scan(moment, legs=legs)
        taken.append(time.process_time() - begun)
    return float(np.median(taken)) / worlds
