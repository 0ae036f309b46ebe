"""The height of the floor where stairs join storeys: ramps, treads and noses, and the free space on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError, H3DataError
from h3data.geometry import ground_pose, heading_from_quat, quat_rotate
from h3data.scene import FreeSpace, Ramp, Room, Scene, load_scene, save_scene, scene_digest
from h3data.scene.floor_heights import LEVEL, floor_heights, nose_heights, off_risers, room_heights
from h3data_habitat.navmesh.navmesh import navmesh_from_free_space
from h3data_habitat.navmesh.pathfinder import PathFinder
from h3data_homes import HomeSpec, build_home
from tests import storeys
from tests.scene.freespace.test_free_space import scene_of, solid

RISE = 0.17
SLOPE = 0.17 / 0.28
WIDE = 2.0
ROOMS = {"low": [0.0, 0.0, 4.0, WIDE], "stairs": [4.0, 0.0, 9.0, WIDE], "high": [9.0, 0.0, 13.0, WIDE]}
RAMP = Ramp(axis=0, start=5.0, end=8.0, top_y=2.0, steps=10)


def rooms(*, level: bool = False) -> tuple[Room, ...]:
    """Two rooms and stairs along x from 0 to 2 m, or the same on one level."""
    low, stairs, high = (Room(name=n, category=n, rectangles=np.array([r])) for n, r in ROOMS.items())
    return (low, stairs, high) if level else (low, replace(stairs, ramp=RAMP), replace(high, floor_y=2.0))


def scene(*things, level: bool = False) -> Scene:
    return replace(scene_of(*things), rooms=rooms(level=level))


def floor(*things, level: bool = False) -> FreeSpace:
    return FreeSpace.from_scene(scene(*things, level=level), cache=False, method="shapes")


NOTHING = solid(-9, 0, -9, -8, 1, -8)
"""A box far away: a scene without shapes has no floor that is found by shapes."""


def test_level_homes_have_no_table_and_one_height() -> None:
    free = FreeSpace.from_scene(build_home(HomeSpec(seed=1)))
    assert free.heights.shape == LEVEL.shape
    assert not free.has_stairs
    assert free.without_stairs is free
    xz, heading = np.array([[1.0, 2.0], [3.0, 0.5]]), np.array([0.3, -2.0])
    assert (free.height_at(xz) == free.floor_y).all()
    assert free.root_pose(xz, heading).tobytes() == ground_pose(xz, heading, free.floor_y).tobytes()


def test_a_ramp_goes_through_the_middle_of_every_tread() -> None:
    heights = room_heights(rooms())
    along = RAMP.start + (np.arange(10) + 0.5) * 0.3 + 0.15  # from the middle of the first tread on
    at = np.column_stack([along, np.ones(10)])
    assert np.allclose(floor_heights(heights, 0.0, at), floor_heights(heights, 0.0, at, treads=True))
    assert np.allclose(np.diff(floor_heights(heights, 0.0, at)), 0.2)


@given(st.floats(-1, 14), st.floats(-1, 3))
def test_treads_are_near_the_ramp_and_below_the_noses(x: float, z: float) -> None:
    heights, at = room_heights(rooms()), np.array([x, z])
    ramp, tread = floor_heights(heights, 0.0, at), floor_heights(heights, 0.0, at, treads=True)
    assert abs(ramp - tread) <= 0.1 + 1e-9
    assert nose_heights(heights, 0.0, at) >= tread - 1e-12
    moved = off_risers(heights, at[None], gap_m=0.05)
    assert abs(moved[0, 0] - x) <= 0.05 + 1e-9
    assert np.isclose(floor_heights(heights, 0.0, moved[0], treads=True), tread)


@given(st.integers(0, 2**32 - 1))
def test_the_floor_is_continuous_wherever_one_may_be(seed: int) -> None:
    free, rng = storeys.floor(), np.random.default_rng(seed)
    a = free.sample(rng, 50)
    b = a + rng.uniform(-0.1, 0.1, a.shape)
    lines = shapely.linestrings(np.stack([a, b], axis=1))
    inside = shapely.covers(free.polygon, lines)
    step = np.abs(free.height_at(a) - free.height_at(b))
    assert (step[inside] <= SLOPE * np.linalg.norm(a - b, axis=1)[inside] + 1e-9).all()


def test_a_flight_is_free_floor_like_a_level_corridor() -> None:
    ramp, level = floor(NOTHING), floor(NOTHING, level=True)
    assert ramp.polygon.symmetric_difference(level.polygon).area < 1e-3
    a, b = np.array([1.0, 1.0]), np.array([12.0, 0.5])
    assert np.isclose(ramp.geodesic(a, b), level.geodesic(a, b))  # lengths are those in the plan
    inner = level.sdf > 0.05
    assert np.abs(ramp.sdf - level.sdf)[inner].max() < 1e-3


@pytest.mark.parametrize(("y", "blocks"), [(0.0, False), (2.0, True), (4.0, False)])
def test_things_count_on_their_own_storey(y: float, blocks: bool) -> None:
    box = solid(10.0, y, 0.5, 11.0, y + 1.0, 1.5)
    assert floor(NOTHING, box).is_navigable([10.5, 1.0]) != blocks


def test_things_on_stairs_count_by_their_height_over_the_treads() -> None:
    lamp = solid(6.0, 2.9, 0.0, 7.0, 3.1, WIDE)  # 1.5 to 2.3 m above the steps below it
    rail = solid(6.0, 1.5, 0.0, 7.0, 1.7, WIDE)
    assert floor(NOTHING, lamp).geodesic([1, 1], [12, 1]) < np.inf
    assert floor(NOTHING, rail).geodesic([1, 1], [12, 1]) == np.inf


def test_to_those_who_cannot_climb_stairs_are_walls() -> None:
    free = storeys.floor()
    without = free.without_stairs
    assert without.without_stairs is without
    assert len(without.polygon.geoms) >= 2
    x0, z0, x1, z1 = storeys.flight()
    grid = np.stack(np.meshgrid(np.linspace(x0 + 0.1, x1 - 0.1, 9), np.linspace(z0 + 0.1, z1 - 0.1, 40)), -1)
    assert (without.signed_distance(grid) < 0).all()
    assert not without.is_navigable(grid).any()
    low, high = storeys.ends()
    assert free.geodesic(low, high) < np.inf
    assert without.geodesic(low, high) == np.inf
    far = free.signed_distance(free.sample(np.random.default_rng(0), 300))
    near = without.signed_distance(free.sample(np.random.default_rng(0), 300))
    assert (near <= far + 1e-6).all()


def test_climbing_bases_pitch_with_the_floor_and_others_stay_upright() -> None:
    free = storeys.floor()
    low, high = storeys.ends()
    middle, way = (low + high) / 2, high - low
    heading = float(np.arctan2(-way[1], way[0]))
    upright, pitched = free.root_pose(middle, heading), free.root_pose(middle, heading, pitch_over_m=0.6)
    assert np.allclose(upright[:3], pitched[:3])
    assert np.isclose(heading_from_quat(pitched[3:]), heading)
    ahead = quat_rotate(pitched[3:], np.array([1.0, 0, 0]))
    assert np.isclose(ahead[1] / np.hypot(ahead[0], ahead[2]), SLOPE, atol=1e-6)
    assert np.isclose(
        quat_rotate(free.root_pose(middle, heading + np.pi, pitch_over_m=0.6)[3:], [1.0, 0, 0])[1], -ahead[1]
    )
    assert np.allclose(free.root_pose(low, heading, pitch_over_m=0.6)[3:], free.root_pose(low, heading)[3:])


def test_free_space_and_scene_keep_their_heights_in_files(tmp_path) -> None:
    free = storeys.floor()
    free.save(tmp_path / "floor.npz")
    assert FreeSpace.load(tmp_path / "floor.npz").heights.tobytes() == free.heights.tobytes()
    save_scene(storeys.home(), tmp_path / "home.glb")
    again = load_scene(tmp_path / "home.glb")
    assert scene_digest(again) == scene_digest(storeys.home())
    assert room_heights(again.rooms).tobytes() == free.heights.tobytes()


def test_a_damaged_ramp_or_table_is_refused(tmp_path) -> None:
    free = storeys.floor()
    broken = replace(FreeSpace.load(_saved(free, tmp_path)), heights=np.full((1, 10), np.nan))
    broken.save(tmp_path / "broken.npz")
    with pytest.raises(FormatError, match=r"(?s)heights.*H3-SCENE-020"):
        FreeSpace.load(tmp_path / "broken.npz")
    save_scene(scene(NOTHING), tmp_path / "stairs.glb")
    content = (tmp_path / "stairs.glb").read_bytes()
    assert content.count(b'"steps":10') == 1
    (tmp_path / "stairs.glb").write_bytes(content.replace(b'"steps":10', b'"steps":-1'))
    with pytest.raises(H3DataError, match=r"(?s)step.*H3-SCENE-053"):
        load_scene(tmp_path / "stairs.glb")


def _saved(free: FreeSpace, folder):
    free.save(folder / "whole.npz")
    return folder / "whole.npz"


def test_a_navmesh_follows_the_stairs() -> None:
    free = storeys.floor()
    for merge in (False, True):
        navmesh = navmesh_from_free_space(free, merge=merge)
        corners = navmesh.detail_triangles.reshape(-1, 3).astype(np.float64)
        assert np.allclose(corners[:, 1], free.height_at(corners[:, [0, 2]]), atol=1e-5)
        middles = navmesh.detail_triangles.reshape(-1, 3, 3).astype(np.float64).mean(1)
        assert np.allclose(middles[:, 1], free.height_at(middles[:, [0, 2]]), atol=2e-3)
    finder = PathFinder(free)
    low, high = (np.insert(p, 1, free.height_at(p)) for p in storeys.ends())
    length = finder.geodesic_distance(low, high)
    plan, rise = 16 * 0.28 + 1.4, 16 * RISE
    assert np.isclose(length, np.hypot(plan, rise), atol=0.02)  # one taut string, as Detour's
