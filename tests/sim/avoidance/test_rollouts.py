"""Roll-outs of commands against the steps of which they consist."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.avoidance.rollouts import roll_out
from sim_kinematic.motion.spec import HOME_BASE
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots

COMMANDS = [(1.0, 0.0, 9, 0.5), (1.0, 0.7, 4, 1.0), (1.0, 0.7, 9, 1.0), (-1.0, 0.0, 3, 0.0), (0.0, 0.0, 2, 1.0)]


@pytest.mark.parametrize("seed", range(3))
def test_a_roll_out_is_its_steps_one_by_one(seed: int) -> None:
    """To the bit, also pressed against walls, where most steps move nothing and are made once."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))
    rng, stays = np.random.default_rng(seed), 0
    for place, heading in zip(free.sample(rng, 12), rng.uniform(-np.pi, np.pi, 12), strict=True):
        state = RobotState.zeros(1)
        state.xz[0], state.heading[0] = place, heading
        for _ in range(40):  # until something stops it
            drive_robots(state, free, np.array([[1.0, 0.0]]), HOME_BASE)
        ends = roll_out(free, HOME_BASE, state.xz[0], float(state.heading[0]), np.array(COMMANDS), look_steps=12)
        for n, (forward, turn, steps, then) in enumerate(COMMANDS):
            xz, facing = state.xz[0], float(state.heading[0])
            for step in range(12):
                command = (forward, turn) if step < steps else (then, 0.0)
                one = roll_out(free, HOME_BASE, xz, facing, np.array([(*command, 1, 0.0)]), look_steps=1)
                stays += one.xz[0].tolist() == xz.tolist()
                xz, facing = one.xz[0], float(one.heading[0])
            assert ends.xz[n].tolist() == xz.tolist()
            assert ends.heading[n] == facing
    assert stays > 50
