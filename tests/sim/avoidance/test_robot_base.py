"""Robots drive, avoid and are avoided by their own size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import Robot, load_robot
from h3data.bodies.robots.robot_loading import resting_bounds
from h3data.errors import SceneError
from h3data.geometry import IDENTITY_POSE
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from h3data_worlds.robot_guess import row_radius
from h3data_worlds.shape_points import shape_points
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.avoidance.robot_base import base_of, floor_of, footprint_of, hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.contact.clearance import robot_span
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec
from tests.bodies.robots.cart_robot import CART_SETTINGS, write_cart
from tests.sim.avoidance.commands import Seen, kept_clear
from tests.simulated import simulate_social_nav, simulate_wander, social_nav_episode


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=5))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


@pytest.fixture(scope="module")
def cart_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    limits = "max_speed_mps = 1.0\nmax_turn_rad_s = 1.5\n"
    return write_cart(tmp_path_factory.mktemp("cart"), CART_SETTINGS.replace("0.26", "0.32") + limits)


@pytest.fixture(scope="module")
def cart(cart_file: Path) -> Robot:
    return load_robot(cart_file)


RULES = (
    BaseSpec(),
    BaseSpec(slide="habitat"),
    BaseSpec(max_speed_mps=1.7, allow_back=False),
    BaseSpec(disc_radius_m=0.4),
)


@pytest.mark.parametrize("rules", RULES)
def test_the_rules_are_those_of_quad_arm(rules: BaseSpec) -> None:
    assert base_of(load_robot("quad_arm"), rules) is rules
    assert footprint_of(BaseSpec()) == AVOIDANCE.robot


def test_another_robot_has_its_own_discs_and_limits(cart: Robot) -> None:
    base = base_of(cart, BaseSpec(allow_back=False))
    assert (base.disc_offsets_m, base.disc_radius_m) == ((-0.1, 0.1), 0.32)
    assert (base.max_speed_mps, base.max_turn_rad_s, base.allow_back) == (1.0, 1.5, False)
    assert footprint_of(base).radius_m == pytest.approx(0.37)
    lift = base_of(load_robot("lift_arm"), BaseSpec())
    assert (lift.disc_offsets_m, lift.disc_radius_m, lift.max_speed_mps) == ((0.0,), 0.25, 2.5)


def test_our_base_covers_the_robot_and_habitats_is_a_profile(cart: Robot) -> None:
    quad, lift = load_robot("quad_arm"), load_robot("lift_arm")
    assert base_of(quad, HOME_BASE) is HOME_BASE
    assert base_of(lift, HOME_BASE).disc_offsets_m == tuple(lift.base_discs.tolist())
    assert base_of(quad, BaseSpec()).disc_offsets_m == tuple(quad.base_profiles["habitat"].tolist())
    assert base_of(lift, BaseSpec()).disc_offsets_m == tuple(lift.base_profiles["habitat"].tolist())
    assert base_of(cart, HOME_BASE).disc_offsets_m == base_of(cart, BaseSpec()).disc_offsets_m  # it has no such profile
    for robot in (quad, lift):
        rest = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
        parts = [(rest[k], shape) for k, link in enumerate(robot.links) for shape in link.shapes]
        points = np.concatenate([shape_points(shape) @ frame[:3, :3].T + frame[:3, 3] for frame, shape in parts])
        assert row_radius(robot.base_discs, points[:, [0, 2]]) <= robot.base_radius_m + 0.025


def test_what_the_rules_ask_for_stays(cart: Robot) -> None:
    rules = BaseSpec(disc_offsets_m=(0.0, 0.25, -0.25), max_speed_mps=0.7)
    base = base_of(cart, rules)
    assert (base.disc_offsets_m, base.disc_radius_m, base.max_speed_mps) == ((0.0, 0.25, -0.25), 0.25, 0.7)
    assert base.max_turn_rad_s == 1.5


def test_the_hull_covers_the_whole_robot(cart: Robot) -> None:
    for robot in (cart, load_robot("lift_arm")):
        hull, bounds = np.array(hull_of(base_of(robot, BaseSpec()))), resting_bounds(robot)
        assert hull.min() - robot.base_radius_m <= bounds[:, 0, 0].min() + 1e-9
        assert hull.max() + robot.base_radius_m >= bounds[:, 1, 0].max() - 1e-9
        assert np.diff(hull).max(initial=0) <= 1.4 * robot.base_radius_m + 1e-9


def test_a_hull_of_ones_own_keeps_clear(free: FreeSpace) -> None:
    """A person beside the tail of a long robot: it must not swing around."""
    at = free.sample(np.random.default_rng(0), 400)
    at = at[int(np.argmax(free.signed_distance(at)))]
    robot = replace(load_robot("lift_arm"), hull_discs=np.array([-0.9, -0.6, -0.3, 0.0]))
    long, short = base_of(robot, BaseSpec()), base_of(load_robot("lift_arm"), BaseSpec())
    beside = Seen(at + np.array([-0.8, 0.7]))
    turn = (0.0, 1.0)  # to the left: the tail swings to the right
    assert kept_clear(free, short, at, 0.0, turn, at, [beside]) == turn
    assert kept_clear(free, long, at, 0.0, turn, at, [beside]) != turn


def test_wide_robots_find_their_paths_on_a_floor_of_their_own(home: Scene, free: FreeSpace, cart: Robot) -> None:
    base = base_of(cart, BaseSpec())
    floor = floor_of(cart, base, home, free)
    assert floor.radius_m == 0.32
    assert floor.polygon.area < free.polygon.area
    assert floor_of(load_robot("lift_arm"), BaseSpec(), home, free) is free
    fits = robot_fits(cart, BaseSpec(), home, free)
    places = free.sample(np.random.default_rng(0), 200)
    free_places = [place for place in places if fits(place, 0.3)]
    assert 0 < len(free_places) < len(places)
    assert (free.signed_distance(np.array(free_places)) >= 0.32 * 0.9).all()


def test_a_base_too_wide_for_a_home_is_named(home: Scene, free: FreeSpace, cart: Robot) -> None:
    huge = replace(cart, base_radius_m=9.0)
    with pytest.raises(SceneError, match=r"(?s)9.*base_radius_m.*cart.*cart\.urdf.*H3-SIM-025"):
        floor_of(huge, base_of(huge, BaseSpec()), home, free)


def test_the_span_bounds_every_posture(cart: Robot) -> None:
    rng = np.random.default_rng(0)
    for robot in (cart, load_robot("quad_arm")):
        lower, upper = np.maximum(robot.lower, -3), np.minimum(robot.upper, 3)
        joints = rng.uniform(lower, upper, (300, len(robot.rest)))
        links = robot.link_matrices(np.tile([0, 0, 0, 0, 0, 0, 1.0], (300, 1)), joints)
        assert np.hypot(links[..., 0, 3], links[..., 2, 3]).max() <= robot_span(robot)


def _clearance(track: np.ndarray, free: FreeSpace, base: BaseSpec) -> float:
    """Least distance between the discs of a base on a recorded track [T, 7] and obstacles, less their radius."""
    heading = 2 * np.arctan2(track[:, 4], track[:, 6])
    ahead = np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
    places = [track[:, [0, 2]] + offset * ahead for offset in base.disc_offsets_m]
    return float(free.signed_distance(np.stack(places)).min()) - base.disc_radius_m


@pytest.mark.slow
def test_a_cart_wanders_and_follows_by_its_own_discs(
    home: Scene, free: FreeSpace, cart: Robot, cart_file: Path
) -> None:
    base = base_of(cart, BaseSpec())
    recording = simulate_wander(home, f"robot:{cart_file},human", seed=3, steps=240, free=free)
    world = social_nav_episode(home, seed=2, free=free, robot=str(cart_file))
    followed = simulate_social_nav(world, policy="rollout_expert")
    for made in (recording, followed):
        track = made.columns["agent_0.base_pose"].astype(np.float64)
        assert _clearance(track, free, base) >= -base.clearance_tolerance_m - 1e-5
        moved = np.hypot(*np.diff(track[:, [0, 2]], axis=0).T)
        assert moved.max() <= 1.1 / 30  # sliding along a wall adds a little
        assert moved.sum() > 1.0
    assert followed.agents[0].model == f"robot/{cart_file}"
