"""Habitat scenes written here: articulated objects, lights, rooms, filters, collision parts, where files are looked for."""

from __future__ import annotations

import gzip
import importlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import h3data
from h3data.errors import FormatError, H3DataError, MissingAssetError, SceneError
from h3data.geometry import quat_rotate
from h3data.interop import load_habitat_scene, sniff
from h3data.interop.habitat_colliders import part_points
from h3data.interop.habitat_collision import MAX_PARTS, hull_shapes
from h3data.interop.habitat_semantics import polygon_rectangles
from h3data.scene import load_scene, save_scene, scene_digest
from h3data.scene.records import Mesh, Scene, instance_bounds
from h3data_pipelines.cli import main

S = 0.5**0.5
CHEST = """<robot name="chest">
  <link name="base"><inertial><origin xyz="0 0 0.5"/></inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision></link>
  <link name="b_drawer"><visual><geometry><box size="0.8 0.8 0.2"/></geometry></visual></link>
  <link name="a_lid"><visual><geometry><box size="1 0.1 1"/></geometry></visual></link>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="b_drawer"/><origin xyz="0 0 0.2"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.5"/></joint>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="a_lid"/>
    <origin xyz="0 0.5 0" rpy="1.5707963267948966 0 0"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/></joint>
</robot>"""


class Dataset:
    """A dataset folder with a stage ``room`` and a chest; a test adds what it needs."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.config = root / "home.scene_dataset_config.json"
        self.json(self.config.name, {
            "stages": {"paths": {".json": ["stages"]}},
            "objects": {"paths": {".json": ["objects"]}},
            "articulated_objects": {"paths": {".urdf": ["urdf/*"], ".json": ["urdf/*"]}},
            "light_setups": {"paths": {".json": ["lighting"]}},
            "semantic_scene_descriptor_instances": {
                "default_attributes": {"semantic_descriptor_filename": "lexicon.json"}, "paths": {".json": ["semantics"]}
            },
            "navmesh_instances": {"walk": "navmeshes/one.navmesh"},
            "scene_instances": {"paths": {".json": ["scenes"]}},
        })  # fmt: skip
        self.mesh("stages/room.glb", trimesh.creation.box(extents=(10, 0.2, 8)))
        self.json("stages/room.stage_config.json", {"render_asset": "room.glb"})
        self.write("urdf/chest/chest.urdf", CHEST)

    def write(self, name: str, text: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def json(self, name: str, content: Any) -> Path:
        return self.write(name, json.dumps(content))

    def mesh(self, name: str, mesh: Any) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh.export(path)

    def brick(self, **attributes: Any) -> None:
        self.mesh("objects/brick.glb", trimesh.creation.box(extents=(2, 4, 6)))
        self.json("objects/brick.object_config.json", {"render_asset": "brick.glb", **attributes})

    def load(self, *objects: dict[str, Any], articulated: Any = (), options: Any = None, **more: Any) -> Scene:
        content = {
            "stage_instance": {"template_name": "room"},
            "object_instances": list(objects),
            "articulated_object_instances": list(articulated),
            **more,
        }
        self.json("scenes/one.scene_instance.json", content)
        return load_habitat_scene(self.config, "one", **(options or {}))

    def chest(self, *, options: Any = None, **entry: Any) -> Scene:
        return self.load(articulated=[{"template_name": "chest", **entry}], options=options)


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
    dataset.json("urdf/chest/chest.ao_config.json", {
        "urdf_filepath": "chest.urdf", "semantic_id": 5,
        "user_defined": {
            "receptacle_aabb_lid": {**box, "parent_link": "a_lid"},
            "receptacle_aabb_lost": {**box, "parent_link": "handle"},
        },
    })  # fmt: skip
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
    with pytest.raises(SceneError, match="strict"):
        dataset.chest(options={"strict": True})
    with pytest.raises(SceneError, match="well-formed"):
        load_habitat_scene(dataset.root / "urdf" / "chest" / "chest.urdf")


def test_missing_parts_of_articulated_objects(dataset: Dataset) -> None:
    dataset.write("urdf/chest/chest.urdf", CHEST.replace('<box size="1 0.1 1"/>', '<mesh filename="lid.glb"/>'))
    with pytest.raises(MissingAssetError, match=r"lid\.glb"):
        dataset.chest()
    assert len(dataset.chest(options={"allow_missing": True}).instances) == 1
    with pytest.raises(SceneError, match="'cupboard'"):
        dataset.load(articulated=[{"template_name": "cupboard"}])


# --- lights, rooms, filters, navmesh ----------------------------------------------------------------------------------
def test_lights_survive_saving(dataset: Dataset, tmp_path: Path) -> None:
    dataset.json("lighting/lamps.lighting_config.json", {
        "positive_intensity_scale": 2, "negative_intensity_scale": 0.5,
        "lights": {
            "sun": {"type": "directional", "direction": [0, -1, 0], "intensity": 1.5, "color": [1, 0.9, 0.8]},
            "hole": {"type": "point", "position": [1, 2, 3], "intensity": -4},
            "spot": {"type": "spot", "position_model": "camera", "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2}},
        },
    })  # fmt: skip
    scene = dataset.load(default_lighting="lamps")
    assert scene.lights is not None
    assert [(light.name, light.kind, light.intensity, light.frame) for light in scene.lights] == [
        ("sun", "directional", 3.0, "global"), ("hole", "point", -2.0, "global"), ("spot", "spot", 2.0, "camera")
    ]  # fmt: skip
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
    dataset.json("semantics/one.semantic_config.json", {"region_annotations": [
        {"name": "hall", "label": "hallway", "poly_loop": [[x, 0.5, z] for x, z in corners], "floor_height": 0.5},
        {"name": "hall", "label": "bath", "min_bounds": [-3, 0, -2], "max_bounds": [-1, 2, 0]},
        {"name": "line", "label": "none", "poly_loop": [[0, 0, 0], [1, 0, 0]]},
    ]})  # fmt: skip
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
    dataset.json("filters/one.json", {
        "active": ["brick_:0000|receptacle_aabb_top", "brick_:0001|receptacle_aabb_shelf", "brick_:0001|receptacle_aabb_top"],
        "within_set": ["brick_:0001|receptacle_aabb_shelf"],
        "height_filtered": ["brick_:0000|receptacle_aabb_shelf"],
    })  # fmt: skip
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


# --- files ------------------------------------------------------------------------------------------------------------
def test_a_config_cannot_reach_out_of_its_dataset(tmp_path: Path) -> None:
    made = Dataset(tmp_path / "home" / "set")
    made.brick()
    os.rename(made.root / "objects" / "brick.glb", tmp_path / "brick.glb")
    made.json("objects/brick.object_config.json", {"render_asset": "../../../brick.glb"})
    scene = made.load({"template_name": "brick"})
    assert [i.name for i in scene.instances] == ["stage"]
    assert any("leads out of the dataset" in w and "--assets" in w for w in scene.source["warnings"])
    with pytest.raises(SceneError, match="leads out"):
        made.load({"template_name": "brick"}, options={"strict": True})
    assert len(made.load({"template_name": "brick"}, options={"assets": [tmp_path], "strict": True}).instances) == 2
    made.json("objects/brick.object_config.json", {"render_asset": str(tmp_path / "brick.glb")})
    assert len(made.load({"template_name": "brick"}).instances) == 1


def test_a_folder_data_holds_what_belongs_together(tmp_path: Path) -> None:
    made = Dataset(tmp_path / "data" / "sets" / "home")
    made.brick()
    other = tmp_path / "data" / "objects" / "brick.glb"
    other.parent.mkdir()
    os.rename(made.root / "objects" / "brick.glb", other)
    made.json("objects/brick.object_config.json", {"render_asset": "../../../objects/brick.glb"})
    assert len(made.load({"template_name": "brick"}, options={"strict": True}).instances) == 2


def test_files_below_asset_folders_by_any_name_of_their_dataset(
    dataset: Dataset, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset.brick(render_asset="data/fpss/objects/9/brick.glb")
    with pytest.raises(MissingAssetError, match=r"looked for: .*data/fpss"):
        dataset.load({"template_name": "brick"})
    root = tmp_path_factory.mktemp("downloads")
    file = root / "data" / "scene_datasets" / "hssd-hab" / "objects" / "9" / "brick.glb"
    file.parent.mkdir(parents=True)
    os.rename(dataset.root / "objects" / "brick.glb", file)
    assert len(dataset.load({"template_name": "brick"}, options={"assets": [root]}).instances) == 2
    monkeypatch.setenv("H3DATA_ASSETS", str(root))
    assert len(dataset.load({"template_name": "brick"}).instances) == 2


def test_a_path_is_tried_as_it_stands_first(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: Any
) -> None:
    """As habitat-sim does: relative to the working directory, then to the config."""
    dataset.brick()
    work = tmp_path_factory.mktemp("work")
    trimesh.creation.box(extents=(1, 1, 1)).export(work / "brick.glb")
    monkeypatch.chdir(work)
    scene = dataset.load({"template_name": "brick"})
    np.testing.assert_allclose(np.ptp(scene.assets["brick"].mesh.bounds, axis=0), [1, 1, 1], atol=1e-6)


# --- opening, and things that are wrong -------------------------------------------------------------------------------
def test_things_alone(dataset: Dataset) -> None:
    dataset.brick(COM=[0, 1, 0])
    scene = load_habitat_scene(dataset.root / "objects" / "brick.object_config.json")
    (brick,) = scene.instances
    np.testing.assert_array_equal(brick.pose, [0, 0, 0, 0, 0, 0, 1])
    assert len(load_habitat_scene(dataset.root / "urdf" / "chest" / "chest.urdf").instances) == 3
    dataset.load()
    by_part = load_habitat_scene(f"{dataset.config}#on")
    assert by_part.name == "one"
    with pytest.raises(SceneError, match="No scene matches 'two'"):
        load_habitat_scene(f"{dataset.config}#two")


BRICK = {"template_name": "brick"}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a size of zero": ({**BRICK, "uniform_scale": 0}, "its size is 0"),
    "one axis of zero": ({**BRICK, "non_uniform_scale": [1, 0, 1]}, "its size is 0"),
    "a size beyond all measure": ({**BRICK, "uniform_scale": 1e30}, "'brick_:0000' is left out: it reaches"),
    "a place beyond all measure": ({**BRICK, "translation": [0, 1e308, 0]}, "'brick_:0000' is left out: it reaches"),
    "no rotation": ({**BRICK, "rotation": [0, 0, 0, 0]}, "rotation of 'brick_:0000' is zero"),
    "an unknown key": ({**BRICK, "colour": "red"}, "object_instance.colour"),
}


@pytest.mark.parametrize("case", WRONG)
def test_doubtful_objects_give_a_warning_that_strict_makes_an_error(dataset: Dataset, case: str) -> None:
    dataset.brick()
    entry, message = WRONG[case]
    scene = dataset.load(entry)
    assert any(message in w for w in scene.source["warnings"])
    assert len(scene.instances) == (1 if "size" in message or "left out" in message else 2)
    with pytest.raises(SceneError, match="strict"):
        dataset.load(entry, options={"strict": True})


def test_names_keep_their_numbers_when_an_object_is_left_out(dataset: Dataset) -> None:
    dataset.brick()
    scene = dataset.load(BRICK, {**BRICK, "uniform_scale": 0}, BRICK)
    assert [i.name for i in scene.instances] == ["stage", "brick_:0000", "brick_:0002"]


@pytest.mark.parametrize(
    "content",
    [
        '{"object_instances": [{"template_name": "brick", "translation": [NaN, 0, 0]}]}',
        '{"object_instances": [{"template_name": "brick", "translation": [1e999, 0, 0]}]}',
        '{"object_instances": [{"template_name": "brick", "uniform_scale": true}]}',
        '{"object_instances": [{"template_name": "brick", "rotation": ["1", 0, 0, 0]}]}',
        '{"object_instances": [{"template_name": "brick", "is_instance_visible": "no"}]}',
        '{"object_instances": [{"template_name": "brick", "translation_origin": 3}]}',
        '{"object_instances": ' + "[" * 100_000 + "]" * 100_000 + "}",
        '{"object_instances": {}}',
        '{"object_instances": ""}',
        '{"articulated_object_instances": 0}',
        '{"articulated_object_instances": [{"template_name": "chest", "initial_joint_pose": "open"}]}',
        '{"articulated_object_instances": [{"template_name": "chest", "initial_joint_pose": {"slide": "x"}}]}',
        '{"user_defined": 3}',
        '{"user_defined": {"scene_filter_file": ["a"]}}',
        '{"default_lighting": 3}',
        '{"stage_instance": 5}',
    ],
)
def test_wrong_values_name_key_and_file(dataset: Dataset, content: str) -> None:
    dataset.brick()
    path = dataset.write("scenes/one.scene_instance.json", content)
    with pytest.raises(FormatError) as caught:
        load_habitat_scene(dataset.config, "one")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("objects/brick.object_config.json", {"render_asset": "brick.glb", "units_to_meters": 0}),
        ("objects/brick.object_config.json", {"render_asset": "brick.glb", "is_collidable": 1}),
        ("objects/brick.object_config.json", {"render_asset": "brick.glb", "user_defined": []}),
        ("urdf/chest/chest.ao_config.json", {"urdf_filepath": 3}),
        ("urdf/chest/chest.ao_config.json", {"user_defined": {"receptacle_aabb_x": 3}}),
        ("lighting/l.lighting_config.json", {"lights": [1]}),
        ("lighting/l.lighting_config.json", {"lights": {"a": {"type": "candle"}}}),
        ("lighting/l.lighting_config.json", {"lights": {"a": {"color": [1]}}}),
        ("semantics/s.semantic_config.json", {"region_annotations": [{"poly_loop": [[1, 2]]}]}),
        ("semantics/s.semantic_config.json", {"region_annotations": {"a": 1}}),
        ("semantics/s.semantic_config.json", {"region_annotations": [{"poly_loop": [[0, 0, 0]] * 20_000}]}),
    ],
)
def test_wrong_configs_name_key_and_file(dataset: Dataset, file: str, content: Any) -> None:
    dataset.brick()
    path = dataset.json(file, content)
    dataset.json("lighting/l.lighting_config.json", content) if "light" in file else None
    with pytest.raises(FormatError) as caught:
        dataset.load(
            BRICK,
            articulated=[{"template_name": "chest"}],
            default_lighting="l" if "light" in file else "",
            semantic_scene_instance="s" if "semantic" in file else "",
        )
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("value", ["NaN", "-Infinity"])
def test_numbers_that_are_none_name_their_key(dataset: Dataset, value: str) -> None:
    content = '{"object_instances": [{"template_name": "brick", "translation": [0, VALUE, 0]}]}'.replace("VALUE", value)
    path = dataset.write("scenes/one.scene_instance.json", content)
    with pytest.raises(FormatError, match=f"{value.strip('-')} under 'translation' .*{path.name}"):
        load_habitat_scene(dataset.config, "one")


def test_a_stage_of_no_size_is_left_out(dataset: Dataset) -> None:
    dataset.json("stages/room.stage_config.json", {"render_asset": "room.glb", "scale": [1, 0, 1]})
    assert any("the stage is left out: its size is 0" in w for w in dataset.load().source["warnings"])


def test_receptacles_that_cannot_be_used_are_told_with_their_file(dataset: Dataset) -> None:
    wrong = {
        "receptacle_aabb_text": "top",
        "receptacle_aabb_thin": {"position": [0, 0, 0], "scale": [0, 1, 1]},
        "receptacle_mesh_gone": {"mesh_filepath": "gone.ply"},
    }
    dataset.brick(user_defined=wrong)
    path = dataset.root / "objects/brick.object_config.json"
    warnings = dataset.load(BRICK).source["warnings"]
    for key in wrong:
        assert any(f"receptacle {key} is left out" in w and w.endswith(str(path)) for w in warnings), key


def test_assets_that_cannot_be_used_leave_out_their_objects(dataset: Dataset) -> None:
    empty = trimesh.Trimesh(vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces=np.zeros((0, 3), int))
    for name, write in {
        "damaged": lambda p: p.write_bytes(b"glTF\x02\0\0\0"),
        "empty": lambda p: empty.export(p),
        "nothing": lambda p: None,
        "config": lambda p: p.write_text("{}"),
    }.items():
        ending = {"empty": "ply", "config": "json"}.get(name, "glb")
        write(dataset.write(f"objects/{name}.{ending}", ""))
        dataset.json(f"objects/{name}.object_config.json", {"render_asset": f"{name}.{ending}"})
    dataset.json("objects/circle.object_config.json", {"render_asset": "circle.object_config.json"})
    names = ("damaged", "empty", "nothing", "config", "circle")
    scene = dataset.load(*({"template_name": n} for n in names))
    assert [i.name for i in scene.instances] == ["stage"]
    for name in names:
        assert any(f"'{name}' is left out" in w for w in scene.source["warnings"]), name
    assert any("the file is empty" in w and "nothing.glb" in w for w in scene.source["warnings"])


def test_triangles_without_area_do_not_disturb(dataset: Dataset) -> None:
    flat = trimesh.Trimesh(
        vertices=[[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 1]], faces=[[0, 1, 2], [0, 0, 1], [0, 1, 3]], process=False
    )
    dataset.mesh("objects/flat.glb", flat)
    dataset.json("objects/flat.object_config.json", {"render_asset": "flat.glb"})
    scene = dataset.load({"template_name": "flat"}, options={"strict": True})
    assert np.isfinite(scene.bounds).all()
    assert len(scene.assets["flat"].shapes) == 1


def test_mirrored_objects_are_allowed(dataset: Dataset) -> None:
    dataset.brick()
    scene = dataset.load({**BRICK, "non_uniform_scale": [-1, 1, 1], "translation_origin": "asset_local"})
    np.testing.assert_allclose(instance_bounds(scene, scene.instances[1]), [[-1, -2, -3], [1, 2, 3]], atol=1e-6)


def test_gzip_that_unpacks_out_of_proportion_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("h3data.interop.sniff")  # its name is that of the function in the package
    monkeypatch.setattr(module, "UNPACKED_BYTES", 1 << 16)
    bomb = tmp_path / "x.scene_instance.json.gz"
    bomb.write_bytes(gzip.compress(b" " * (1 << 20)))
    assert sniff(bomb) == "unknown"
    with pytest.raises(FormatError, match=r"unpack to more than .*x\.scene_instance\.json\.gz"):
        module.read_bytes(bomb)
    fine = tmp_path / "y.json.gz"
    fine.write_bytes(gzip.compress(b'{"stage_instance": {}}'))
    assert sniff(fine) == "scene_instance"


def test_a_loop_of_links_ends(dataset: Dataset) -> None:
    (dataset.root / "urdf" / "again").symlink_to(dataset.root / "urdf")
    config = json.loads(dataset.config.read_text())
    config["articulated_objects"]["paths"] = {".urdf": ["urdf/**"]}
    dataset.json(dataset.config.name, config)
    assert len(dataset.chest().instances) == 4


# --- the short ways in ------------------------------------------------------------------------------------------------
def test_open_gives_scenes_and_lists_of_scenes(dataset: Dataset, tmp_path: Path) -> None:
    scene = dataset.load(articulated=[{"template_name": "chest"}])
    dataset.json("scenes/two.scene_instance.json", {"stage_instance": {"template_name": "room"}})
    listed = h3data.open(dataset.config)
    assert listed.scenes == ["one", "two"]
    assert "one, two" in repr(listed)
    assert scene_digest(h3data.open(f"{dataset.config}#one")) == scene_digest(scene)
    by_file = h3data.open(dataset.root / "scenes" / "one.scene_instance.json")
    assert scene_digest(by_file) == scene_digest(scene)
    save_scene(scene, tmp_path / "ours.glb")
    assert scene_digest(h3data.open(tmp_path / "ours.glb")) == scene_digest(scene)
    assert h3data.open(dataset.root / "stages" / "room.glb").name == "room"
    for missing in (f"{tmp_path}/x.scene_dataset_config.json", f"{tmp_path}/x.scene_dataset_config.json#one"):
        with pytest.raises(H3DataError, match=r"no such.*x\.scene_dataset_config\.json"):
            h3data.open(missing)


def test_open_says_what_to_do_with_other_files_of_habitat(dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / "flat.navmesh").write_bytes(b"TESM" + bytes(100))
    for path, hint in {
        dataset.json("val.json", {"episodes": []}): "read_episodes",
        dataset.json("lighting/l.lighting_config.json", {"lights": {}}): "open a scene that names it",
        tmp_path / "flat.navmesh": "read_navmesh",
    }.items():
        with pytest.raises(FormatError, match=f"{hint}.*{path.name}"):
            h3data.open(path)


def test_the_scenes_command_takes_them(dataset: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    dataset.brick()
    dataset.load({"template_name": "brick", "uniform_scale": 0}, articulated=[{"template_name": "chest"}])
    dataset.json("scenes/two.scene_instance.json", {"stage_instance": {"template_name": "room"}})
    assert main(["scenes", "list", str(dataset.config)]) == 0
    assert capsys.readouterr().out.split() == [f"{dataset.config}#one", f"{dataset.config}#two"]
    one, picture = f"{dataset.config}#one", dataset.root / "one.png"
    assert main(["scenes", "show", one, "-o", str(picture)]) == 0
    assert picture.stat().st_size > 1000
    assert main(["scenes", "show", str(dataset.config), "-o", str(dataset.root / "x.png")]) == 2
    assert "#one, #two" in capsys.readouterr().err
    assert main(["scenes", "show", one, "-o", str(picture), "--force", "--strict"]) == 2
    assert "its size is 0" in capsys.readouterr().err
    assert main(["scenes", "validate", one, "--strict"]) == 2
    assert main(["scenes", "validate", one]) in (0, 1)
    assert "chest_:0000/base / chest_:0000/b_drawer" not in capsys.readouterr().out
    alone = str(dataset.root / "objects" / "brick.object_config.json")
    assert main(["scenes", "show", alone, "-o", str(dataset.root / "brick.png")]) == 0  # nobody can stand there


def test_the_scenes_command_looks_below_asset_folders(
    dataset: Dataset, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset.brick(render_asset="data/fpss/objects/9/brick.glb")
    with pytest.raises(MissingAssetError):
        dataset.load({"template_name": "brick"})
    root = tmp_path_factory.mktemp("downloads")
    file = root / "hssd-hab" / "objects" / "9" / "brick.glb"
    file.parent.mkdir(parents=True)
    os.rename(dataset.root / "objects" / "brick.glb", file)
    assert main(["scenes", "list", f"{dataset.config}#one"]) == 2
    assert main(["scenes", "list", f"{dataset.config}#one", "--assets", str(root), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"][0]["movable"] == 1
