"""Corners that a query looks at against all corners, and distance fields against the exact paths that they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import settings as runs
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, box

from h3data.errors import InputError
from h3data.scene import FreeSpace
from h3data.scene.freespace._visibility import GROW_M, sees, tangent, visible_nodes
from h3data.scene.freespace._visibility_build import edges_inside
from h3data.scene.freespace.build import build_from_walkable
from h3data_habitat.navmesh.navmesh import free_space_from_navmesh, navmesh_from_free_space
from h3data_homes import HomeSpec, build_home
from tests.random_cases import examples

SIZES: dict[str, Any] = {"radius_m": 0.25, "height_m": 1.41, "max_climb_m": 0.2, "cell_m": 0.05}


@pytest.fixture(scope="module")
def home() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=3)), cache=False)


def cluttered(seed: int, *, radius_m: float = 0.25) -> FreeSpace:
    """A floor with turned, aligned and touching boxes, and with an island apart."""
    rng = np.random.default_rng(seed)
    boxes = [
        shapely.affinity.rotate(box(x, z, x + w, z + d), t)
        for x, z, w, d, t in rng.uniform([0.5, 0.5, 0.1, 0.1, 0], [5, 5, 1.5, 1.5, 90], (5, 5))
    ]
    boxes += [box(*np.round(b.bounds, 1)) for b in boxes[:2]]
    floor = box(0, 0, 6, 6).difference(shapely.union_all(boxes)).union(box(7, 0, 9, 2))
    return FreeSpace.from_map(build_from_walkable(floor, **(SIZES | {"radius_m": radius_m})))


def every_visible_node(free: FreeSpace, point: np.ndarray) -> list[int]:
    """Slow and plain: all corners of the floor, one by one."""
    graph = free.graph
    return [k for k, node in enumerate(graph.nodes) if tangent(graph, *point, k, GROW_M) and sees(graph, *point, *node)]


def assert_sets_are_whole(free: FreeSpace, points: np.ndarray) -> None:
    for point in points:
        found, away = visible_nodes(free.graph, *point)
        assert list(found) == every_visible_node(free, point)
        np.testing.assert_allclose(away, np.linalg.norm(free.graph.nodes[found] - point, axis=1))


@pytest.mark.slow  # quick: those of any floor
def test_the_sets_of_a_home_miss_no_corner(home):
    rng = np.random.default_rng(0)
    border = free_border(home, rng, 40)
    assert_sets_are_whole(home, np.concatenate([home.sample(rng, 60), border, home.graph.nodes[::20]]))
    sizes = np.diff(home.graph.visible_start)
    assert 3 < sizes[sizes > 0].mean() < len(home.graph.nodes) / 10  # and they are worth having


def free_border(free: FreeSpace, rng: np.random.Generator, n: int) -> np.ndarray:
    """Points on the very border, and up to 0.08 mm outside of it."""
    ring = free.polygon.geoms[0].exterior
    at = [shapely.get_coordinates(ring.interpolate(d))[0] for d in rng.uniform(0, ring.length, n)]
    points = np.array(at) + rng.uniform(-5e-5, 5e-5, (n, 2))
    return points[free.is_navigable(points)]


@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.25]))
@runs(max_examples=examples(15))
def test_the_sets_of_any_floor_miss_no_corner(seed, radius_m):
    free = cluttered(seed, radius_m=radius_m)
    rng = np.random.default_rng(seed)
    assert_sets_are_whole(
        free, np.concatenate([free.sample(rng, 12), free_border(free, rng, 6), free.graph.nodes[::9]])
    )


def test_the_sets_around_walls_without_thickness_miss_no_corner():
    """Floors of navmeshes have sharp corners, and wedges of a half turn."""
    for cut in (box(2, 0, 2 + 1e-9, 3), box(2, 1, 2.001, 3).union(box(3, 2, 5, 2.001)), box(1, 1, 2, 2)):
        free = FreeSpace.from_map(build_from_walkable(box(0, 0, 6, 4).difference(cut), **(SIZES | {"radius_m": 0.001})))
        again = free_space_from_navmesh(navmesh_from_free_space(free))
        for space in (free, again):
            points = np.concatenate([space.sample(np.random.default_rng(1), 30), space.graph.nodes])
            assert_sets_are_whole(space, points)


@given(st.integers(0, 10**6))
@runs(max_examples=examples(15))
def test_a_field_is_the_distance_to_the_nearest_goal_and_points_along_the_path(seed):
    free = cluttered(seed)
    rng = np.random.default_rng(seed)
    points, goals = free.sample(rng, 15), free.sample(rng, 3)
    field = free.distance_field(goals)
    each = free.geodesic(points[:, None], goals[None])
    np.testing.assert_allclose(field.distance(points), each.min(1), atol=1e-5)
    direction = field.direction(points)
    ahead = np.array([free.next_waypoint(p, goals[k]) for p, k in zip(points, each.argmin(1), strict=True)]) - points
    single = np.sort(each, 1)[:, 1] - each.min(1) > 1e-4  # one nearest goal
    cosine = (direction * ahead).sum(1) / np.linalg.norm(ahead, axis=1)
    # two ways round a box can be equally long: then any of them
    other = free.geodesic(points + 1e-3 * direction, goals[each.argmin(1)], max_snap_m=0.01)
    assert ((cosine > 1 - 1e-9) | (np.abs(other - each.min(1) + 1e-3) < 2e-5) | ~single).all()
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1)


def test_the_direction_is_minus_the_gradient(home):
    rng = np.random.default_rng(3)
    goal, points = home.sample(rng, 1)[0], home.sample(rng, 300)
    field = home.distance_field(goal)
    step = 2e-3  # the tables are float32: rounding must be small against the differences
    slope = np.stack([field.distance(points + d) - field.distance(points - d) for d in np.eye(2) * step], -1) / (
        2 * step
    )
    inner = home.clearance(points) > 0.01
    close = np.linalg.norm(slope[inner] + field.direction(points[inner]), axis=1) < 0.02
    assert close.mean() > 0.97  # the rest lies on a ridge between two ways or within a step of a corner's tangent


def test_who_follows_the_direction_arrives_by_the_shortest_way(home):
    rng = np.random.default_rng(4)
    start, goal = home.sample(rng, 40).reshape(2, 20, 2)
    for p, q in zip(start, goal, strict=True):
        field = home.distance_field(q)
        length, walked, at = float(field.distance(p)), 0.0, p.copy()
        while field.distance(at) > 0.02:
            to = at + 0.01 * field.direction(at)
            to = home.snap(to)
            walked += float(np.linalg.norm(to - at))
            at = to
            assert walked < length + 0.1
        assert walked + float(field.distance(at)) == pytest.approx(length, abs=0.02)


def test_goals_off_the_floor_and_on_other_islands():
    free = FreeSpace.from_map(build_from_walkable(MultiPolygon([box(0, 0, 3, 3), box(5, 0, 7, 2)]), **SIZES))
    field = free.distance_field([[1.0, 1.0], [-9.0, 1.0]])  # the second is too far off: it does not count
    assert len(field.goals) == 1
    assert field.distance([6.0, 1.0]) == np.inf
    assert np.isnan(field.direction([6.0, 1.0])).all()
    assert field.distance([2.0, 1.0]) == pytest.approx(1.0)
    np.testing.assert_allclose(field.direction([2.0, 1.0]), [-1, 0])
    np.testing.assert_array_equal(field.direction([1.0, 1.0]), [0, 0])
    assert free.distance_field([0.1, 1.0]).goals[0, 0] == pytest.approx(0.25)  # moved to the floor
    assert free.distance_field(np.zeros((0, 2))).distance([1.0, 1.0]) == np.inf
    assert np.isinf(field.distance([np.nan, 1.0]))
    assert field.distance(np.zeros((4, 0, 2))).shape == (4, 0)
    with pytest.raises(InputError, match=r"(?s)\[3\].*H3-SCENE-006"):
        free.distance_field([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match=r"(?s)\[3\].*H3-SCENE-006"):
        field.distance([1.0, 2.0, 3.0])


def test_standing_on_a_corner_the_way_goes_on(home):
    goal = home.sample(np.random.default_rng(5), 1)[0]
    field = home.distance_field(goal)
    nodes = home.graph.nodes[home.island(home.graph.nodes) == 0]
    direction = field.direction(nodes)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1)
    ends = np.array([home.next_waypoint(n, goal) for n in nodes])
    assert edges_inside(home.polygon, nodes, ends).all()
    moved = field.distance(home.snap(nodes + 1e-3 * direction)) - field.distance(nodes)
    np.testing.assert_allclose(moved, -1e-3, atol=2e-5)
