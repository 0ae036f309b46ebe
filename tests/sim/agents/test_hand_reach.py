"""A bound on how far an arm gets spares the search for postures, and never denies one."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.bodies import load_robot
from sim_kinematic.agents.robots.hand_reach import hand_turn, is_beyond_reach, reach_posture


@pytest.mark.parametrize(("model", "spared"), [("quad_arm", 0.9), ("lift_arm", 0.0)])
def test_nothing_that_is_reached_is_beyond_reach(model: str, spared: float) -> None:
    robot, rng = load_robot(model), np.random.default_rng(0)
    # a third of them anywhere around the robot, the others near it
    places = np.concatenate(
        [rng.uniform([-2, 0, -2], [2, 1.6, 2], (300, 3)), rng.uniform([-1.2, 0.2, -1.2], [1.2, 1.3, 1.2], (600, 3))]
    )
    targets = np.concatenate([places, np.tile(hand_turn(robot), (len(places), 1))], axis=1)
    reached = reach_posture(robot, targets, restarts=8).reached
    beyond = np.array([is_beyond_reach(robot, target) for target in targets])
    assert reached.any()
    assert not (reached & beyond).any()
    assert beyond[:300].mean() >= spared


def test_what_is_far_away_is_beyond_the_reach_of_any_arm() -> None:
    for model in ("quad_arm", "lift_arm"):
        robot = load_robot(model)
        assert is_beyond_reach(robot, np.array([9.0, 1.0, 0.0, *hand_turn(robot)]))
