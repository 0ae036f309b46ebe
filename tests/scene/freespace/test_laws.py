"""Laws of shortest paths, snapping and steps on any floor, cluttered at random."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as runs
from hypothesis import strategies as st

from h3data.scene.freespace._visibility_build import edges_inside
from h3data_habitat.navmesh.pathfinder import PathFinder
from tests.scene.freespace.test_distance_field import cluttered

seeds = st.integers(0, 10**6)


@given(seeds)
@runs(max_examples=15)
def test_geodesics_are_a_metric(seed):
    free = cluttered(seed)
    a, b, c = free.sample(np.random.default_rng(seed), 30).reshape(3, 10, 2)
    ab, bc, ac = free.geodesic(a, b), free.geodesic(b, c), free.geodesic(a, c)
    np.testing.assert_allclose(free.geodesic(b, a), ab, atol=1e-5)
    assert (ac <= ab + bc + 1e-5).all()
    assert (ab >= np.linalg.norm(a - b, axis=1) - 1e-9).all()
    np.testing.assert_array_equal(free.geodesic(a, a), 0)


@given(seeds)
@runs(max_examples=15)
def test_paths_are_as_long_as_they_say_and_stay_inside(seed):
    free = cluttered(seed)
    for p, q in free.sample(np.random.default_rng(seed), 20).reshape(10, 2, 2):
        path = free.path(p, q)
        np.testing.assert_array_equal(path[[0, -1]], [p, q])
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert length == pytest.approx(float(free.geodesic(p, q)), abs=1e-5)
        assert edges_inside(free.polygon, path[:-1], path[1:]).all()


@given(seeds)
@runs(max_examples=15)
def test_snapping_twice_is_snapping_once(seed):
    free = cluttered(seed)
    points = np.random.default_rng(seed).uniform(-2, 10, (40, 2))
    once = free.snap(points)
    assert free.is_navigable(once).all()
    np.testing.assert_array_equal(free.snap(once), once)
    inside = free.is_navigable(points)
    np.testing.assert_array_equal(once[inside], points[inside])
    other = free.sample(np.random.default_rng(seed), 40)  # no free point is nearer
    assert (np.linalg.norm(once - points, axis=1) <= np.linalg.norm(other - points, axis=1) + 1e-9).all()


@given(seeds, st.floats(0.02, 0.15))
@runs(max_examples=15)
def test_a_wider_agent_never_has_a_shorter_way(seed, more_m):
    """What is free for the wider disc is free for the narrower, so its paths are among the others'."""
    narrow, wide = cluttered(seed, radius_m=0.15), cluttered(seed, radius_m=0.15 + more_m)
    a, b = wide.sample(np.random.default_rng(seed), 40).reshape(2, 20, 2)
    assert narrow.is_navigable(a).all()
    assert (narrow.geodesic(a, b) <= wide.geodesic(a, b) + 1e-3).all()  # arcs of 8 chords differ by 1 mm
    assert narrow.island_areas.sum() >= wide.island_areas.sum()
    np.testing.assert_array_equal(narrow.sdf, wide.sdf)


@given(seeds)
@runs(max_examples=5)
def test_steps_stay_on_the_floor_and_on_their_island(seed):
    free = cluttered(seed)
    finder, rng = PathFinder(free), np.random.default_rng(seed)
    at = finder.get_random_navigable_point(rng)
    island = finder.get_island(at)
    for _ in range(30):
        target = at + rng.uniform(-0.5, 0.5, 3) * [1, 0, 1]
        to = finder.try_step(at, target) if rng.random() < 0.5 else finder.try_step_no_sliding(at, target)
        assert free.snap(to[::2]) == pytest.approx(to[::2], abs=1e-4)
        assert finder.get_island(to) == island
        assert np.linalg.norm(to - target) <= np.linalg.norm(at - target) + 1e-3  # never away from where it wants to
        at = to
