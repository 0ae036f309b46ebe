"""Doors between rooms: where leaves go, what they leave as it was, and the floor with them open and closed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene, load_scene, save_scene, scene_digest
from h3data.scene.articulation import joints_of, posed
from h3data.scene.passages import outlines, passable, passages
from h3data_homes import HomeSpec, build_home

SEEDS = (0, 1, 2, 4)


@pytest.fixture(scope="module", params=[0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in SEEDS if seed)])
def home(request: pytest.FixtureRequest) -> Scene:
    return build_home(HomeSpec(seed=request.param, generation=2, doors=True))


def leaves(home: Scene) -> list[int]:
    return [k for k, (_, part) in enumerate(joints_of(home).parts) if part.name == "leaf"]


@pytest.mark.slow
def test_rooms_furniture_and_things_are_those_of_the_home_without_doors(home: Scene) -> None:
    plain = build_home(HomeSpec(seed=int(home.source["seed"]), generation=2))
    kept = [i for i in home.instances if not i.name.startswith("door_")]
    assert [i.name for i in kept] == [i.name for i in plain.instances]
    for mine, other in zip(kept, plain.instances, strict=True):
        np.testing.assert_array_equal(mine.pose, other.pose)
    assert [r.rectangles.tolist() for r in home.rooms] == [r.rectangles.tolist() for r in plain.rooms]


def test_it_is_the_same_each_time_and_survives_its_file(home: Scene, tmp_path: Path) -> None:
    again = build_home(HomeSpec(seed=int(home.source["seed"]), generation=2, doors=True))
    assert scene_digest(again) == scene_digest(home)
    save_scene(home, tmp_path / "home.glb")
    assert scene_digest(load_scene(tmp_path / "home.glb")) == scene_digest(home)


def test_a_closed_door_is_a_wall_and_an_open_one_is_a_way(home: Scene) -> None:
    free, doors, joints = FreeSpace.from_scene(home), leaves(home), joints_of(home)
    assert list(passages(home, free)) == doors
    assert doors
    everything = joints.rest.copy()
    everything[doors] = joints.opened[doors]
    there = passable(home, free)
    np.testing.assert_array_equal(joints_of(there).rest, everything)
    whole = free.as_in(there)
    assert len(whole.polygon.geoms) == 1
    for k in doors:  # with this one closed there is another island, or a way round that is longer
        shut = everything.copy()
        shut[k] = joints.closed[k]
        floor = free.as_in(posed(home, shut))
        (outline,) = outlines(home, k, shut)
        assert not floor.polygon.intersects(outline)
        assert whole.polygon.intersects(outline)


def test_leaves_meet_nothing_on_their_way(home: Scene) -> None:
    from sim_kinematic.agents.opening.reachable import openables_at

    doors = leaves(home)
    for k in doors:
        for opens in (True, False):
            positions = joints_of(home).rest.copy()
            positions[k] = joints_of(home).closed[k] if opens else joints_of(home).opened[k]
            shut = openables_at(home, positions, frozenset(doors))
            assert shut.obstacle(k, opens=opens) == ""


@pytest.mark.slow
def test_homes_differ_in_what_is_closed_and_in_how_leaves_move() -> None:
    kinds, closed = set(), []
    for seed in range(8):
        home = build_home(HomeSpec(seed=seed, generation=2, doors=True))
        parts = [joints_of(home).parts[k][1].joint for k in leaves(home)]
        kinds |= {joint.kind for joint in parts}
        closed += [joint.rest == joint.closed for joint in parts]
    assert kinds == {"revolute", "prismatic"}
    assert 0.15 < np.mean(closed) < 0.7


@pytest.mark.slow
def test_both_storeys_have_doors() -> None:
    home = build_home(HomeSpec(seed=1, generation=2, doors=True, storeys=2))
    names = {joints_of(home).names[k].startswith("upper_") for k in leaves(home)}
    assert names == {False, True}
    assert list(passages(home, FreeSpace.from_scene(home))) == leaves(home)


def test_furniture_that_opens_bars_no_way() -> None:
    home = build_home(HomeSpec(seed=2, articulated=True))
    free = FreeSpace.from_scene(home)
    assert passages(home, free) == ()
    assert passable(home, free) is home


def test_a_home_without_closed_doors_is_passable_as_it_is() -> None:
    home = build_home(HomeSpec(seed=3, generation=2, doors=True))
    joints = joints_of(home)
    rest = joints.rest.copy()
    rest[leaves(home)] = joints.opened[leaves(home)]
    wide = posed(home, rest)
    assert passable(wide, FreeSpace.from_scene(wide)) is wide


@pytest.mark.parametrize("options", [{"doors": True}, {"doors": 1, "generation": 2}])
def test_doors_are_of_the_second_generation(options: dict) -> None:
    with pytest.raises(InputError, match="H3-SCENE-034"):
        HomeSpec(seed=1, **options)


def test_the_spec_says_so_only_where_there_are_doors() -> None:
    with_doors = HomeSpec(seed=1, generation=2, doors=True)
    assert "doors=True" in repr(with_doors)
    assert "doors" not in repr(replace(with_doors, doors=False))
    assert with_doors.changes["doors"] is True
