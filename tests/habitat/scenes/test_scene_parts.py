"""Habitat scenes written here: articulated objects, lights, rooms, filters, collision parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import MissingAssetError, SceneError
from h3data.geometry import quat_rotate
from h3data.mesh.mesh import Mesh
from h3data.scene import load_scene, save_scene, scene_digest
from h3data.scene.records import Scene, instance_bounds
from h3data_habitat.scenes.colliders import part_points
from h3data_habitat.scenes.collision_geometry import MAX_PARTS, hull_shapes
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data_habitat.scenes.semantics import polygon_rectangles
from tests.habitat.scenes.dataset_folder import CHEST, Dataset

S = 0.5**0.5


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset(tmp_path)


def link_pose(scene: Scene, link: str) -> np.ndarray:
    return next(i.pose for i in scene.instances if i.name == f"chest_:0000/{link}")


# --- articulated objects ----------------------------------------------------------------------------------------------
def test_links_are_static_instances_at_the_initial_joint_positions(dataset: Dataset) -> None:
    turn = [S, 0, S, 0]  # w x y z: (x, y, z) -> (z, y, -x)
    scene = dataset.chest(translation=[10, 2, 0], rotation=turn, initial_joint_pose={"slide": 0.3})
    assert [i.name for i in scene.instances] == ["stage", *(f"chest_:0000/{n}" for n in ("base", "b_drawer", "a_lid"))]
    assert all(i.motion == "static" for i in scene.instances)
    # the pose is that of the base's centre of mass, 0.5 m along z of its link
    np.testing.assert_allclose(link_pose(scene, "base")[:3], [9.5, 2, 0], atol=1e-6)
    np.testing.assert_allclose(link_pose(scene, "b_drawer")[:3], [9.5 + 0.2, 2, -0.3], atol=1e-6)
    assert len(scene.assets["chest/base"].shapes) == 1


def test_joint_lists_are_in_habitat_sims_order_and_names_win(dataset: Dataset) -> None:
    listed = dataset.chest(initial_joint_pose=[0.4, 0.25])  # a_lid comes before b_drawer
    np.testing.assert_allclose(link_pose(listed, "b_drawer")[:3], [0.25, 0, -0.3], atol=1e-6)
    assert listed.source["warnings"] == []
    in_file_order = dataset.chest(initial_joint_pose=[0.4, 0.25], link_order="urdf_order")
    np.testing.assert_allclose(link_pose(in_file_order, "b_drawer")[:3], [0.4, 0, -0.3], atol=1e-6)
    # habitat-sim sorts names (hinge, slide) and fills the joints in order: here that is the same
    named = dataset.chest(initial_joint_pose={"slide": 0.25, "hinge": 0.4})
    assert named.source["warnings"] == []
    np.testing.assert_allclose(link_pose(named, "a_lid"), link_pose(listed, "a_lid"), atol=1e-12)
    alone = dataset.chest(initial_joint_pose={"slide": 0.25})
    assert any("by their order" in w for w in alone.source["warnings"])
    np.testing.assert_allclose(link_pose(alone, "b_drawer")[0], 0.25, atol=1e-6)
    many = dataset.chest(initial_joint_pose=[0, 0, 0])
    assert any("the rest is left out" in w for w in many.source["warnings"])


def test_limits_clamp_only_when_asked(dataset: Dataset) -> None:
    free = dataset.chest(initial_joint_pose={"slide": 2, "hinge": 0})
    np.testing.assert_allclose(link_pose(free, "b_drawer")[0], 2, atol=1e-6)
    clamped = dataset.chest(initial_joint_pose={"slide": 2, "hinge": 0}, auto_clamp_joint_limits=True)
    np.testing.assert_allclose(link_pose(clamped, "b_drawer")[0], 0.5, atol=1e-6)


def test_uniform_scale_scales_lengths_but_not_positions(dataset: Dataset) -> None:
    scene = dataset.chest(uniform_scale=2, initial_joint_pose={"slide": 0.3, "hinge": 0}, non_uniform_scale=[1, 2, 1])
    np.testing.assert_allclose(link_pose(scene, "b_drawer")[:3], [0.3, 0, 2 * (0.2 - 0.5)], atol=1e-6)
    base = next(i for i in scene.instances if i.name.endswith("/base"))
    np.testing.assert_allclose(np.ptp(instance_bounds(scene, base), axis=0), [2, 2, 2], atol=1e-6)
    assert any("non_uniform_scale" in w for w in scene.source["warnings"])


def test_receptacles_hang_on_their_link_and_point_up(dataset: Dataset) -> None:
    """The lid's link is turned by 90 degrees about x, so its own z axis points down in the world."""
    box = {"position": [0, 0, -0.05], "scale": [0.5, 0.4, 0.05], "rotation": [1, 0, 0, 0]}
    dataset.json(
        "urdf/chest/chest.ao_config.json",
        {
            "urdf_filepath": "chest.urdf",
            "semantic_id": 5,
            "user_defined": {
                "receptacle_aabb_lid": {**box, "parent_link": "a_lid"},
                "receptacle_aabb_lost": {**box, "parent_link": "handle"},
            },
        },
    )
    scene = dataset.chest()
    ((instance, receptacle),) = scene.receptacles()
    assert instance.name == "chest_:0000/a_lid"
    assert instance.semantic_id == 5
    world = instance.pose[:3] + quat_rotate(instance.pose[3:], receptacle.center)
    # link z is world -y; the box reaches from 0 to 0.1 above the joint at y 0.5, its bottom is the surface
    np.testing.assert_allclose(world, [0, 0.5, -0.5], atol=1e-6)
    np.testing.assert_allclose(receptacle.half_size, [0.5, 0.4], atol=1e-6)
    assert any("'handle'" in w for w in scene.source["warnings"])
    filtered = dataset.load(
        articulated=[{"template_name": "chest"}],
        user_defined={"scene_filter_file": str(dataset.json("f.json", {"active": []}))},
    )
    assert list(filtered.receptacles()) == []


def test_a_broken_urdf_leaves_out_its_object_only(dataset: Dataset) -> None:
    dataset.write("urdf/chest/chest.urdf", "<robot>")
    scene = dataset.chest()
    assert [i.name for i in scene.instances] == ["stage"]
    assert any("'chest' is left out" in w for w in scene.source["warnings"])
    with pytest.raises(SceneError, match="H3-HABITAT-120"):
        dataset.chest(options={"strict": True})
    with pytest.raises(SceneError, match=r"(?s)well-formed.*H3-HABITAT-127"):
        load_habitat_scene(dataset.root / "urdf" / "chest" / "chest.urdf")


def test_missing_parts_of_articulated_objects(dataset: Dataset) -> None:
    dataset.write("urdf/chest/chest.urdf", CHEST.replace('<box size="1 0.1 1"/>', '<mesh filename="lid.glb"/>'))
    with pytest.raises(MissingAssetError, match=r"(?s)lid\.glb.*H3-HABITAT-119"):
        dataset.chest()
    assert len(dataset.chest(options={"allow_missing": True}).instances) == 1
    with pytest.raises(SceneError, match=r"(?s)'cupboard'.*H3-HABITAT-133"):
        dataset.load(articulated=[{"template_name": "cupboard"}])


# --- lights, rooms, filters, navmesh ----------------------------------------------------------------------------------
def test_lights_survive_saving(dataset: Dataset, tmp_path: Path) -> None:
    dataset.json(
        "lighting/lamps.lighting_config.json",
        {
            "positive_intensity_scale": 2,
            "negative_intensity_scale": 0.5,
            "lights": {
                "sun": {"type": "directional", "direction": [0, -1, 0], "intensity": 1.5, "color": [1, 0.9, 0.8]},
                "hole": {"type": "point", "position": [1, 2, 3], "intensity": -4},
                "spot": {
                    "type": "spot",
                    "position_model": "camera",
                    "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2},
                },
            },
        },
    )
    scene = dataset.load(default_lighting="lamps")
    assert scene.lights is not None
    assert [(light.name, light.kind, light.intensity, light.frame) for light in scene.lights] == [
        ("sun", "directional", 3.0, "global"),
        ("hole", "point", -2.0, "global"),
        ("spot", "spot", 2.0, "camera"),
    ]
    save_scene(scene, tmp_path / "s.glb")
    again = load_scene(tmp_path / "s.glb")
    assert scene_digest(again) == scene_digest(scene) != scene_digest(dataset.load())
    assert again.lights is not None
    np.testing.assert_array_equal(again.lights[1].vector, [1, 2, 3])
    assert again.lights[2].cone_rad == (0.1, 0.2)
    assert dataset.load(default_lighting="").lights is None
    assert dataset.load(default_lighting="no_lights").lights == ()
    lost = dataset.load(default_lighting="moon")
    assert lost.lights is None
    assert any("'moon'" in w for w in lost.source["warnings"])


def test_regions_become_rooms_and_the_lexicon_names_classes(dataset: Dataset) -> None:
    dataset.brick(semantic_id=7)
    dataset.json("semantics/lexicon.json", {"classes": [{"id": 7, "name": "sofa"}]})
    corners = [(0, 0), (4, 0), (4, 2), (2, 2), (2, 3), (0, 3)]
    dataset.json(
        "semantics/one.semantic_config.json",
        {
            "region_annotations": [
                {
                    "name": "hall",
                    "label": "hallway",
                    "poly_loop": [[x, 0.5, z] for x, z in corners],
                    "floor_height": 0.5,
                },
                {"name": "hall", "label": "bath", "min_bounds": [-3, 0, -2], "max_bounds": [-1, 2, 0]},
                {"name": "line", "label": "none", "poly_loop": [[0, 0, 0], [1, 0, 0]]},
            ]
        },
    )
    scene = dataset.load({"template_name": "brick"}, semantic_scene_instance="one.semantic_config.json")
    hall, bath = scene.rooms
    np.testing.assert_allclose(hall.rectangles, [[0, 0, 4, 2], [0, 2, 2, 3]])
    assert (hall.name, hall.category, hall.floor_y) == ("hall", "hallway", 0.5)
    np.testing.assert_allclose(bath.rectangles, [[-3, -2, -1, 0]])
    assert bath.name == "hall_1"
    assert scene.assets["brick"].category == "sofa"
    assert any("'line'" in w for w in scene.source["warnings"])


@given(st.lists(st.tuples(*[st.floats(-20, 20)] * 2), min_size=3, max_size=9), st.floats(0, 6.3))
def test_rectangles_of_a_star_shaped_polygon_have_its_area(points: list[tuple[float, float]], turn: float) -> None:
    corners = np.array(points)
    order = np.argsort(np.arctan2(*(corners - corners.mean(0)).T))
    corners = corners[order] @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    x, z = corners.T
    shoelace = abs(np.sum(x * np.roll(z, -1) - z * np.roll(x, -1))) / 2
    import shapely

    if not shapely.Polygon(corners).is_valid:
        return
    x0, z0, x1, z1 = polygon_rectangles(corners).T
    assert np.sum((x1 - x0) * (z1 - z0)) == pytest.approx(shoelace, abs=1e-5)
    assert np.all((x1 > x0) & (z1 > z0))


def test_the_filter_decides_which_receptacles_are_in_use(dataset: Dataset, tmp_path: Path) -> None:
    box = {"position": [0, 3, 0], "scale": [1, 1, 1]}
    dataset.brick(user_defined={"receptacle_aabb_top": box, "receptacle_aabb_shelf": box})
    dataset.json(
        "filters/one.json",
        {
            "active": [
                "brick_:0000|receptacle_aabb_top",
                "brick_:0001|receptacle_aabb_shelf",
                "brick_:0001|receptacle_aabb_top",
            ],
            "within_set": ["brick_:0001|receptacle_aabb_shelf"],
            "height_filtered": ["brick_:0000|receptacle_aabb_shelf"],
        },
    )
    brick = {"template_name": "brick", "motion_type": "STATIC"}
    scene = dataset.load(brick, brick, user_defined={"scene_filter_file": "filters/one.json"})
    used = [f"{i.name}|{r.name}" for i, r in scene.receptacles()]
    assert used == [
        "brick_:0000|receptacle_aabb_top",
        "brick_:0001|receptacle_aabb_top",
        "brick_:0001|receptacle_aabb_shelf",
    ]
    assert scene.source["receptacles_within"] == ["brick_:0001|receptacle_aabb_shelf"]
    save_scene(scene, tmp_path / "s.glb")
    assert [f"{i.name}|{r.name}" for i, r in load_scene(tmp_path / "s.glb").receptacles()] == used
    unfiltered = dataset.load(brick, user_defined={"scene_filter_file": "lost.json"})
    assert len(list(unfiltered.receptacles())) == 2
    assert any("lost.json" in w for w in unfiltered.source["warnings"])


def test_the_navmesh_is_named(dataset: Dataset) -> None:
    assert any("'navmeshes/one.navmesh'" in w for w in dataset.load(navmesh_instance="walk").source["warnings"])
    path = dataset.write("navmeshes/one.navmesh", "x")
    assert dataset.load(navmesh_instance="walk").source["navmesh"] == str(path)
    dataset.json("stages/room.stage_config.json", {"render_asset": "room.glb", "nav_asset": "../navmeshes/one.navmesh"})
    assert dataset.load().source["navmesh"] == str(path)


def test_what_is_not_visible_still_collides(dataset: Dataset) -> None:
    dataset.brick()
    scene = dataset.load({"template_name": "brick", "is_instance_visible": False}, {"template_name": "brick"})
    hidden, seen = (scene.assets[i.asset] for i in scene.instances[1:])
    assert (len(hidden.mesh.faces), len(hidden.shapes)) == (0, 1)
    assert len(seen.mesh.faces) == 12


# --- collision parts --------------------------------------------------------------------------------------------------
def test_one_hull_per_node_and_connected_piece(dataset: Dataset) -> None:
    """Two boxes in one node far apart, and a third in a node of its own that touches the first with a whole side."""
    near, far, on_top = (trimesh.creation.box(extents=(1, 1, 1)) for _ in range(3))
    far.apply_translation([5, 0, 0])
    on_top.apply_translation([0, 1, 0])
    both = trimesh.util.concatenate([near, far])
    parts = trimesh.Scene({"low": both, "high": on_top})
    dataset.mesh("objects/parts.glb", parts)
    dataset.brick(collision_asset="parts.glb", units_to_meters=0.5)
    boxes = [np.ptp(part_points(s), axis=0) for s in dataset.load({"template_name": "brick"}).assets["brick"].shapes]
    np.testing.assert_allclose(boxes, [[0.5, 0.5, 0.5]] * 3, atol=1e-6)
    dataset.brick(collision_asset="parts.glb", join_collision_meshes=True)
    (joined,) = dataset.load({"template_name": "brick"}).assets["brick"].shapes
    np.testing.assert_allclose(np.ptp(part_points(joined), axis=0), [6, 2, 1], atol=1e-6)
    dataset.brick(collision_asset="lost.glb")
    scene = dataset.load({"template_name": "brick"})
    assert len(scene.assets["brick"].shapes) == 1
    assert any("lost.glb" in w for w in scene.source["warnings"])


def test_too_many_pieces_become_fewer_hulls() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])

    def node(count: int, at: float) -> Mesh:
        points = np.concatenate([corners + np.array([2.0 * k, at, 0]) for k in range(count)]).astype(np.float32)
        return Mesh(
            vertices=points,
            faces=np.concatenate([faces + 4 * k for k in range(count)]).astype(np.int32),
            colors=np.zeros(points.shape, np.uint8),
        )

    assert len(hull_shapes([node(MAX_PARTS, 0)])) == MAX_PARTS
    assert len(hull_shapes([node(MAX_PARTS, 0), node(1, 5)])) == 2
    assert len(hull_shapes([node(1000, 0)])) == 1
    assert len(hull_shapes([node(1, 3 * k) for k in range(MAX_PARTS + 1)])) == 1
    assert hull_shapes([]) == ()
