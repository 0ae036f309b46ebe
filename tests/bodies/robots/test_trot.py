"""Legs that step: feet that stand stay where they are, and rest is rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Robot, load_robot
from h3data.bodies.robots.trot import leg_angles, legs_are_posed, trot
from h3data.errors import InputError
from h3data.geometry import ground_pose, heading_direction
from tests.simulated import simulate_social_nav, social_nav_episode

LIFTED_M = 1e-4


def _track(speeds: list[float], turns: list[float], steps: int = 20) -> np.ndarray:
    """A base that keeps each speed [m/s] and turn [rad/s] for some steps of 1/30 s."""
    speed, turn = np.repeat(speeds, steps) / 30, np.repeat(turns, steps) / 30
    heading = np.cumsum(turn)
    return ground_pose(np.cumsum(speed[:, None] * heading_direction(heading), axis=0), heading, 0.2)


def _feet(robot: Robot, base: np.ndarray, joints: np.ndarray) -> np.ndarray:
    frames = robot.link_matrices(base, joints)
    links = [robot.joint_links[leg.columns[2]] for leg in robot.legs]
    return np.stack([(frames[:, k] @ [*leg.foot, 1])[:, :3] for k, leg in zip(links, robot.legs, strict=True)], axis=1)


moves = st.lists(st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), min_size=1, max_size=6)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(moves)
def test_standing_feet_keep_their_place_and_none_goes_through_the_floor(parts: list[tuple[float, float]]) -> None:
    robot = load_robot("quad_arm")
    base = _track([0.0, *(p[0] for p in parts), 0.0], [0.0, *(p[1] for p in parts), 0.0])
    joints = trot(robot, base, np.tile(robot.rest, (len(base), 1)))
    assert not robot.clamp(joints).clamped.any()
    feet = _feet(robot, base, joints)
    floor = feet[0, :, 1]
    assert (feet[..., 1] > floor - 1e-3).all()
    assert (feet[..., 1] < floor + 0.1).all()
    stands = feet[..., 1] < floor + LIFTED_M
    assert (stands.sum(1) >= 1).all()
    slide = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1)
    # a foot may end out of reach for a moment, at full speed while it turns as fast as it can
    assert np.quantile(slide[stands[1:] & stands[:-1]], 0.98) < 2e-3
    np.testing.assert_array_equal(
        np.delete(joints, [c for leg in robot.legs for c in leg.columns], 1)[0], robot.rest[:8]
    )


def test_feet_swing_close_to_a_base_that_backs_along_a_wall() -> None:
    """It slides sideways: hind legs that swung 15 cm out and 8 cm up stood in the wall with their thighs."""
    robot, steps = load_robot("quad_arm"), 120
    xz = np.cumsum(np.tile([[-0.04, 0.05]], (steps, 1)), axis=0)
    base = ground_pose(xz, np.full(steps, 0.3), 0.0)
    feet = _feet(robot, base, trot(robot, base, np.tile(robot.rest, (steps, 1))))
    rest = _feet(robot, base, np.tile(robot.rest, (steps, 1)))
    lifted = feet[..., 1] - rest[..., 1]
    off = np.hypot(*np.moveaxis(feet - rest, -1, 0)[[0, 2]])
    assert 0.04 < lifted.max() < 0.055
    assert off[lifted > 0.04].max() < 0.08


@pytest.mark.parametrize("speed", [0.3, 1.0, -0.8, 2.5])
def test_feet_never_slide_straight_ahead(speed: float) -> None:
    robot = load_robot("quad_arm")
    base = _track([0.0, speed, 0.0], [0, 0, 0], steps=40)
    joints = trot(robot, base, np.tile(robot.rest, (len(base), 1)))
    feet = _feet(robot, base, joints)
    stands = feet[..., 1] < feet[0, :, 1] + LIFTED_M
    slide = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1)
    assert slide[stands[1:] & stands[:-1]].max() < 1e-6
    lifted = ~stands[45:75]
    assert lifted.any(0).all()  # each foot steps
    assert not (lifted[:, 0] & lifted[:, 1]).any()  # one diagonal stands while the other swings
    np.testing.assert_array_equal(lifted[:, 0], lifted[:, 3])
    assert np.abs(np.diff(joints, axis=0)).max() < 0.9


def test_a_robot_that_stands_keeps_its_posture() -> None:
    robot = load_robot("quad_arm")
    base = _track([0.0], [0.0])
    joints = trot(robot, base, np.tile(robot.rest, (len(base), 1)))
    np.testing.assert_allclose(joints, np.tile(robot.rest, (len(base), 1)), atol=1e-9)


def test_absence_and_jumps_begin_anew() -> None:
    robot = load_robot("quad_arm")
    base = _track([1.0, 1.0, 1.0], [0, 0, 0])
    base[20:25] = np.nan
    base[40:, 0] += 3
    joints = trot(robot, base, np.tile(robot.rest, (len(base), 1)))
    assert np.isfinite(joints).all()
    for begin in (0, 20, 25, 40):
        np.testing.assert_allclose(joints[begin], robot.rest, atol=1e-9)
    np.testing.assert_allclose(joints[40:], trot(robot, base[40:], np.tile(robot.rest, (20, 1))), atol=1e-12)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(0.0, 1.4), st.floats(-2.2, -0.6), st.integers(0, 3))
def test_leg_angles_invert_the_leg(roll: float, pitch: float, knee: float, number: int) -> None:
    robot = load_robot("quad_arm")
    leg, joints = robot.legs[number], robot.rest.copy()
    joints[list(leg.columns)] = roll, pitch, knee
    foot = _feet(robot, np.array([[0, 0, 0, 0, 0, 0, 1.0]]), joints[None])[0, number]
    local = np.linalg.inv(robot.to_base) @ [*foot, 1]
    np.testing.assert_allclose(leg_angles(robot, leg, local[:3]), [roll, pitch, knee], atol=1e-7)


def test_feet_out_of_reach_are_approached() -> None:
    robot = load_robot("quad_arm")
    for spot in ([5, 0, 0], [0.3, 0.2, 3], [0.29785, 0.055, 0], [0, 0, -1e9]):
        angles = leg_angles(robot, robot.legs[0], spot)
        assert np.isfinite(angles).all()
        assert (angles >= robot.lower[8:11]).all()
        assert (angles <= robot.upper[8:11]).all()


def test_only_posed_legs_are_for_the_trot() -> None:
    robot = load_robot("quad_arm")
    joints = np.tile(robot.rest, (3, 1))
    assert legs_are_posed(robot, joints.astype(np.float32))
    joints[1, 9] += 0.01
    assert not legs_are_posed(robot, joints)
    wheels = load_robot("lift_arm")
    assert not legs_are_posed(wheels, wheels.rest[None])
    np.testing.assert_array_equal(
        trot(wheels, _track([1.0], [0.0], 2), np.tile(wheels.rest, (2, 1))), [wheels.rest] * 2
    )


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)\[T, 7\].*\[T, 20\].*quad_arm.*\[2, 7\].*\[3, 20\].*H3-BODY-112"):
        trot(load_robot("quad_arm"), np.zeros((2, 7)), np.zeros((3, 20)))


def test_replay_lets_the_legs_step_and_nothing_else() -> None:
    from h3data.replay import Replay
    from h3data_homes import HomeSpec, build_home
    from sim_kinematic.motion.spec import SocialNavSpec

    spec = SocialNavSpec(max_steps=40, end_on_collision=False)
    recording = simulate_social_nav(social_nav_episode(build_home(HomeSpec(preset="small", seed=1)), seed=3, spec=spec))
    robot = load_robot("quad_arm")
    posed = robot.link_matrices(recording.agent_column(0, "base_pose"), recording.agent_column(0, "joint_pos"))
    np.testing.assert_allclose(Replay(recording, stepping=False).link_matrices(0), posed, atol=1e-5)
    moved = np.abs(Replay(recording).link_matrices(0) - posed).max(axis=(0, 2, 3)) > 0.01
    legs = [name.startswith(("front_", "rear_")) for name in robot.link_names]
    np.testing.assert_array_equal(moved & ~np.array(legs), False)
    assert moved[
        [robot.link_index(f"{end}_{side}_shank") for end in ("front", "rear") for side in ("left", "right")]
    ].all()
