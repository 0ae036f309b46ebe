"""The light field: where light comes from, how far shadows reach, and what floors mirror."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.mesh.primitives import box_mesh
from h3data.render import RenderInstance
from h3data.render.light.sources import Lamp, LightSources
from h3data.render.shade.blockers_simd import GROUP, LIGHT, REACH, SHARE
from h3data.replay.shadow_casters import capsule_of_box
from h3data_light.bake import LitScene, lit_scene
from h3data_light.field import LightField, free_path

LAMP_AT = np.array([1.0, 2.2, 1.5])


@pytest.fixture(scope="module")
def lit() -> LitScene:
    """A closed room, 4 x 2.5 x 3 m, with a lamp near one end and a glossy floor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("H3DATA_CACHE", "off")
        boxes = {
            "floor": ((0, -0.1, 0), (4, 0, 3)),
            "ceiling": ((0, 2.5, 0), (4, 2.6, 3)),
            "left": ((-0.1, 0, 0), (0, 2.5, 3)),
            "right": ((4, 0, 0), (4.1, 2.5, 3)),
            "back": ((0, 0, -0.1), (4, 2.5, 0)),
            "front": ((0, 0, 3), (4, 2.5, 3.1)),
        }
        meshes, instances = [], []
        for name, (low, high) in boxes.items():
            matrix = np.eye(4)
            matrix[:3, 3] = np.add(low, high) / 2
            instances.append(RenderInstance(mesh=len(meshes), matrix=matrix, name=name))
            meshes.append(box_mesh(np.subtract(high, low) / 2))
        lamp = Lamp(LAMP_AT, np.full(3, 4.0))
        return lit_scene(meshes, instances, range(6), LightSources(lamps=(lamp,), glossy=frozenset({"floor"})))


@pytest.fixture(scope="module")
def field(lit: LitScene) -> LightField:
    assert lit.field is not None
    return lit.field


def test_light_comes_from_the_lamp(field: LightField) -> None:
    points = np.array([[2.0, 1.0, 1.5], [2.5, 0.8, 1.5], [1.0, 1.0, 1.0]])
    light = field.at(points)
    to_lamp = LAMP_AT - points
    to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
    assert ((light.direction * to_lamp).sum(1) > 0.8).all()
    np.testing.assert_allclose(np.linalg.norm(light.direction, axis=1), 1)
    assert (light.share > 0.15).all()
    assert (light.share <= 1).all()
    near, far = field.at(np.array([[1.0, 1.2, 1.5], [3.5, 1.2, 1.5]])).irradiance.mean(1)
    assert near > 1.5 * far


def test_shadows_reach_to_the_next_wall(field: LightField) -> None:
    light = field.at(np.array([[2.0, 1.0, 1.5]]))
    down = 1.0 / max(light.direction[0, 1], 1e-3)  # to the floor along the light
    assert abs(light.reach_m[0] - down) < 0.5
    beside_wall = field.at(np.array([[3.7, 1.3, 1.5]]))
    assert beside_wall.reach_m[0] < 1.2


def test_the_field_is_continuous_and_finite_everywhere(field: LightField) -> None:
    line = np.column_stack([np.linspace(0.3, 3.7, 341), np.full(341, 1.1), np.full(341, 1.4)])
    light = field.at(line)
    assert np.abs(np.diff(light.irradiance, axis=0)).max() < 0.1 * light.irradiance.max()
    assert np.linalg.norm(np.diff(light.direction, axis=0), axis=1).max() < 0.15
    strange = field.at(np.array([[50.0, -9, 50], [np.nan, 1, 1], [-0.05, 1.0, 1.0]]))
    for values in vars(strange).values():
        assert np.isfinite(values).all()


def test_capsules_of_a_group_share_one_direction_and_absent_ones_are_left_out(field: LightField) -> None:
    capsules = np.array([[1, 0.5, 1, 1, 1, 1, 0.1], [3, 0.5, 2, 3, 1, 2, 0.1], [2, 0.5, 1, 2, 1, 1, 0.1], [np.nan] * 7])
    blockers = field.blockers(capsules, np.array([4, 2, 4, 2]), members=np.array([-1, 2, 4, -1]))
    assert blockers.rows[:, GROUP].tolist() == [2, 4, 4]
    np.testing.assert_array_equal(blockers.rows[1, LIGHT : LIGHT + 3], blockers.rows[2, LIGHT : LIGHT + 3])
    assert blockers.rows[1, SHARE] == blockers.rows[2, SHARE]
    assert blockers.rows[1, REACH] != blockers.rows[2, REACH]
    assert blockers.tints[:, 3].tolist() == [-1, 2, 4, -1]
    np.testing.assert_array_equal(blockers.tints[[0, 3], :3], 1)
    assert (blockers.tints[[1, 2], :3] != 1).all()
    nothing = field.blockers(np.zeros((0, 7)), np.zeros(0, int), members=np.array([-1, 0]))
    assert len(nothing.rows) == 0
    np.testing.assert_array_equal(nothing.tints[:, :3], 1)


def test_only_the_floor_mirrors_and_brightest_towards_the_lamp(lit: LitScene) -> None:
    (mesh,) = lit.mirrors
    assert mesh == lit.instances[0].mesh
    mirrors, floor = lit.mirrors[mesh], lit.meshes[mesh]
    assert floor.normals is not None
    sides = floor.normals[:, 1] < 0.5
    assert (mirrors[sides] == 0).all()
    far = ~sides & (floor.vertices[:, 0] > 1.0)  # in the mesh's frame, 1 m beyond the middle; the lamp is towards -x
    assert far.any()
    assert (mirrors[far, 0] > mirrors[far, 1]).all()
    assert np.isfinite(mirrors).all()


def test_free_paths_end_at_surfaces() -> None:
    distance = np.full((40, 5, 5), 1, np.uint8)
    distance[30:] = 0
    start, x = np.array([[2.5, 2.5, 2.5]] * 3), np.eye(3)[0]
    far = free_path(distance, start, np.array([x, -x, [0, 1, 0]]), 100.0)
    assert abs(far[0] - 27.5) <= 1
    assert (far[1:] <= 3.5).all()


def test_a_capsule_lies_along_the_longest_side_of_a_box() -> None:
    capsule = capsule_of_box((0, 0, 0), (0.2, 1.0, 0.3))
    np.testing.assert_allclose(capsule[:3] + capsule[3:6], [0.2, 1.0, 0.3])
    radius = np.sqrt(0.06 / np.pi)
    np.testing.assert_allclose(capsule[6], radius)
    np.testing.assert_allclose(capsule[4] - capsule[1], 1.0 - 2 * radius)
    assert np.isnan(capsule_of_box((0, 0, 0), (0, 0, 0))).all()


def test_interpolation_equals_arrays_bit_by_bit(field: LightField) -> None:
    rng, corners = np.random.default_rng(0), np.array(list(np.ndindex(2, 2, 2)))
    points = rng.uniform(field.origin - 1, field.origin + 6, (500, 3))
    shape = np.array(field.reach_m.shape)
    place = np.clip((points - field.origin) / field.spacing_m - 0.5, 0, shape - 1)
    low = np.minimum(place.astype(int), shape - 2)
    x, y, z = (low + corners[:, None]).transpose(2, 0, 1)
    weight = (np.where(corners[:, None], place - low, 1 - (place - low)).prod(2) + 1e-4) * np.isfinite(
        field.cube[x, y, z, 0, 0]
    )
    known = weight.sum(0) > 0
    weight = weight / np.where(known, weight.sum(0), 1)
    cube = np.einsum("cn,cnfa->nfa", weight, np.nan_to_num(field.cube[x, y, z]))
    np.testing.assert_array_equal(field.cubes(points), np.where(known[:, None, None], cube, field.mean))
    reach = np.where(known, (weight * field.reach_m[x, y, z]).sum(0), 1.0)
    np.testing.assert_array_equal(field.at(points).reach_m, reach)
    assert np.isfinite(field.cubes(np.full((1, 3), np.nan))).all()  # of an agent that is absent
