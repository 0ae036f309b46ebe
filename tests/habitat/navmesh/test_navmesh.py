"""Habitat's .navmesh files: real ones against the simulator's own triangles, round trips, damage, and the floor they make."""

from __future__ import annotations

import dataclasses
import itertools
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as runs
from hypothesis import strategies as st
from shapely.geometry import Polygon, box

from h3data.errors import FormatError, InputError, SceneError
from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable
from h3data_habitat.navmesh.file import read_navmesh, write_navmesh
from h3data_habitat.navmesh.navmesh import NavMesh, NavMeshSettings, free_space_from_navmesh, navmesh_from_free_space
from h3data_habitat.navmesh.pathfinder import PathFinder
from h3data_homes import HomeSpec, build_home
from tests.paths import REAL
from tests.random_cases import examples

ROOMS = ["simple_room_default", "simple_room_6chairs"]
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason=f"no real Habitat files in {REAL}")


def room(name: str) -> Path:
    return REAL / "habitat-sim" / "reference" / "navmesh" / name


def mesh_of(polygons, *, heights=None, joined=None, **settings) -> NavMesh:
    """A navmesh of floor polygons (x, z); edges with equal ends are shared unless ``joined`` (pairs) leaves them out."""
    heights = heights or [[0.0] * len(p) for p in polygons]
    points = [(x, y, z) for p, h in zip(polygons, heights, strict=True) for (x, z), y in zip(p, h, strict=True)]
    vertices, corner = np.unique(np.array(points, np.float32), axis=0, return_inverse=True)
    corner = corner.reshape(-1)
    start = np.concatenate([[0], np.cumsum([len(p) for p in polygons])]).astype(np.int32)
    edges = {}
    for p in range(len(polygons)):
        c = corner[start[p] : start[p + 1]]
        edges |= {(int(a), int(b)): p for a, b in zip(c, np.roll(c, -1), strict=True)}
    neighbour = []
    for p in range(len(polygons)):
        c = corner[start[p] : start[p + 1]]
        for a, b in zip(c, np.roll(c, -1), strict=True):
            q = edges.get((int(b), int(a)), -1)
            neighbour.append(q if joined is None or (min(p, q), max(p, q)) in joined else -1)
    fans = [
        [(start[p], start[p] + i, start[p] + i + 1) for i in range(1, len(polygons[p]) - 1)]
        for p in range(len(polygons))
    ]
    flat = vertices[corner[np.array([t for f in fans for t in f])]]
    return NavMesh(
        settings=NavMeshSettings(**{"agent_radius": 0.25, **settings}),
        vertices=vertices,
        polygon_start=start,
        polygon_vertices=corner.astype(np.int32),
        polygon_neighbours=np.array(neighbour, np.int32),
        areas=np.zeros(len(polygons), np.uint8),
        flags=np.ones(len(polygons), np.uint16),
        detail_start=np.concatenate([[0], np.cumsum([len(f) for f in fans])]).astype(np.int32),
        detail_triangles=flat,
        bounds=np.stack([vertices.min(0), vertices.max(0)]),
    )


def rect(x0, z0, x1, z1):
    return [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]


def same(a: NavMesh, b: NavMesh) -> bool:
    names = [f.name for f in dataclasses.fields(NavMesh) if f.name != "settings"]
    return a.settings == b.settings and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_real_rooms_give_the_triangles_areas_and_settings_of_the_simulator(name):
    reference = json.loads((room(name) / "reference.json").read_text())
    navmesh = read_navmesh(room(name) / f"{name}.navmesh")
    indices = np.load(room(name) / "tri_indices.npy").reshape(-1, 3)
    assert np.array_equal(navmesh.triangles(), np.load(room(name) / "tri_vertices.npy")[indices])
    assert navmesh.area_m2 == pytest.approx(reference["navigable_area"], abs=1e-4)
    assert navmesh.island_areas == pytest.approx(reference["island_areas"], abs=1e-4)
    assert {k: getattr(navmesh.settings, k) for k in reference["settings"]} == reference["settings"]
    assert navmesh.bounds[:, [0, 2]] == pytest.approx(np.array(reference["bounds"])[:, [0, 2]])


@needs_real
def test_the_real_flat_gives_the_triangles_of_the_simulator():
    folder = REAL / "habitat-lab" / "reference" / "navmesh"
    navmesh = read_navmesh(folder / "flat.navmesh")
    triangles, said = np.load(folder / "navmesh_triangles.npz"), json.loads((folder / "flat.json").read_text())
    assert np.array_equal(navmesh.triangles(), triangles["vertices"][triangles["faces"]])
    assert navmesh.area_m2 == pytest.approx(said["navigable_area"], abs=1e-4)
    free = free_space_from_navmesh(navmesh)
    assert free.polygon.area == pytest.approx(said["navigable_area"], abs=1e-4)
    assert (free.floor_y, free.radius_m, free.height_m) == (pytest.approx(0.1), 0.25, 1.41)


@needs_real
@pytest.mark.parametrize("name", ROOMS)
def test_a_written_file_says_the_same_and_keeps_every_section_that_detour_does_not_rebuild(name, tmp_path):
    navmesh = read_navmesh(room(name) / f"{name}.navmesh")
    write_navmesh(navmesh, tmp_path / "a.navmesh")
    assert same(read_navmesh(tmp_path / "a.navmesh"), navmesh)
    ours, theirs = (tmp_path / "a.navmesh").read_bytes(), (room(name) / f"{name}.navmesh").read_bytes()
    assert ours[:100] == theirs[:100]  # header, settings, tile reference
    vertices = slice(204, 204 + navmesh.vertices.nbytes)
    assert ours[vertices] == theirs[vertices]
    rows, tree = 4 * len(navmesh.detail_triangles), 16 * struct.unpack_from("<i", theirs, TILE + 48)[0]
    assert ours[-rows:] == theirs[-rows - tree : -tree]  # indices and border bits of the detail triangles


polygons = st.lists(st.integers(1, 4), min_size=1, max_size=5)


@runs(max_examples=25, derandomize=True, deadline=None)
@given(widths=polygons, radius=st.floats(0.0, 1.0, width=32), y=st.floats(-3, 3, width=32))
def test_any_row_of_rectangles_survives_a_round_trip(widths, radius, y, tmp_path_factory):
    x = np.concatenate([[0], np.cumsum(widths)])
    row = [rect(a, 0, b, 1) for a, b in itertools.pairwise(x)]
    navmesh = mesh_of(row, heights=[[y] * 4] * len(row), agent_radius=radius)
    stored = {k: np.float32(v).item() for k, v in vars(navmesh.settings).items() if isinstance(v, float)}
    settings = dataclasses.replace(navmesh.settings, **stored)
    navmesh = dataclasses.replace(navmesh, settings=settings)
    path = tmp_path_factory.mktemp("row") / "a.navmesh"
    write_navmesh(navmesh, path)
    assert same(read_navmesh(path), navmesh)
    assert navmesh.island_areas == pytest.approx([sum(widths)])


def test_disabled_and_empty_polygons_are_no_floor():
    navmesh = mesh_of([rect(0, 0, 1, 1), rect(1, 0, 2, 1), rect(2, 0, 3, 1)])
    off = dataclasses.replace(navmesh, flags=np.array([1, 5, 1], np.uint16))
    assert off.islands.tolist() == [0, -1, 1]
    assert off.area_m2 == pytest.approx(2.0)
    flat = mesh_of([rect(0, 0, 1, 1), [(1, 0), (1, 1), (1, 0.5)]])
    assert flat.enabled.tolist() == [True, False]
    none = dataclasses.replace(navmesh, flags=np.full(3, 4, np.uint16))
    with pytest.raises(SceneError, match="H3-HABITAT-083"):
        free_space_from_navmesh(none)
    with pytest.raises(InputError, match=r"(?s)3.*H3-HABITAT-086"):
        navmesh.triangles(island=3)


# --- the floor -----------------------------------------------------------------------------------------------------------
def test_the_floor_is_the_union_and_its_distances_are_the_radius_more_than_to_its_border():
    free = free_space_from_navmesh(mesh_of([rect(0, 0, 4, 2), rect(0, 2, 1, 4)], joined=set()), island=0)
    assert free.polygon.equals(box(0, 0, 4, 2))
    points = np.array([[2.0, 0.8], [2.0, 0.3], [0.2, 1.0], [2.0, -0.1]])
    assert free.signed_distance(points) == pytest.approx([1.05, 0.55, 0.45, 0.15], abs=0.02)
    assert free.is_navigable(points).tolist() == (free.signed_distance(points) >= 0.25).tolist()


def test_walls_without_thickness_stay_walls():
    # two rooms side by side, whose common edge is a wall, joined by a corridor below
    parts = [rect(0, 0, 2, 2), rect(2, 0, 4, 2), rect(0, -1, 2, 0), rect(2, -1, 4, 0)]
    joined = {(0, 2), (2, 3), (1, 3)}
    free = free_space_from_navmesh(mesh_of(parts, joined=joined))
    assert free.polygon.area == pytest.approx(12.0, abs=2e-3)
    a, b = np.array([1.0, 1.0]), np.array([3.0, 1.0])
    assert free.geodesic(a, b) == pytest.approx(2 * np.hypot(1, 1), abs=1e-3)
    open_wall = free_space_from_navmesh(mesh_of(parts))
    assert open_wall.geodesic(a, b) == pytest.approx(2.0)


def test_islands_that_touch_stay_apart():
    free = free_space_from_navmesh(mesh_of([rect(0, 0, 2, 2), rect(2, 0, 3, 2)], joined=set()))
    assert free.island_areas == pytest.approx([4.0, 2.0], abs=2e-3)
    assert np.isinf(free.geodesic(np.array([1.0, 1.0]), np.array([2.5, 1.0])))


def test_other_storeys_are_left_out_and_floors_above_themselves_are_refused():
    two = mesh_of([rect(0, 0, 2, 2), rect(0, 0, 1, 1)], heights=[[0] * 4, [2.5] * 4])
    assert free_space_from_navmesh(two).polygon.area == pytest.approx(4.0)
    assert free_space_from_navmesh(two, island=1).floor_y == pytest.approx(2.5)
    parts = [rect(0, 0, 2, 2), rect(2, 0, 5, 2), [(5, 0), (5, 2), (0, 2), (0, 0)]]
    ramp = mesh_of(parts, heights=[[0] * 4, [0, 3, 3, 0], [3] * 4])
    assert len(ramp.island_areas) == 2  # the third polygon runs the other way round: no shared edge
    parts[2] = [(0, 0), (5, 0), (5, 2), (0, 2)]
    joined = mesh_of([parts[0], parts[1], [(5, 0), (0, 0), (0, 2), (5, 2)]], heights=[[0] * 4, [0, 3, 3, 0], [3] * 4])
    assert len(joined.island_areas) == 1
    with pytest.raises(SceneError, match="H3-HABITAT-085"):
        free_space_from_navmesh(joined)


def test_a_free_space_becomes_triangles_of_the_same_area_and_back():
    area = box(0, 0, 6, 4).difference(box(2, 1, 3, 2)).union(box(7, 0, 8.5, 1.5)).difference(box(4, 3, 4.5, 4))
    free = FreeSpace.from_map(
        build_from_walkable(area, radius_m=0.2, height_m=1.4, max_climb_m=0.2, cell_m=0.05, floor_y=0.5)
    )
    navmesh = navmesh_from_free_space(free, merge=False)
    assert navmesh.island_areas == pytest.approx(free.island_areas, rel=1e-5)
    again = free_space_from_navmesh(navmesh)
    assert again.polygon.symmetric_difference(free.polygon).area < 1e-4
    rng = np.random.default_rng(0)
    a, b = free.sample(rng, 50), free.sample(rng, 50)
    assert again.geodesic(a, b) == pytest.approx(free.geodesic(a, b), abs=1e-3)


@pytest.mark.slow
def test_a_large_home_has_few_convex_polygons(tmp_path):
    """habitat-sim's findPath gives up after 256 polygons on a path, and its search after 2,048 nodes."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="large", seed=0)))
    navmesh = navmesh_from_free_space(free)
    assert len(navmesh_from_free_space(free, merge=False).flags) > 4000
    assert len(navmesh.flags) <= 600
    assert np.diff(navmesh.polygon_start).max() <= 6
    assert navmesh.area_m2 == pytest.approx(free.polygon.area, rel=0.01)
    for p in range(len(navmesh.flags)):
        corners = navmesh.corners(p)[:, [0, 2]].astype(float)
        sides = np.roll(corners, -1, axis=0) - corners
        after = np.roll(sides, -1, axis=0)
        turns = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
        assert (turns > -1e-6).all() or (turns < 1e-6).all(), f"polygon {p} is not convex"
    write_navmesh(navmesh, tmp_path / "a.navmesh")
    again = read_navmesh(tmp_path / "a.navmesh")  # checks that neighbours share their edges
    assert (again.polygon_vertices == navmesh.polygon_vertices).all()
    finder, rng = PathFinder(again), np.random.default_rng(0)
    starts, ends = free.sample(rng, 200), free.sample(rng, 200)
    exact = free.geodesic(starts, ends)
    lift = lambda p: [p[0], free.floor_y, p[1]]  # noqa: E731
    found = np.array([finder.geodesic_distance(lift(a), lift(b)) for a, b in zip(starts, ends, strict=True)])
    assert np.abs(found - exact).max() < 0.1
    assert _longest_chain(again) < 256


def _longest_chain(navmesh: NavMesh) -> int:
    """Most polygons between any two, by the fewest steps."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import shortest_path

    owner = np.repeat(np.arange(len(navmesh.flags)), np.diff(navmesh.polygon_start))
    inner = navmesh.polygon_neighbours >= 0
    steps = csr_matrix(
        (np.ones(inner.sum()), (owner[inner], navmesh.polygon_neighbours[inner])), shape=2 * [len(navmesh.flags)]
    )
    hops = shortest_path(steps, unweighted=True)
    return int(hops[np.isfinite(hops)].max()) + 1


# --- damage --------------------------------------------------------------------------------------------------------------
@pytest.fixture
def good(tmp_path) -> bytes:
    write_navmesh(mesh_of([rect(0, 0, 1, 1), rect(1, 0, 2, 1)]), tmp_path / "good.navmesh")
    return (tmp_path / "good.navmesh").read_bytes()


def refused(data: bytes, tmp_path: Path, match: str) -> None:
    (tmp_path / "bad.navmesh").write_bytes(data)
    with pytest.raises(FormatError, match=rf"(?s)({match}).*H3-HABITAT-088"):
        read_navmesh(tmp_path / "bad.navmesh")


def put(data: bytes, offset: int, kind: str, value) -> bytes:
    return data[:offset] + struct.pack("<" + kind, value) + data[offset + struct.calcsize(kind) :]


TILE = 104
POLYGONS = TILE + 100 + 6 * 12


def test_every_truncation_is_refused(good, tmp_path):
    for size in range(len(good)):
        refused(good[:size], tmp_path, r"\(at byte \d+\)")


@pytest.mark.parametrize(
    ("offset", "kind", "value", "match"),
    [
        (0, "i", 0x12345678, "magic number 0x4D534554.*at byte 0"),
        (4, "i", 3, "version 1 or 2, got 3.*at byte 4"),
        (8, "i", 1_000_000_000, "one tile.*at byte 8"),
        (8, "i", 0, "one tile"),
        (40 + 12, "f", float("nan"), "finite settings.*at byte 40"),
        (100, "i", 2_000_000_000, "claims 2000000000 bytes.*at byte 100"),
        (100, "i", -5, "claims -5 bytes"),
        (100, "i", 120, "more than its size says"),
        (TILE, "i", 1, "Detour tile.*at byte 104"),
        (TILE + 4, "i", 8, "version 8"),
        (TILE + 24, "i", 1_000_000_000, "1000000000 polygons|detail"),
        (TILE + 24, "i", 0, "detail meshes for 0 polygons"),
        (TILE + 28, "i", 1_000_000_000, "vertices"),
        (TILE + 28, "i", -1, "vertices"),
        (TILE + 32, "i", 1_000_000_000, "links"),
        (TILE + 36, "i", 1, "detail mesh for each"),
        (TILE + 40, "i", 1_000_000_000, "detail vertices"),
        (TILE + 44, "i", 1_000_000_000, "detail triangle indices"),
        (TILE + 48, "i", 1_000_000_000, "tree nodes"),
        (TILE + 52, "i", 1_000_000_000, "jump links"),
        (TILE + 72, "f", float("inf"), "bounds"),
        (TILE + 72, "f", 1e5, "lower to the upper corner"),
        (TILE + 100 + 16, "f", float("nan"), "of vertices 1 .at byte 216"),
        (TILE + 100, "f", 1e30, "coordinates below"),
        (POLYGONS + 4, "H", 6, "Polygon 0 names a vertex beyond the 6.*at byte 276"),
        (POLYGONS + 32 + 16, "H", 3, "Polygon 1 names a neighbour"),
        (POLYGONS + 16, "H", 2, "does not share the edge"),
        (POLYGONS + 30, "B", 2, "3 to 6 corners"),
        (POLYGONS + 30, "B", 7, "3 to 6 corners"),
    ],
)
def test_every_kind_of_damage_is_refused_with_field_and_offset(good, tmp_path, offset, kind, value, match):
    refused(put(good, offset, kind, value), tmp_path, match)


def test_details_beyond_what_there_is_are_refused(good, tmp_path):
    details = POLYGONS + 2 * 32 + 2 * 12
    refused(put(good, details + 4, "I", 4_000_000_000), tmp_path, f"Detail mesh 0 .*at byte {details}")
    refused(put(good, details + 12 + 9, "B", 200), tmp_path, "Detail mesh 1")
    refused(put(good, details + 24, "B", 77), tmp_path, f"Detail triangle 0 .*at byte {details + 24}")


def test_big_endian_files_are_named_as_such(good, tmp_path):
    refused(good[3::-1] + good[4:], tmp_path, "big-endian")
    with pytest.raises(InputError, match="H3-HABITAT-091"):
        read_navmesh(tmp_path / "missing.navmesh")


@runs(max_examples=examples(150), derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), min_size=1, max_size=4))
def test_random_damage_gives_a_navmesh_or_a_format_error(changes):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.navmesh"
        write_navmesh(mesh_of([rect(0, 0, 1, 1), rect(1, 0, 2, 1)]), path)
        data = bytearray(path.read_bytes())
        for offset, value in changes:
            data[offset % len(data)] = value
        path.write_bytes(bytes(data))
        try:
            navmesh = read_navmesh(path)
        except FormatError:
            return
        assert len(navmesh.islands) == 2
        assert np.isfinite(navmesh.area_m2)


def test_polygons_that_cross_themselves_are_damage():
    """What reading cannot tell at once, but no union of polygons survives."""
    navmesh = mesh_of([[(0, 0), (4, 0), (0, 4), (4, 4)], [(1, 1), (3, 1), (3, 3), (1, 3)]])
    with pytest.raises(SceneError, match=r"(?s)1.*2.*H3-HABITAT-087"):
        free_space_from_navmesh(navmesh)


def test_version_1_takes_the_agent_from_the_tile(good, tmp_path):
    (tmp_path / "old.navmesh").write_bytes(put(good[:40] + good[96:], 4, "i", 1))
    navmesh = read_navmesh(tmp_path / "old.navmesh")
    assert navmesh.settings.agent_radius == pytest.approx(0.25)
    assert navmesh.area_m2 == pytest.approx(2.0)


@pytest.mark.slow
def test_too_large_a_mesh_or_grid_is_refused(tmp_path):
    wide = mesh_of([rect(0, 0, 5000, 5000)])
    with pytest.raises(InputError, match=r"(?s)cell_m.*H3-HABITAT-084"):
        free_space_from_navmesh(wide)
    many = mesh_of([rect(k, 0, k + 1, 1) for k in range(33000)])
    with pytest.raises(InputError, match=r"(?s)32766.*H3-HABITAT-089"):
        write_navmesh(many, tmp_path / "a.navmesh")


def test_outline_of_polygons_is_what_shapely_says():
    parts = [[(0, 0), (3, 0), (3, 1), (1, 2)], [(3, 1), (4, 3), (1, 2)]]
    free = free_space_from_navmesh(mesh_of(parts))
    assert free.polygon.symmetric_difference(Polygon(parts[0]).union(Polygon(parts[1]))).area < 1e-6
