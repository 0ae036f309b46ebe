"""PathFinder against the real habitat-sim (its answers on the same navmesh), against FreeSpace, and its laws.

Reached on the real rooms: projected points, steps with sliding, distances and hit points of walls within 1e-6 m; paths never
longer than Habitat's (2e-6 m), median difference 0; top-down maps equal but for points exactly 1 cm outside.
"""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import settings as runs
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon, box

from h3data.errors import InputError
from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable
from h3data_habitat.navmesh._surface import REACH_M, Surface, contains, height, nearest
from h3data_habitat.navmesh.file import read_navmesh
from h3data_habitat.navmesh.navmesh import free_space_from_navmesh
from h3data_habitat.navmesh.pathfinder import MultiGoalShortestPath, PathFinder, ShortestPath
from tests.habitat.navmesh.test_navmesh import REAL, ROOMS, mesh_of, needs_real, rect, room
from tests.random_cases import examples

FREE_TOL_M = 2e-6
"""Answers of the simulator are float32: 5e-7 m at 5 m."""


@cache
def real_room(name: str) -> tuple[PathFinder, dict]:
    return PathFinder(read_navmesh(room(name) / f"{name}.navmesh")), json.loads(
        (room(name) / "reference.json").read_text()
    )


@cache
def maze() -> PathFinder:
    """A FreeSpace with holes, round corners and two islands, floor at 0.5 m."""
    area = box(0, 0, 6, 4).difference(box(2, 1, 3, 2)).difference(box(4, 1.5, 4.3, 4)).union(box(7, 0, 8.5, 1.5))
    return PathFinder(
        FreeSpace.from_map(
            build_from_walkable(area, radius_m=0.2, height_m=1.4, max_climb_m=0.2, cell_m=0.05, floor_y=0.5)
        )
    )


@cache
def ring() -> PathFinder:
    """A navmesh around a square hole, cut so that many polygons meet in collinear corners."""
    parts = [rect(x, z, x + 1, z + 1) for x in range(4) for z in range(4) if (x, z) not in {(1, 1), (1, 2), (2, 1)}]
    return PathFinder(mesh_of(parts))


@cache
def storeys() -> PathFinder:
    """A floor, a ramp, a landing, a ramp back, and a second floor above the first: all one island."""
    lows = [rect(0, 0, 2, 2), rect(2, 0, 5, 2), rect(5, 0, 7, 2), rect(5, 2, 7, 4)]
    heights = [[0] * 4, [0, 1.5, 1.5, 0], [1.5] * 4, [1.5] * 4, [3, 1.5, 1.5, 3], [3] * 4, [3] * 4]
    return PathFinder(mesh_of([*lows, rect(2, 2, 5, 4), rect(0, 2, 2, 4), rect(0, 0, 2, 2)], heights=heights))


# --- against the real simulator ---------------------------------------------------------------------------------------------
@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_paths_are_found_where_habitat_finds_them_and_never_longer(name):
    finder, reference = real_room(name)
    ours, theirs = [], []
    for case in reference["geodesic"]:
        path = ShortestPath(requested_start=case["start"], requested_end=case["end"])
        assert finder.find_path(path) == case["found"]
        assert [finder.get_island(case["start"]), finder.get_island(case["end"])] == case["island"]
        if not case["found"]:
            assert np.isinf(path.geodesic_distance)
            assert len(path.points) == 0
            continue
        assert path.points[[0, -1]] == pytest.approx(np.array([case["start"], case["end"]]), abs=FREE_TOL_M)
        assert np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum() == pytest.approx(path.geodesic_distance)
        ours.append(path.geodesic_distance)
        theirs.append(case["geodesic"])
    ours, theirs = np.array(ours), np.array(theirs)
    assert len(ours) > 150
    assert (ours <= theirs + FREE_TOL_M).all()
    assert np.median(np.abs(ours - theirs) / theirs) < 1e-6
    assert (ours > theirs - 1e-3).mean() > 0.85, "Habitat's own paths are shortest in most cases"


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_paths_over_polygons_and_over_the_visibility_graph_agree(name):
    finder, reference = real_room(name)
    free = free_space_from_navmesh(finder.navmesh)
    cases = [c for c in reference["geodesic"] if c["found"] and c["island"][0] == 0]
    a, b = (np.array([c[k] for c in cases])[:, [0, 2]] for k in ("start", "end"))
    assert len(cases) > 150
    assert free.geodesic(a, b) == pytest.approx(
        [finder.geodesic_distance(c["start"], c["end"]) for c in cases], abs=1e-5
    )
    theirs = np.array([c["geodesic"] for c in cases])
    assert np.median(np.abs(free.geodesic(a, b) / theirs - 1)) < 0.01


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_several_goals(name):
    finder, reference = real_room(name)
    for case in reference["multi_goal"]:
        path = MultiGoalShortestPath(requested_start=case["start"], requested_ends=case["ends"])
        assert finder.find_path(path) == case["found"]
        if case["found"]:
            assert path.closest_end_point_index == case["closest"]
            assert path.geodesic_distance <= case["geodesic"] + FREE_TOL_M
            single = [finder.geodesic_distance(case["start"], end) for end in case["ends"]]
            assert path.geodesic_distance == min(single) == finder.geodesic_distance(case["start"], case["ends"])


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_projected_points_and_navigable_points(name):
    finder, reference = real_room(name)
    for case in reference["snap_point"]:
        expected = np.array(case["snapped"], float)
        assert finder.snap_point(case["point"]) == pytest.approx(expected, abs=FREE_TOL_M, nan_ok=True)
        assert finder.is_navigable(case["point"]) == case["navigable"]


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_steps_that_slide(name):
    finder, reference = real_room(name)
    for case in reference["try_step"]:
        assert finder.try_step(case["start"], case["end"]) == pytest.approx(np.array(case["try_step"]), abs=FREE_TOL_M)


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_steps_that_stop_agree_but_where_habitat_goes_through_a_wall(name):
    finder, reference = real_room(name)
    outline = free_space_from_navmesh(finder.navmesh, island=0).polygon
    through = 0
    for case in reference["try_step"]:
        ours, theirs = finder.try_step_no_sliding(case["start"], case["end"]), np.array(case["try_step_no_sliding"])
        if ours != pytest.approx(theirs, abs=FREE_TOL_M):
            through += 1
            way = LineString([np.array(case["start"])[[0, 2]], theirs[[0, 2]]])
            assert way.difference(outline.buffer(1e-3)).length > 0.05, "Habitat's step leaves the navmesh"
            assert LineString([way.coords[0], ours[[0, 2]]]).difference(outline.buffer(1e-5)).length == 0.0
            assert outline.boundary.distance(LineString([ours[[0, 2]]] * 2)) < 1e-5, "ours ends at a wall"
    assert through <= 1


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_the_nearest_wall(name):
    finder, reference = real_room(name)
    for case in reference["closest_obstacle"]:
        hit = finder.closest_obstacle_surface_point(case["point"], 5.0)
        assert hit.hit_dist == pytest.approx(case["distance"], abs=FREE_TOL_M)
        assert hit.hit_pos == pytest.approx(np.array(case["hit_pos"]), abs=FREE_TOL_M)
        assert hit.hit_normal == pytest.approx(np.array(case["hit_normal"]), abs=1e-4)


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_top_down_maps(name):
    finder, reference = real_room(name)
    height = reference["topdown"]["height"]
    ours = finder.get_topdown_view(0.05, height)
    theirs = np.load(room(name) / f"topdown_mpp0.05_h{height:.3f}.npy")
    assert ours.shape == theirs.shape
    differ = np.argwhere(ours != theirs)
    assert len(differ) <= 2
    low = finder.get_bounds()[0]
    for row, column in differ:  # on the edge of the 1 cm that a point may be beside the navmesh
        point = np.array([low[0] + 0.05 * column, height, low[2] + 0.05 * row])
        beside = (point - finder.snap_point(point))[[0, 2]]
        assert np.hypot(*beside) == pytest.approx(0.01, abs=FREE_TOL_M)
    islands = finder.get_topdown_island_view(0.05, height)
    assert ((islands >= 0) == ours).all()


def base_step(step, data, pose, action):
    """Pose [4, 4] and collision flag after Habitat's base action (spec/habitat.md 1.3), its discs moved by ``step``."""
    speed = np.clip(action[0], -1.0 if data["allow_back"] else 0.0, 1) * data["longitudinal_lin_speed"]
    turn = np.clip(action[1], -1, 1) * data["ang_speed"] / data["ctrl_freq"]
    if speed == 0 and turn == 0:
        return pose, False
    goal = pose.copy()
    goal[:3, 3] += pose[:3, 0] * speed / data["ctrl_freq"]
    c, s = np.cos(turn), np.sin(turn)
    goal[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ pose[:3, :3]
    offsets, flat = np.insert(data["navmesh_offsets"], 1, 0.0, axis=1), np.array([1.0, 0.0, 1.0])
    starts, goals = (offsets @ t[:3, :3].T + t[:3, 3] for t in (pose, goal))
    ends = np.array([step(a, b) for a, b in zip(starts, goals, strict=True)]) * flat
    off = np.linalg.norm(ends - goals * flat, axis=1)
    if not (off > data["collision_threshold"]).any():
        return goal, False
    if not data["allow_dyn_slide"] or (turn != 0 and data["enable_rotation_check_for_dyn_slide"]):
        return pose, True
    worst = int(np.argmax(off))
    goal[:3, 3] = pose[:3, 3] + ends[worst] - starts[worst] * flat
    return goal, True


@pytest.mark.slow  # quick: test_habitat_slide.py
@needs_real
def test_every_recorded_step_of_the_real_base_action_from_its_recorded_pose():
    finder = PathFinder(read_navmesh(REAL / "habitat-lab" / "reference" / "navmesh" / "flat.navmesh"))
    steps = collisions = slid = 0
    for file in sorted((REAL / "habitat-lab" / "reference" / "basemotion").glob("*.npz")):
        data = dict(np.load(file))
        if data["enable_lateral_move"]:
            continue
        stops = not data["sim_allow_sliding"]
        for k, action in enumerate(data["actions"]):
            pose, expected = (data["sim_obj_T"][i].astype(np.float64) for i in (k, k + 1))
            reached, hit = base_step(finder.try_step_no_sliding if stops else finder.try_step, data, pose, action)
            if stops and np.abs(reached - expected).max() > 5e-6:
                reached, hit = base_step(finder.try_step, data, pose, action)
                slid += 1  # starting off a slanting wall, rounding makes Habitat miss that wall, and slide
            assert np.abs(reached - expected).max() < 5e-6, (file.name, k)
            assert hit == data["collided"][k], (file.name, k)
            steps += 1
            collisions += hit
    assert steps == 23 * 300
    assert collisions > 200
    assert slid <= 16


# --- against FreeSpace ------------------------------------------------------------------------------------------------------
def test_over_a_free_space_everything_agrees_with_it():
    finder = maze()
    free = finder.free_space
    assert free is not None
    assert finder.num_islands == len(free.island_areas)
    assert finder.navigable_area == pytest.approx(free.polygon.area, rel=1e-5)
    rng = np.random.default_rng(3)
    points = np.stack([rng.uniform(-1, 9, 300), np.full(300, 0.5), rng.uniform(-1, 5, 300)], axis=1)
    snapped = free.snap(points[:, ::2])
    for k, p in enumerate(points):
        near = np.hypot(*(snapped[k] - p[::2]))
        if near < 2:
            assert finder.snap_point(p)[::2] == pytest.approx(snapped[k], abs=1e-5)
        if abs(near - 0.01) > 1e-4:
            assert finder.is_navigable(p) == (near < 0.01)
    inside = free.sample(rng, 60)
    lifted = np.insert(inside, 1, 0.5, axis=1)
    for k in range(0, 60, 2):
        assert finder.geodesic_distance(lifted[k], lifted[k + 1]) == pytest.approx(
            free.geodesic(inside[k], inside[k + 1]), abs=1e-6
        )
        assert finder.path(lifted[k], lifted[k + 1])[:, ::2] == pytest.approx(
            free.path(inside[k], inside[k + 1]), abs=1e-6
        )
        border = free.polygon.boundary.distance(LineString([inside[k]] * 2))
        assert finder.distance_to_closest_obstacle(lifted[k], 10.0) == pytest.approx(border, abs=1e-5)
    assert not np.isfinite(finder.geodesic_distance(lifted[0], [7.7, 0.5, 0.7]))


def test_paths_over_triangles_equal_those_of_the_visibility_graph():
    free = maze().free_space
    assert free is not None
    triangles = PathFinder(maze().navmesh)  # does not know the FreeSpace: takes its own graph
    points = free.sample(np.random.default_rng(5), 60)
    lifted = np.insert(points, 1, 0.5, axis=1)
    ours = [triangles.geodesic_distance(a, b) for a, b in zip(lifted[::2], lifted[1::2], strict=True)]
    assert ours == pytest.approx(free.geodesic(points[::2], points[1::2]), abs=1e-5)
    rim = shapely.get_coordinates(free.polygon.geoms[0])
    rim = rim[np.random.default_rng(6).permutation(len(rim))[:30]]  # corners of walls: every test is a tie there
    lifted = np.insert(rim, 1, 0.5, axis=1)
    ours = [triangles.geodesic_distance(a, b) for a, b in zip(lifted[::2], lifted[1::2], strict=True)]
    assert ours == pytest.approx(free.geodesic(rim[::2], rim[1::2]), abs=1e-4)


# --- laws -------------------------------------------------------------------------------------------------------------------
unit = st.floats(0, 1)


@runs(max_examples=examples(60), derandomize=True, deadline=None)
@given(st.lists(st.tuples(unit, unit), min_size=3, max_size=3), st.booleans())
def test_distances_are_a_metric_and_paths_stay_inside(draws, grid):
    finder = ring()
    scale = [np.round(np.array(d) * 8) / 2 if grid else np.array(d) * 4 for d in draws]
    a, b, c = (finder.snap_point([x, 0.1, z]) for x, z in scale)
    d = finder.geodesic_distance
    assert d(a, b) == pytest.approx(d(b, a), abs=1e-9)
    assert d(a, c) <= d(a, b) + d(b, c) + 1e-9
    assert d(a, b) >= np.linalg.norm(b - a) - 1e-9
    area = box(0, 0, 4, 4).difference(Polygon([(1, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3)]))
    points = finder.path(a, b)
    if len({tuple(p) for p in points[:, ::2].tolist()}) > 1:
        assert LineString(points[:, ::2]).difference(area.buffer(1e-6)).length == 0
    free = free_space_from_navmesh(finder.navmesh)
    assert free.geodesic(a[::2], b[::2]) == pytest.approx(d(a, b), abs=1e-3)


@runs(max_examples=examples(60), derandomize=True, deadline=None)
@given(unit, unit, st.floats(-20, 20), st.floats(-20, 20))
def test_no_step_leaves_the_floor_or_its_island(u, v, dx, dz):
    finder = maze()
    assert finder.free_space is not None
    start = finder.snap_point([u * 9, 0.5, v * 4])
    if np.isnan(start).any():
        return
    end = start + np.array([dx, 0, dz])
    for step in (finder.try_step, finder.try_step_no_sliding):
        reached = step(start, end)
        assert finder.is_navigable(reached)
        assert finder.get_island(reached) == finder.get_island(start)
        assert finder.free_space.polygon.buffer(1e-5).covers(LineString([reached[::2]] * 2).centroid)
    stopped = finder.try_step_no_sliding(start, end)
    assert np.linalg.norm(np.cross(stopped - start, end - start)) <= 1e-5 * (1 + np.linalg.norm(end - start)) ** 2
    way = LineString([start[::2], stopped[::2]])
    assert way.length == 0 or way.difference(finder.free_space.polygon.buffer(1e-5)).length == 0


def nearest_of_all(surface: Surface, point: np.ndarray, island: int) -> tuple[int, list[float]]:
    """What `nearest` says, by looking at every polygon."""
    x, y, z = point
    best, found, at = np.inf, -1, [np.nan] * 3
    for p in range(len(surface.island)):
        low, high = surface.box[p, :3], surface.box[p, 3:]
        if (low > point + REACH_M).any() or (high < point - REACH_M).any() or island not in (-1, surface.island[p]):
            continue
        if contains(surface, p, x, z):
            h = height(surface, p, x, z)
            d, here = max(abs(h - y) - surface.climb[0], 0.0) ** 2, [x, h, z]
        else:
            a = surface.corner[surface.start[p] : surface.start[p + 1], ::2]
            edge, off = np.roll(a, -1, axis=0) - a, point[::2] - a
            t = ((off * edge).sum(-1) / (edge * edge).sum(-1)).clip(0, 1)
            beside = a + t[:, None] * edge
            k = np.argmin(((beside - point[::2]) ** 2).sum(-1))
            h = height(surface, p, *beside[k])
            d, here = ((beside[k] - point[::2]) ** 2).sum() + (h - y) ** 2, [beside[k, 0], h, beside[k, 1]]
        if d < best - 1e-12:
            best, found, at = d, p, here
    return found, at


@pytest.mark.parametrize("finder", [maze, ring, storeys])
def test_the_nearest_polygon_is_the_one_that_a_look_at_all_of_them_finds(finder):
    surface = finder().surface
    low, high = surface.box[:, :3].min(0) - 2.5, surface.box[:, 3:].max(0) + 2.5
    rng = np.random.default_rng(0)
    far = missed = 0
    above = rng.permutation(surface.corner)[:30] + np.array([0, 0.48, 0])
    for point in np.concatenate([rng.uniform(low, high, (120, 3)), above]):
        island = int(rng.integers(-1, surface.island.max() + 1))
        found, *at = nearest(surface, *point, island)
        expected, there = nearest_of_all(surface, point, island)
        assert (found < 0) == (expected < 0)
        np.testing.assert_allclose(at, there, atol=1e-9)
        missed += found < 0
        far += found >= 0 and not contains(surface, found, point[0], point[2])
    assert missed > 5
    assert far > 20


def test_steps_slide_along_walls_and_stop_at_them():
    finder = PathFinder(mesh_of([rect(0, 0, 4, 2)]))
    assert finder.try_step([1, 0, 1], [2, 0, 3]) == pytest.approx([2, 0, 2])
    assert finder.try_step_no_sliding([1, 0, 1], [2, 0, 3]) == pytest.approx([1.5, 0, 2])
    assert finder.try_step([1, 0, 1], [40, 0, 1]) == pytest.approx([1, 0, 1]), "no navmesh within 2 m of the end"
    assert finder.try_step([1, 0, 1], [1, 0, 1]) == pytest.approx([1, 0, 1])


def test_no_step_goes_through_a_wall_without_thickness():
    parts = [rect(0, 0, 2, 2), rect(2, 0, 4, 2), rect(0, -1, 2, 0), rect(2, -1, 4, 0)]
    finder = PathFinder(mesh_of(parts, joined={(0, 2), (2, 3), (1, 3)}))
    for step in (finder.try_step, finder.try_step_no_sliding):
        assert step([1.9, 0, 1], [2.1, 0, 1]) == pytest.approx([2, 0, 1])
    assert finder.geodesic_distance([1, 0, 1], [3, 0, 1]) == pytest.approx(2 * np.sqrt(2))
    apart = PathFinder(mesh_of([rect(0, 0, 2, 2), rect(2, 0, 4, 2)], joined=set()))
    assert apart.try_step([1, 0, 1], [3, 0, 1]) == pytest.approx([1, 0, 1]), "the end is on another island"
    edge = apart.try_step([1, 0, 1], [2, 0, 1])
    assert apart.get_island(edge) == 0


def test_paths_go_over_storeys_that_lie_above_each_other():
    finder = storeys()
    assert finder.num_islands == 1
    low, high = [1.0, 0.0, 1.0], [1.0, 3.0, 1.0]
    path = finder.path(low, high)
    assert path[0] == pytest.approx(low)
    assert path[-1] == pytest.approx(high)
    assert not finder.is_navigable([1.0, 1.5, 1.0])
    flat = [[1.0, 1.0], [5.0, 2.0], [2.0, 2.0], [1.0, 1.0]]  # around the end of the wall between the ramps
    bends = np.insert(np.array(flat), 1, [0, 1.5, 3, 3], axis=1)
    assert path == pytest.approx(bends)
    assert finder.geodesic_distance(low, high) == pytest.approx(np.linalg.norm(np.diff(bends, axis=0), axis=1).sum())
    assert finder.try_step([1.9, 0, 1], [2.2, 0, 1]) == pytest.approx([2.2, 0.1, 1], abs=1e-6)
    assert finder.snap_point([1.0, 2.9, 1.0])[1] == pytest.approx(3.0)
    assert finder.get_height([3.5, 0.9, 1.0]) == pytest.approx(0.75)


def test_random_points_are_uniform_and_seeded():
    finder = PathFinder(mesh_of([rect(0, 0, 3, 1), rect(3, 0, 4, 1), rect(5, 0, 6, 1)]))
    points = finder.get_random_navigable_point(np.random.default_rng(1), n=6000)
    assert np.histogram(points[:, 0], bins=[0, 1, 2, 3, 4, 5, 6])[0] / 6000 == pytest.approx(
        [0.2, 0.2, 0.2, 0.2, 0, 0.2], abs=0.02
    )
    assert points[:, 2].mean() == pytest.approx(0.5, abs=0.02)
    again = finder.get_random_navigable_point(np.random.default_rng(1))
    assert again == pytest.approx(points[0])
    only = finder.get_random_navigable_point(np.random.default_rng(1), island_index=1, n=50)
    assert (only[:, 0] >= 5).all()
    near = finder.get_random_navigable_point_near(np.random.default_rng(2), [0, 0, 0], 0.8)
    assert np.linalg.norm(near) <= 0.8
    assert np.isnan(finder.get_random_navigable_point_near(np.random.default_rng(2), [50, 0, 0], 0.8)).all()


def test_islands_their_radius_and_area():
    finder = PathFinder(mesh_of([rect(0, 0, 4, 2), rect(6, 0, 7, 1)]))
    assert finder.island_radius(0) == pytest.approx(np.hypot(2, 1))
    assert finder.island_radius([6.5, 0.0, 0.5]) == finder.island_radius(1) == pytest.approx(np.hypot(0.5, 0.5))
    assert finder.island_radius([90.0, 0.0, 0.5]) == 0.0
    assert finder.island_area(1) == pytest.approx(1.0)
    assert finder.island_area() == finder.navigable_area == pytest.approx(9.0)
    assert finder.get_island([90.0, 0.0, 0.0]) == -1
    assert finder.snap_point([5.9, 0, 0.5], 0) == pytest.approx([4, 0, 0.5])
    assert finder.snap_point([5.9, 0, 0.5]) == pytest.approx([6, 0, 0.5])
    with pytest.raises(InputError, match=r"(?s)2.*H3-HABITAT-098"):
        finder.island_area(2)


def test_far_and_broken_points():
    finder = PathFinder(mesh_of([rect(0, 0, 4, 2)]))
    nan = [np.nan, 0, 0]
    assert np.isnan(finder.snap_point([9, 0, 0])).all()
    assert np.isnan(finder.snap_point(nan)).all()
    assert np.isnan(finder.snap_point([1e300, 0, 0])).all()
    assert not finder.is_navigable(nan)
    assert finder.distance_to_closest_obstacle([9, 0, 0]) == np.inf
    hit = finder.closest_obstacle_surface_point([2, 0, 1], 0.5)
    assert hit.hit_dist == 0.5
    assert np.isnan(hit.hit_pos).all()
    assert np.isinf(finder.geodesic_distance([1, 0, 1], nan))
    assert np.isinf(finder.geodesic_distance([1, 0, 1], np.zeros((0, 3))))
    assert not finder.find_path(MultiGoalShortestPath(requested_start=[1, 0, 1], requested_ends=[]))
    with pytest.raises(InputError, match=r"(?s)\[3\].*\[2\].*H3-HABITAT-093"):
        finder.snap_point([1, 2])
    with pytest.raises(InputError, match="H3-HABITAT-096"):
        finder.get_topdown_view(0.0, 0.0)
    with pytest.raises(InputError, match="H3-HABITAT-097"):
        finder.get_topdown_view(1e-6, 0.0)
