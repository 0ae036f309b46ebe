"""Experts of social navigation back out of where their single commands got them stuck."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.scene import FreeSpace
from h3data.scene.open import named_scenes, open_free_space
from sim_kinematic.avoidance.maneuvers import plan_maneuver
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec, SocialNavSpec
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.social_nav import NEAR_M, Maneuvering, rollout_expert
from sim_kinematic.policies.views import SocialNavView

WEDGED = np.array([7.58605146, 9.79296398]), 0.6624391771594816
"""Where the expert stood for the rest of an episode, rear and front at walls; it had slid there."""
PERSON = np.array([6.04, 12.13])


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    rules = SocialNavSpec()
    return open_free_space(named_scenes("h3-homes/test")[6].source, rules.agent_radius_m, rules.agent_height_m)


def drive(free: FreeSpace, policy: Maneuvering, base: BaseSpec, steps: int) -> np.ndarray:
    """Places [steps, 2] of a robot from where it is wedged."""
    state = RobotState.zeros(1, joints=1)
    state.xz[0], state.heading[0] = WEDGED
    before, places = None, []
    for step in range(steps):
        xz, heading = state.xz[0].copy(), float(state.heading[0])
        geodesic = float(free.geodesic(xz, PERSON))
        choice = policy.act(SocialNavView(free, xz, heading, PERSON, geodesic, False, 0, step, before, PERSON))
        before = xz, heading
        drive_robots(state, free, np.array([[choice.forward, choice.turn]]), base)
        places.append(state.xz[0].copy())
    return np.array(places)


def test_a_base_wedged_between_two_walls_has_a_maneuver(free: FreeSpace) -> None:
    assert len(plan_maneuver(free, HOME_BASE, *WEDGED, PERSON, np.zeros((0, 3)))) > 10


def test_the_expert_gets_out_of_where_it_is_wedged(free: FreeSpace) -> None:
    alone = drive(free, Maneuvering(rollout_expert, BaseSpec(disc_offsets_m=HOME_BASE.disc_offsets_m)), HOME_BASE, 150)
    assert np.hypot(*(alone[-1] - WEDGED[0])) < 0.01  # bases that do not maneuver stay as they were
    assert np.hypot(*(drive(free, Maneuvering(rollout_expert, HOME_BASE), HOME_BASE, 150)[-1] - PERSON)) < NEAR_M


def test_who_wants_to_stand_is_left_alone(free: FreeSpace) -> None:
    places = drive(free, Maneuvering(lambda view, base: Velocity(0.0, 0.0, "wait"), HOME_BASE), HOME_BASE, 60)
    np.testing.assert_array_equal(places[-1], WEDGED[0])
