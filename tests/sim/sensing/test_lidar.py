"""The laser scanner: walls as the map has them, people and robots as circles, legs where a posed body has them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from h3data.errors import InputError
from h3data.geometry import distance_to_circles, ground_pose
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.contact.outlines import LEG_RADIUS_M
from sim_kinematic.sensing.lidar import LIDAR_M, LIDAR_RAYS
from sim_kinematic.sensing.table import LIDARS, SENSORS
from sim_kinematic.world import DriveCommand, WaypointCommand, World

TURNS = np.arange(LIDAR_RAYS) * (2 * np.pi / LIDAR_RAYS)


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))


def test_rays_end_at_walls(free: FreeSpace) -> None:
    rng = np.random.default_rng(0)
    xz, heading = free.sample(rng, 40), rng.uniform(-np.pi, np.pi, 40)
    angles = heading[:, None] + TURNS
    seen = free.free_along(xz, angles, max_m=LIDAR_M)
    assert seen.shape == (40, LIDAR_RAYS)
    direction = np.stack([np.cos(angles), -np.sin(angles)], -1)
    along = np.linspace(0, 0.98, 60)[:, None, None, None] * seen[..., None] * direction
    assert (free.signed_distance(xz[:, None] + along) > -0.012).all()  # never through a wall
    ends = free.signed_distance(xz[:, None] + seen[..., None] * direction)
    reached = seen < LIDAR_M
    assert reached.mean() > 0.9
    assert np.quantile(np.abs(ends[reached]), 0.99) < 0.005
    np.testing.assert_array_equal(free.free_along(xz[7], angles[7], max_m=LIDAR_M), seen[7])
    assert free.free_along(xz, angles, max_m=0.5).max() == 0.5


def test_rays_from_walls_and_from_outside_are_short(free: FreeSpace) -> None:
    far = free.origin - 30.0
    assert free.free_along(far, TURNS, max_m=LIDAR_M).tolist() == [0.0] * LIDAR_RAYS
    assert np.isfinite(free.free_along(np.full(2, np.nan), TURNS, max_m=LIDAR_M)).sum() in (0, LIDAR_RAYS)
    with pytest.raises(InputError, match="H3-SCENE-069"):
        free.free_along(np.zeros((3, 2)), TURNS, max_m=LIDAR_M)


@given(
    st.floats(0.5, 10.0), st.floats(-np.pi, np.pi), st.floats(0.05, 0.4), st.floats(-np.pi, np.pi), st.floats(-5.0, 5.0)
)
def test_a_circle_is_hit_where_it_is(distance: float, bearing: float, radius: float, heading: float, x: float) -> None:
    xz = np.array([x, 2.0])
    circle = np.append(xz + distance * np.array([np.cos(bearing), -np.sin(bearing)]), radius)
    seen = distance_to_circles(xz, heading + TURNS, circle[None])
    hit = np.isfinite(seen)
    ends = xz + seen[hit, None] * np.stack([np.cos(heading + TURNS[hit]), -np.sin(heading + TURNS[hit])], -1)
    np.testing.assert_allclose(np.hypot(*(ends - circle[:2]).T), radius, atol=1e-6)
    assert (np.hypot(*(ends - xz).T) <= distance).all()
    expected = 2 * np.arcsin(radius / distance) / (2 * np.pi / LIDAR_RAYS)
    assert abs(int(hit.sum()) - expected) <= 1


def test_a_person_at_2_m_is_met_within_5_mm(free: FreeSpace) -> None:
    world = World(make_roster("robot,human"), worlds=2)
    at = next(p for p in free.sample(np.random.default_rng(0), 2000) if free.signed_distance(p) > 1.2)
    robots = [at, at]
    headings = [0.0, 1.0]
    gaps = [0.8, 1.1]
    people = [p + d * np.array([np.cos(h), -np.sin(h)]) for p, h, d in zip(robots, headings, gaps, strict=True)]
    starts = np.array([[[*r, h], [*p, 0.5]] for r, h, p in zip(robots, headings, people, strict=True)])
    world.place(starts, [free] * 2)
    discs = world.circles(0)
    assert discs.shape == (2, 1, 3)
    seen = distance_to_circles(np.array(robots), np.array(headings)[:, None] + TURNS, discs)
    np.testing.assert_allclose(seen[:, 0], np.array(gaps) - 0.25, atol=1e-9)
    assert world.circles(1).shape[1] == len(world.bases[0].disc_offsets_m)


def test_legs_are_where_a_posed_body_has_them(free: FreeSpace) -> None:
    """The circles lie between knee and ankle of the skinned body, also while it walks."""
    world = World(make_roster("robot,human,human"), worlds=3)
    rng = np.random.default_rng(2)
    spots = free.sample(rng, 9).reshape(3, 3, 2)
    world.place(np.concatenate([spots, rng.uniform(-3, 3, (3, 3, 1))], -1), [free] * 3)
    goals = free.sample(rng, 3)
    for _ in range(40):
        world.step([DriveCommand(np.zeros((3, 2))), WaypointCommand(goals), WaypointCommand(goals)])
    legs = world.circles(0, legs=True)
    assert legs.shape == (3, 4, 3)
    assert (legs[..., 2] == LEG_RADIUS_M).all()
    body: Any = world.roster[1].body
    own = world.state.agents[1]
    clip, phase, blend, *_ = world.posture(1, np.arange(3))
    roots = ground_pose(own.xz, own.heading, np.zeros(3))
    points = body.skin(body.joint_matrices(roots, *body.clip_pose(clip, phase, blend)))
    for w in range(3):
        cut = points[w][np.abs(points[w][:, 1] - 0.3) < 0.05][:, [0, 2]]
        assert (np.array([np.hypot(*(cut - leg).T).min() for leg in legs[w, :2, :2]]) < 0.09).all()
    apart = np.hypot(*(legs[:, 0, :2] - legs[:, 1, :2]).T)
    assert ((apart > 0.05) & (apart < 0.9)).all()


def test_environments_show_it() -> None:
    env = h3data.make("social_nav", scenes="small:1", observations=("lidar", "lidar_legs", "humanoid_gps"))
    shown, _ = env.reset(seed=3)
    space: Any = env.observation_space
    for name in LIDARS:
        assert space[name].contains(shown[name])
        assert shown[name].shape == (LIDAR_RAYS,)
        assert len(SENSORS[name].unit) == LIDAR_RAYS
    many = h3data.make("social_nav", scenes="small:1", num_envs=3, observations=LIDARS)
    rows, _ = many.reset(seed=3)
    np.testing.assert_array_equal(rows["lidar"][0], shown["lidar"])
    people = np.flatnonzero(rows["lidar"] != rows["lidar_legs"])
    assert len(people) < 0.3 * rows["lidar"].size


# --- in three dimensions ------------------------------------------------------------------------------------------------
def test_environments_show_3d_scans() -> None:
    pytest.importorskip("embreex")
    options: Any = {"scenes": "small:1", "observations": ("lidar_3d", "lidar", "localization")}
    env = h3data.make("social_nav", **options)
    shown, _ = env.reset(seed=3)
    space: Any = env.observation_space
    scan = shown["lidar_3d"]
    assert space["lidar_3d"].contains(scan)
    assert scan.shape == (16, 360)
    assert 0.3 < scan.min() < scan.max() <= 30.0
    level, flat = np.minimum(scan[7:9].max(0), 12.0), shown["lidar"]
    assert np.median(level - flat) > -0.05, "above furniture it sees as far as the map says, or farther"
    many = h3data.make("social_nav", num_envs=2, **options)
    rows, _ = many.reset(seed=3)
    np.testing.assert_allclose(rows["lidar_3d"][0], scan, atol=1e-5)
    env.step(np.array([1.0, 0.0]))
    again = env.step(np.array([1.0, 0.5]))[0]["lidar_3d"]
    assert np.abs(again - scan).max() > 0.01


def test_a_3d_scan_sees_people_but_not_the_robot_itself(free: FreeSpace) -> None:
    pytest.importorskip("embreex")
    from sim_kinematic.sensing.camera_sensor import StateRenderer

    home = build_home(HomeSpec(preset="small", seed=1))
    world = World(make_roster("robot,human"))
    at = next(p for p in free.sample(np.random.default_rng(0), 4000) if free.free_along(p, [0.0], max_m=9)[0] > 2.0)
    drawn, seen = StateRenderer(home, [member.body for member in world.roster]), []
    for ahead in (1.3, -40.0):
        world.place(np.array([[[*at, 0.0], [at[0] + ahead, at[1], 1.0]]]), [free])
        drawn.pose(world.state, floor=free)
        seen.append(drawn.scans(0)[0])
    near, away = seen
    assert 0.9 < near[:, 0].min() < 1.3, "the person, 1.3 m ahead"
    assert away[:, 0].min() > 1.5
    behind = slice(90, 270)
    np.testing.assert_array_equal(near[:, behind], away[:, behind])
    with pytest.raises(InputError, match="H3-SIM-056"):
        drawn.scans(1)
