"""FreeSpace on handmade homes: distances against analytic ones, paths against slow plain search, laws of a metric."""

from __future__ import annotations

import heapq
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, Point, box
from shapely.ops import nearest_points

from h3data.errors import InputError, SceneError
from h3data.geometry import quat_from_heading
from h3data.mesh.mesh import Mesh
from h3data.scene import FreeSpace
from h3data.scene.freespace._visibility import visibility_edges
from h3data.scene.freespace._visibility_build import edges_inside
from h3data.scene.freespace.build import build_from_walkable
from h3data.scene.freespace.free_space import line_of_sight, sample_sdf, sdf_gradient
from h3data.scene.records import Asset, Box, Capsule, Cylinder, Hull, Instance, Room, Scene, Shape
from h3data_homes import HomeSpec, build_home

SIZES = {"radius_m": 0.25, "height_m": 1.41, "max_climb_m": 0.2, "cell_m": 0.05}
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
_FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
_FACES += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
CUBE = np.array(_FACES, np.int32)


def solid(x0, y0, z0, x1, y1, z1, heading=0.0, motion="static"):
    """A box as asset and instance, with a mesh and a collision shape."""
    half = np.array([x1 - x0, y1 - y0, z1 - z0]) / 2
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half
    mesh = Mesh(vertices=corners.astype(np.float32), faces=CUBE, colors=np.full((8, 3), 200, np.uint8))
    pose = np.concatenate([[(x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2], quat_from_heading(heading)])
    return mesh, (Box(pose=IDENTITY, half_extents=half),), pose, motion


def scene_of(*things, rooms=()):
    assets, instances = {}, []
    for k, (mesh, shapes, pose, motion) in enumerate(things):
        assets[f"a{k}"] = Asset(name=f"a{k}", mesh=mesh, shapes=shapes)
        instances.append(Instance(name=f"i{k}", asset=f"a{k}", pose=pose, motion=motion))
    rooms = tuple(Room(name=f"r{k}", category="room", rectangles=np.array([r], float)) for k, r in enumerate(rooms))
    return Scene(name="handmade", assets=assets, instances=tuple(instances), rooms=rooms)


def shape_scene(shape: Shape, *, scale=(1.0, 1.0, 1.0), pose=IDENTITY):
    """One shape in the middle of a room of 8 x 8 m about the origin."""
    mesh = Mesh(
        vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
    )
    return Scene(
        name="one",
        assets={"a": Asset(name="a", mesh=mesh, shapes=(shape,))},
        instances=(Instance(name="i", asset="a", pose=pose, scale=np.array(scale)),),
        rooms=(Room(name="r", category="room", rectangles=np.array([[-4.0, -4.0, 4.0, 4.0]])),),
    )


@pytest.fixture(scope="module")
def two_rooms() -> Scene:
    """4 x 4 m each, a wall of 12 cm with a door of 0.95 m (lintel above), furniture, a rug, a toy that may be moved."""
    return scene_of(
        solid(4.0, 0.0, 0.0, 4.12, 2.6, 1.5),
        solid(4.0, 0.0, 2.45, 4.12, 2.6, 4.0),
        solid(4.0, 2.1, 1.5, 4.12, 2.6, 2.45),
        solid(1.2, 0.0, 1.0, 2.0, 0.8, 2.8, heading=0.5),
        solid(5.5, 0.7, 1.0, 6.3, 0.75, 3.0),  # a table top: legs or not, one cannot stand there
        solid(6.9, 0.0, 0.2, 7.9, 0.02, 1.2),  # a rug
        solid(0.5, 0.0, 3.2, 0.9, 1.0, 3.6, motion="kinematic"),
        rooms=[(0, 0, 4, 4), (4.12, 0, 8.12, 4)],
    )


@pytest.fixture(scope="module")
def free(two_rooms: Scene) -> FreeSpace:
    return FreeSpace.from_scene(two_rooms, cache=False)


def test_distances_are_exact_at_cell_centres(free, two_rooms):
    furniture = shapely.affinity.rotate(box(1.2, 1.0, 2.0, 2.8), -np.degrees(0.5))  # z points down on the plane
    walls = [box(4.0, 0, 4.12, 1.5), box(4.0, 2.45, 4.12, 4.0)]
    walkable = box(0, 0, 8.12, 4).difference(shapely.union_all([furniture, *walls, box(5.5, 1, 6.3, 3)]))
    rng = np.random.default_rng(0)
    for i, j in zip(rng.integers(0, free.sdf.shape[0], 300), rng.integers(0, free.sdf.shape[1], 300), strict=True):
        p = Point(*(free.origin + (np.array([i, j]) + 0.5) * free.cell_m))
        expected = walkable.boundary.distance(p) * (1 if walkable.contains(p) else -1)
        assert free.sdf[i, j] == pytest.approx(expected, abs=2e-4)


def test_lookup_gradient_and_kernels_agree_with_the_grid(free):
    centre = free.origin + (np.array([30, 20]) + 0.5) * free.cell_m
    assert free.signed_distance(centre) == pytest.approx(free.sdf[30, 20], abs=1e-7)
    rng = np.random.default_rng(1)
    points = rng.uniform([0.3, 0.3], [7.8, 3.7], (200, 2))
    step = 1e-5
    for axis in range(2):
        delta = np.eye(2)[axis] * step
        slope = (free.signed_distance(points + delta) - free.signed_distance(points - delta)) / (2 * step)
        inside = np.abs((points - free.origin) / free.cell_m - 0.5) % 1  # not on a seam between cells
        ok = ((inside > 0.01) & (inside < 0.99)).all(1)
        np.testing.assert_allclose(free.gradient(points)[ok, axis], slope[ok], atol=1e-6)
    x, z = points[0]
    assert sample_sdf(free.sdf, free.origin, free.cell_m, x, z) == free.signed_distance(points[0])
    assert tuple(free.gradient(points[0])) == sdf_gradient(free.sdf, free.origin, free.cell_m, x, z)
    assert free.clearance(points[0]) == free.signed_distance(points[0]) - 0.25


def test_distance_keeps_falling_outside_the_grid(free):
    far = free.signed_distance([[-1.0, 2.0], [-2.0, 2.0], [-50.0, 2.0], [3.0, 90.0]])
    np.testing.assert_allclose(far, [-1, -2, -50, -86], atol=0.02)


def test_what_counts_as_an_obstacle(free):
    assert not free.is_navigable([5.9, 2.0])  # under the table
    assert free.is_navigable([7.4, 0.7])  # on the rug
    assert free.is_navigable([0.7, 3.4])  # where the movable thing stands
    assert free.is_navigable([4.06, 1.98])  # in the doorway, under the lintel
    assert not free.is_navigable([4.06, 0.7])  # in the wall
    assert not free.is_navigable([-1.0, 1.0])
    assert not free.is_navigable([np.nan, 1.0])
    assert len(free.polygon.geoms) == 1


def test_navigable_agrees_with_shapely_and_with_the_distance(free):
    points = np.random.default_rng(2).uniform([-0.5, -0.5], [8.6, 4.5], (4000, 2))
    mine = free.is_navigable(points)
    clear = np.abs(shapely.distance(free.polygon.boundary, shapely.points(points))) > 2e-4
    np.testing.assert_array_equal(mine[clear], shapely.contains_xy(free.polygon, *points[clear].T))
    clearance = free.clearance(points)
    assert (
        clearance[mine] > -0.02
    ).all()  # in concave corners the bilinear look-up cuts the ridge (research 1.3: 20 mm)
    assert np.percentile(clearance[mine], 1) > -0.006
    assert (clearance[~mine] < 0.006).all()


def test_snap_goes_to_the_nearest_free_point(free):
    points = np.random.default_rng(3).uniform([-1, -1], [9, 5], (300, 2))
    snapped = free.snap(points)
    assert free.is_navigable(snapped).all()
    expected = shapely.distance(free.polygon, shapely.points(points))
    np.testing.assert_allclose(np.linalg.norm(snapped - points, axis=1), expected, atol=2e-4)
    np.testing.assert_array_equal(snapped[free.is_navigable(points)], points[free.is_navigable(points)])
    near = free.snap(points, max_distance_m=0.2)
    np.testing.assert_array_equal(np.isnan(near[:, 0]), expected > 0.2)


def test_samples_are_uniform_and_reproducible(free):
    points = free.sample(np.random.default_rng(4), 20000)
    np.testing.assert_array_equal(points, free.sample(np.random.default_rng(4), 20000))
    assert free.is_navigable(points).all()
    for part in (box(0, 0, 2, 2), box(4.12, 0, 8.12, 1), box(3.8, 1, 4.4, 3)):
        share = free.polygon.intersection(part).area / free.polygon.area
        found = shapely.contains_xy(part, *points.T).mean()
        assert abs(found - share) < 5 * np.sqrt(share / len(points))
    with pytest.raises(InputError, match=r"(?s)1.*0.*H3-SCENE-016"):
        free.sample(np.random.default_rng(0), 1, island=1)


def test_every_visibility_edge_stays_inside(free):
    """Research's lesson: edges along walls slip through crossing tests. All edges that the tables use, by shapely."""
    graph = free.graph
    pairs, lengths = visibility_edges(graph)
    assert len(pairs) >= len(graph.nodes)
    assert edges_inside(free.polygon, graph.nodes[pairs[:, 0]], graph.nodes[pairs[:, 1]]).all()
    i, j = np.nonzero(graph.previous == np.arange(len(graph.nodes))[:, None])  # reached straight: a subset of them
    assert edges_inside(free.polygon, graph.nodes[i], graph.nodes[j]).all()
    np.testing.assert_allclose(graph.distance[i, j], np.linalg.norm(graph.nodes[i] - graph.nodes[j], axis=1), rtol=1e-6)
    assert (graph.distance[pairs[:, 0], pairs[:, 1]] <= lengths + 1e-6).all()


def test_the_edge_check_can_fail(free):
    assert not edges_inside(free.polygon, np.array([[0.5, 0.5]]), np.array([[7.5, 0.5]])).any()  # through the wall


def _dijkstra(free: FreeSpace, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Slow and plain: complete visibility graph by shapely over all corners, then textbook Dijkstra."""
    room = free.polygon.buffer(1e-6)
    shapely.prepare(room)
    nodes = np.concatenate([start[None], ends, shapely.get_coordinates(free.polygon)])
    i, j = np.triu_indices(len(nodes), 1)
    seen = shapely.covers(room, shapely.linestrings(np.stack([nodes[i], nodes[j]], 1)))
    edges: dict[int, list[tuple[float, int]]] = {k: [] for k in range(len(nodes))}
    for p, q in zip(i[seen], j[seen], strict=True):
        d = float(np.linalg.norm(nodes[p] - nodes[q]))
        edges[p].append((d, q))
        edges[q].append((d, p))
    best = np.full(len(nodes), np.inf)
    best[0] = 0
    queue = [(0.0, 0)]
    while queue:
        d, p = heapq.heappop(queue)
        if d > best[p]:
            continue
        for length, q in edges[p]:
            if d + length < best[q]:
                best[q] = d + length
                heapq.heappush(queue, (best[q], q))
    return best[1 : 1 + len(ends)]


def test_geodesic_equals_the_plain_search(free):
    points = free.sample(np.random.default_rng(5), 24)
    expected = _dijkstra(free, points[0], points[1:])
    found = free.geodesic(points[0], points[1:])
    np.testing.assert_allclose(found, expected, atol=5e-4)  # the plain one may not cut the 0.1 mm
    assert (expected > np.linalg.norm(points[1:] - points[0], axis=1) + 0.05).sum() > 5  # some go round corners


def test_geodesic_is_a_metric(free):
    a, b, c = free.sample(np.random.default_rng(6), 900).reshape(3, 300, 2)
    ab, bc, ac = free.geodesic(a, b), free.geodesic(b, c), free.geodesic(a, c)
    np.testing.assert_allclose(ab, free.geodesic(b, a), atol=1e-6)
    assert (ac <= ab + bc + 1e-6).all()
    assert (ab >= np.linalg.norm(a - b, axis=1) - 1e-9).all()
    np.testing.assert_array_equal(free.geodesic(a, a), 0)
    assert free.geodesic(a[:5, None], b[None, :7]).shape == (5, 7)


def test_paths_are_taut_and_free(free):
    a, b = free.sample(np.random.default_rng(7), 160).reshape(2, 80, 2)
    for p, q in zip(a, b, strict=True):
        path = free.path(p, q)
        np.testing.assert_array_equal(path[[0, -1]], [p, q])
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert steps.sum() == pytest.approx(float(free.geodesic(p, q)), abs=1e-5)
        assert edges_inside(free.polygon, path[:-1], path[1:]).all()
        np.testing.assert_array_equal(free.next_waypoint(p, q), path[1])
        length, waypoint = free.first_leg(p, q, beyond_m=0.4)
        far = path[1:][np.linalg.norm(path[1:] - path[0], axis=1) > 0.4]
        assert length == float(free.geodesic(p, q))
        np.testing.assert_array_equal(waypoint, far[0] if len(far) else path[-1])
        # whoever walks to a waypoint finds the rest of the same path from there
        assert float(free.geodesic(path[1], q)) == pytest.approx(steps[1:].sum(), abs=1e-5)


def test_next_waypoint_passes_over_near_ones(free):
    path = free.path([3.0, 0.5], [5.0, 0.5])
    assert len(path) > 4
    ahead = free.next_waypoint([3.0, 0.5], [5.0, 0.5], beyond_m=1.3)
    assert np.linalg.norm(ahead - path[0]) > 1.3
    assert (np.abs(path - ahead).sum(1) == 0).any()
    np.testing.assert_array_equal(free.next_waypoint([3.0, 0.5], [3.1, 0.5], beyond_m=5.0), [3.1, 0.5])


def test_ends_off_the_floor_are_snapped_or_refused(free):
    assert free.geodesic([0.1, 2.0], [1.0, 3.5]) == pytest.approx(
        float(free.geodesic([0.25, 2.0], [1.0, 3.5])), abs=3e-4
    )
    assert free.geodesic([-3.0, 2.0], [1.0, 3.5]) == np.inf
    assert len(free.path([-3.0, 2.0], [1.0, 3.5])) == 0
    assert np.isnan(free.next_waypoint([-3.0, 2.0], [1.0, 3.5])).all()
    assert free.geodesic([np.nan, 2.0], [1.0, 3.5]) == np.inf


def test_lattice_distances_are_near_the_exact_ones(free):
    a, b = free.sample(np.random.default_rng(8), 600).reshape(2, 300, 2)
    exact, fast = free.geodesic(a, b), free.geodesic_lattice(a, b)
    far = exact > 1
    error = (fast - exact)[far] / exact[far]
    assert np.median(np.abs(error)) < 0.003
    assert np.percentile(np.abs(error), 95) < 0.02
    assert error.min() > -0.002  # only the slack of the line of sight can make it shorter
    np.testing.assert_allclose(free.geodesic_lattice(b, a), fast, rtol=1e-5)


def test_line_of_sight_agrees_with_shapely(free):
    a, b = free.sample(np.random.default_rng(9), 1000).reshape(2, 500, 2)
    grid = np.array(
        [line_of_sight(free.sdf, free.origin, free.cell_m, 0.25, *p, *q) for p, q in zip(a, b, strict=True)]
    )
    lines = shapely.linestrings(np.stack([a, b], 1))
    strict = shapely.covers(free.polygon.buffer(-0.012), lines)
    loose = shapely.covers(free.polygon.buffer(0.012), lines)
    assert grid[strict].all()
    assert not grid[~loose].any()
    assert strict.sum() > 50
    assert (~loose).sum() > 50


def test_islands_are_kept_apart():
    space = FreeSpace.from_map(build_from_walkable(MultiPolygon([box(0, 0, 3, 3), box(5, 0, 7, 2)]), **SIZES))
    assert [len(space.polygon.geoms), *np.round(space.island_areas, 6)] == [2, 6.25, 2.25]
    np.testing.assert_array_equal(space.island([[1, 1], [6, 1], [4, 1]]), [0, 1, -1])
    assert space.geodesic([1, 1], [6, 1]) == np.inf
    assert space.geodesic_lattice([1, 1], [6, 1]) == np.inf
    assert len(space.path([1, 1], [6, 1])) == 0
    assert (space.island(space.sample(np.random.default_rng(0), 50, island=1)) == 1).all()


def test_a_path_around_a_corner_has_the_analytic_length():
    """Round one corner of an L-shaped floor: two tangents and an arc of the agent's radius."""
    floor = box(0, 0, 6, 6).difference(box(2, 2, 6, 6))
    space = FreeSpace.from_map(build_from_walkable(floor, **SIZES))
    a, b, corner, r = np.array([1.0, 5.0]), np.array([5.0, 1.0]), np.array([2.0, 2.0]), 0.25
    leg = np.sqrt(np.sum((a - corner) ** 2) - r**2)
    between = np.arccos(np.dot(a - corner, b - corner) / (np.linalg.norm(a - corner) * np.linalg.norm(b - corner)))
    arc = 2 * np.pi - between - 2 * np.arccos(r / np.linalg.norm(a - corner))
    arc = arc if arc < np.pi else between - 2 * np.arccos(r / np.linalg.norm(a - corner))
    assert space.geodesic(a, b) == pytest.approx(2 * leg + r * arc, abs=2e-3)


@given(st.integers(0, 10**6))
def test_random_boxes_keep_the_laws(seed):
    rng = np.random.default_rng(seed)
    boxes = [
        shapely.affinity.rotate(box(x, z, x + w, z + d), t)
        for x, z, w, d, t in rng.uniform([0.5, 0.5, 0.1, 0.1, 0], [5, 5, 1.5, 1.5, 90], (6, 5))
    ]
    aligned = [box(*np.round(b.bounds, 1)) for b in boxes[:3]]  # shared coordinates: collinear edges, touching corners
    aligned = [b for b in aligned if b.area > 0]
    space = FreeSpace.from_map(
        build_from_walkable(box(0, 0, 6, 6).difference(shapely.union_all(boxes[3:] + aligned)), **SIZES)
    )
    points = space.sample(rng, 20)
    a, b = points[:10], points[10:]
    length = space.geodesic(a, b)
    assert np.isfinite(length).all()  # one island: always a way
    assert (length >= np.linalg.norm(a - b, axis=1) - 1e-9).all()
    for p, q, d in zip(a, b, length, strict=True):
        path = space.path(p, q)
        assert edges_inside(space.polygon, path[:-1], path[1:]).all()
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(d, abs=1e-5)


@pytest.mark.parametrize(
    ("shape", "scale", "expected"),
    [
        (Box(pose=IDENTITY, half_extents=np.array([0.5, 1.0, 0.25])), (1, 1, 1), box(-0.5, -0.25, 0.5, 0.25)),
        (Box(pose=IDENTITY, half_extents=np.array([0.5, 1.0, 0.25])), (2, 1, -2), box(-1, -0.5, 1, 0.5)),
        (Cylinder(pose=IDENTITY, radius=0.5, half_height=1.0), (1, 1, 1), Point(0, 0).buffer(0.5, quad_segs=64)),
        (
            Capsule(start=np.array([-0.5, 0.5, 0]), end=np.array([0.5, 0.5, 0]), radius=0.2),
            (1, 1, 1),
            shapely.LineString([(-0.5, 0), (0.5, 0)]).buffer(0.2, quad_segs=64),
        ),
        (
            Hull(points=np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 3.0, 0]])),  # cut by the band at 0.2 m
            (1, 1, 1),
            shapely.Polygon([(0, 0), (1 - 0.2 / 3, 0), (0, 1 - 0.2 / 3)]),
        ),
    ],
)
def test_footprints_of_shapes(shape, scale, expected):
    space = FreeSpace.from_scene(shape_scene(shape, scale=scale), cache=False)
    obstacle = box(-3.9, -3.9, 3.9, 3.9).difference(space.polygon.buffer(space.radius_m, quad_segs=32))
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (400, 2))
    distance = shapely.distance(expected, shapely.points(points))
    outside = distance > 0.02
    np.testing.assert_allclose(space.signed_distance(points[outside]), distance[outside], atol=0.02)
    assert (space.signed_distance(points[distance == 0]) < 0.02).all()
    assert obstacle.area >= expected.area * 0.97


def test_things_outside_the_band_are_no_obstacles():
    for low, high in ((0.0, 0.19), (1.42, 2.0), (-2.0, -0.1)):
        shape = Box(
            pose=np.array([0, (low + high) / 2, 0, 0, 0, 0, 1.0]), half_extents=np.array([1, (high - low) / 2, 1])
        )
        assert FreeSpace.from_scene(shape_scene(shape), cache=False).is_navigable([0.0, 0.0])


def test_bad_scenes_and_sizes_are_refused(two_rooms):
    empty = Scene(name="empty", assets={}, instances=())
    with pytest.raises(SceneError, match="H3-SCENE-015"):
        FreeSpace.from_scene(empty, cache=False)
    with pytest.raises(SceneError, match="H3-SCENE-009"):
        FreeSpace.from_scene(empty, method="shapes", cache=False)
    with pytest.raises(SceneError, match=r"(?s)\[0\.0\].*H3-SCENE-005"):
        FreeSpace.from_scene(two_rooms, floor_y=3.0, method="shapes", cache=False)
    with pytest.raises(SceneError, match="H3-SCENE-012"):
        FreeSpace.from_scene(two_rooms, radius_m=3.0, cache=False)
    for sizes in ({"radius_m": -1.0}, {"cell_m": np.nan}, {"max_climb_m": 2.0}):
        with pytest.raises(InputError, match="H3-SCENE-010"):
            FreeSpace.from_scene(two_rooms, cache=False, **sizes)
    with pytest.raises(InputError, match=r"(?s)\[3\].*H3-SCENE-006"):
        FreeSpace.from_scene(two_rooms, cache=False).geodesic([1, 2, 3], [1, 2, 3])


# --- from meshes --------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def tall_home(two_rooms: Scene) -> tuple[FreeSpace, FreeSpace]:
    """The same home, exact and from its triangles: a floor slab, outer walls, a roof (the largest surface of all)."""
    inner = [
        solid(4.0, 0.0, 0.0, 4.12, 2.6, 1.5),
        solid(4.0, 0.0, 2.45, 4.12, 2.6, 4.0),
        solid(1.2, 0.0, 1.0, 2.0, 0.8, 2.8, heading=0.5),
        solid(6.0, 0.0, 1.0, 7.0, 1.8, 3.0, heading=-0.3),
        solid(2.8, 0.0, 0.4, 3.4, 0.12, 1.0),  # a step
    ]
    shell = [
        solid(-0.12, 0, -0.12, 0, 2.6, 4.12),
        solid(8.12, 0, -0.12, 8.24, 2.6, 4.12),
        solid(-0.12, 0, -0.12, 8.24, 2.6, 0.0),
        solid(-0.12, 0, 4.0, 8.24, 2.6, 4.12),
        solid(-0.12, -0.1, -0.12, 8.24, 0.0, 4.12),
        solid(-0.5, 2.6, -0.5, 8.6, 2.7, 4.5),
    ]
    scene = scene_of(*inner, *shell, rooms=[(0, 0, 4, 4), (4.12, 0, 8.12, 4)])
    return FreeSpace.from_scene(scene, cache=False), FreeSpace.from_scene(scene, method="mesh", cache=False)


def test_voxels_find_the_same_floor(tall_home):
    exact, voxels = tall_home
    assert voxels.floor_y == pytest.approx(0.0, abs=1e-6)
    (home,) = voxels.polygon.geoms  # the floor inside a hollow box of 1 x 2 x 1.8 m is smaller than a place
    assert home.area == pytest.approx(exact.polygon.area, rel=0.01)
    assert home.symmetric_difference(exact.polygon).area < 0.02 * exact.polygon.area
    points = exact.sample(np.random.default_rng(1), 500)
    np.testing.assert_allclose(voxels.signed_distance(points), exact.signed_distance(points), atol=0.025)
    assert voxels.is_navigable([3.1, 0.7])  # on the step


def test_voxel_geodesics_are_near_the_exact_ones(tall_home):
    exact, voxels = tall_home
    a, b = exact.sample(np.random.default_rng(2), 1000).reshape(2, 500, 2)
    d = exact.geodesic(a, b)
    far = d > 1
    error = np.abs(voxels.geodesic(a, b) - d)[far] / d[far]
    assert np.median(error) < 0.003
    assert error.max() < 0.02


@pytest.mark.parametrize("far", [1e7, 3e38])
def test_a_scene_too_large_for_voxels_is_refused(far):
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 0, far]], np.float32)
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1]], np.int32), colors=np.zeros((3, 3), np.uint8))
    tower = replace(mesh, vertices=corners[:, [0, 2, 1]])
    with pytest.raises(SceneError, match="H3-SCENE-013"):
        FreeSpace.from_scene(
            scene_of((mesh, (), IDENTITY, "static"), (tower, (), IDENTITY, "static")), method="mesh", cache=False
        )


def test_a_sheet_without_thickness_still_blocks():
    """A wall of one voxel must survive the half voxel that walls are thinned by."""
    sheet = np.array([[2, 0, 0], [2, 2, 0], [2, 2, 3], [2, 0, 3]], np.float32)
    mesh = Mesh(vertices=sheet, faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32), colors=np.zeros((4, 3), np.uint8))
    wall = (mesh, (), IDENTITY, "static")
    slanted = (mesh, (), np.concatenate([[1.2, 0, -0.4], quat_from_heading(0.31)]), "static")
    floor = solid(0, -0.1, 0, 6, 0, 4)
    space = FreeSpace.from_scene(scene_of(wall, floor), method="mesh", cache=False)
    assert space.geodesic([1, 1], [3, 1]) > 4.5  # around its end at z = 3
    assert space.signed_distance([2.0, 1.5]) < 0.05
    tilted = FreeSpace.from_scene(scene_of(slanted, floor), method="mesh", cache=False)
    middle = np.array([1.2, -0.4]) + np.array(
        [2 * np.cos(0.31) + 1.5 * np.sin(0.31), -2 * np.sin(0.31) + 1.5 * np.cos(0.31)]
    )
    assert abs(float(tilted.signed_distance(middle))) < 0.05
    assert not tilted.is_navigable(middle)


def test_paths_from_the_very_border_are_not_detours() -> None:
    """A point a hair outside a wall (rounding) still finds the corners along it: paths as from just inside."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=3)), cache=False)
    island = free.polygon.geoms[0]
    inner = island.buffer(-5e-4)
    rng = np.random.default_rng(0)
    points, inside = [], []
    for ring in (island.exterior, *island.interiors):
        for at in rng.uniform(0, ring.length, 120):
            point, ahead = (np.array(ring.interpolate(d).coords[0]) for d in (at, at + 1e-4))
            along = (ahead - point) / np.linalg.norm(ahead - point)
            for out_m in (-8e-5, -1e-6, -1e-8, 0.0, 1e-8):
                points.append(point + np.array([-along[1], along[0]]) * out_m)
                inside.append(nearest_points(inner, shapely.Point(points[-1]))[0].coords[0])
    goals = np.resize(free.sample(rng, 300), (len(points), 2))
    np.testing.assert_allclose(free.geodesic(points, goals), free.geodesic(inside, goals), atol=5e-3)
