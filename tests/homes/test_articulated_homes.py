"""Homes whose furniture opens."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import pose_to_matrix, transform_points
from h3data.scene import Scene, load_scene, scene_digest
from h3data.scene.articulation import handle_points, joints_of, opened, posed
from h3data.scene.records import Box, instance_matrix
from h3data.scene.scene_file import scene_bytes
from h3data_homes import HomeSpec, build_home
from h3data_homes.check import walkable_area

SEEDS = (0, 2)


@pytest.fixture(scope="module", params=[0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in SEEDS if seed)])
def pair(request: pytest.FixtureRequest) -> tuple[Scene, Scene]:
    return build_home(HomeSpec(seed=request.param)), build_home(HomeSpec(seed=request.param, articulated=True))


def test_rooms_furniture_and_floor_are_those_of_the_plain_home(pair: tuple[Scene, Scene]) -> None:
    plain, opens = pair
    assert not plain.articulations
    assert walkable_area(plain).symmetric_difference(walkable_area(opens)).area < 1e-6
    places = {tuple(np.round(i.pose, 9)) for i in plain.static_instances}
    assert {tuple(np.round(i.pose, 9)) for i in opens.static_instances} == places
    kinds = {thing.name.rpartition("_")[0] for thing in opens.articulations}
    assert {"fridge", "kitchen_counter", "dishwasher", "kitchen_cabinet"} >= kinds >= {"fridge", "kitchen_counter"}
    assert opens.source["articulated"] is True
    assert scene_digest(load_scene(scene_bytes(opens))) == scene_digest(opens)


def test_parts_stay_out_of_each_other_wherever_one_of_them_stands(pair: tuple[Scene, Scene]) -> None:
    """A door that swings or a drawer that slides keeps out of the body of its thing, but for a hair at the hinge."""
    _, scene = pair
    joints = joints_of(scene)
    by_name = {i.name: i for i in scene.instances}
    for share in (0.25, 0.6, 1.0):
        motions = joints.motions(joints.closed + share * (joints.opened - joints.closed))
        for k, (thing, part) in enumerate(joints.parts):
            body = by_name[thing.base]
            part_points = _corners(scene, part.instances[0], motions[k], shrunk=0.006)
            local = transform_points(np.linalg.inv(instance_matrix(body)), part_points)
            for shape in scene.assets[body.asset].shapes:
                assert isinstance(shape, Box)
                inside = (np.abs(local - shape.pose[:3]) < shape.half_extents - 1e-6).all(1)
                assert not inside.any(), (joints.names[k], share, part_points[inside])


def _corners(scene: Scene, name: str, motion: np.ndarray, *, shrunk: float) -> np.ndarray:
    instance = next(i for i in scene.instances if i.name == name)
    found = []
    for shape in scene.assets[instance.asset].shapes:
        assert isinstance(shape, Box)
        signs = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], float)
        found.append(shape.pose[:3] + signs * np.maximum(shape.half_extents - shrunk, 0))
    return transform_points(motion @ instance_matrix(instance), np.concatenate(found))


def test_what_lies_in_a_drawer_comes_out_with_it_and_the_rest_stays() -> None:
    scene = build_home(HomeSpec(seed=2, articulated=True))
    joints = joints_of(scene)
    kinds = {i.name: i.motion for i in scene.instances}
    loaded = [k for k, (_, part) in enumerate(joints.parts) if any(kinds[n] == "kinematic" for n in part.instances)]
    assert loaded
    after = {i.name: i for i in opened(scene).instances}
    for k, (thing, part) in enumerate(joints.parts):
        ahead = pose_to_matrix(thing.pose)[:3, 2]
        for name in part.instances:
            if kinds[name] == "kinematic":
                before = next(i for i in scene.instances if i.name == name)
                np.testing.assert_allclose(after[name].pose[:3] - before.pose[:3], part.joint.upper * ahead, atol=1e-9)
                assert k in loaded
    still = [i.name for i in scene.instances if i.motion == "kinematic" and i.name not in joints.owner]
    assert all(np.array_equal(after[n].pose, next(i.pose for i in scene.instances if i.name == n)) for n in still)


def test_handles_come_towards_whoever_opens(pair: tuple[Scene, Scene]) -> None:
    _, scene = pair
    joints = joints_of(scene)
    here, there = handle_points(scene), handle_points(opened(scene))
    for k, (thing, _) in enumerate(joints.parts):
        ahead = pose_to_matrix(thing.pose)[:3, 2]
        assert (there[k] - here[k]) @ ahead > 0.25, joints.names[k]


def test_every_receptacle_inside_is_shut_off_and_those_on_top_are_not(pair: tuple[Scene, Scene]) -> None:
    _, scene = pair
    enclosing = joints_of(scene).enclosing
    names = {f"{i.name}|{r.name}" for i, r in scene.receptacles()}
    assert set(enclosing) <= names
    of_things = {n for n in names if n.split("|")[0].split("/")[0] in {t.name for t in scene.articulations}}
    assert of_things - set(enclosing) == {n for n in of_things if n.endswith("|top")}


def test_only_what_moves_differs_in_an_opened_home() -> None:
    scene = build_home(HomeSpec(seed=0, articulated=True))
    ajar = posed(scene, {"fridge_0/door": 1.0})
    moved = [i.name for i, j in zip(scene.instances, ajar.instances, strict=True) if not np.array_equal(i.pose, j.pose)]
    assert moved == ["fridge_0/door"]
    assert walkable_area(ajar).area < walkable_area(scene).area - 0.05  # an open door is in the way


def test_articulated_is_true_or_false() -> None:
    with pytest.raises(InputError, match="H3-SCENE-033"):
        HomeSpec(articulated=1)  # type: ignore[arg-type]
