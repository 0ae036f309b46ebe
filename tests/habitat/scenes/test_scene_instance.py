"""Habitat scenes: real test scenes of habitat-sim, small ones written here, and broken ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from h3data.errors import FormatError, H3DataError, MissingAssetError, SceneError
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Box, Hull, Scene, instance_bounds
from h3data_habitat.scenes.node_boxes import node_box
from h3data_habitat.scenes.receptacles import largest_rectangle
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from tests.paths import TEST_ASSETS

needs_real = pytest.mark.skipif(not TEST_ASSETS.is_dir(), reason="habitat-sim's test assets are not on this machine")
S = 0.5**0.5


# --- real scenes ------------------------------------------------------------------------------------------------------
ROOM = [[-5.247, -0.0614, -5.4486], [5.2798, 2.1535, 5.3979]]


@needs_real
@pytest.mark.parametrize("file", ["simple_room.stage_config.json", "simple_room.glb"])
def test_simple_room_with_and_without_its_config(file: str) -> None:
    scene = load_habitat_scene(TEST_ASSETS / "scenes" / file)
    np.testing.assert_allclose(scene.bounds, ROOM, atol=1e-3)
    assert [i.name for i in scene.instances] == ["stage"]
    assert scene.assets["simple_room"].shapes == ()
    assert scene.source["kind"] == "habitat"
    assert scene.source["warnings"] == []


@needs_real
def test_simple_room_receptacles_lie_just_above_its_furniture() -> None:
    scene = load_habitat_scene(TEST_ASSETS / "scenes" / "simple_room.stage_config.json")
    block, table = (r for _, r in scene.receptacles())
    # the block is 1.37..3.37 x -2.39..-0.39 x ..2.15 in the file (z up), the table -0.45..0.95 squared at 1.15
    np.testing.assert_allclose(block.center, [2.369, 2.225, 1.393], atol=2e-3)
    np.testing.assert_allclose(block.half_size, [1, 1], atol=1e-6)
    assert block.clearance_m == pytest.approx(0.783, abs=1e-3)
    np.testing.assert_allclose(table.center, [0.25, 1.1675, -0.25], atol=1e-3)
    np.testing.assert_allclose(table.half_size, [0.7, 0.7], atol=1e-3)
    assert table.name == "receptacle_mesh_simpleroom_test.0000"


@needs_real
def test_dataset_0_scene() -> None:
    folder = TEST_ASSETS / "dataset_tests" / "dataset_0"
    scene = load_habitat_scene(folder / "test_dataset_0.scene_dataset_config.json")
    assert [i.name for i in scene.instances] == ["stage", "dataset_test_object1_:0000", "dataset_test_object2_:0000"]
    # asset_local: the translation is that of the asset's origin, whatever its centre of mass
    np.testing.assert_allclose(scene.instances[1].pose, [0.1, 0.2, 0.3, 0, 0, 0, 1], atol=1e-12)
    # the dataset's scale (1) wins over the stage config's (2); the stage's own translation is ignored
    np.testing.assert_array_equal(scene.instances[0].scale, [1, 1, 1])
    np.testing.assert_array_equal(scene.instances[0].pose[:3], [0, 0, 0])
    assert any("ignored" in w for w in scene.source["warnings"])
    same = load_habitat_scene(folder / "scenes" / "dataset_test_scene.scene_instance.json")
    assert [i.name for i in same.instances] == [i.name for i in scene.instances]


@needs_real
def test_dataset_1_has_two_scenes_and_folders_by_pattern() -> None:
    config = TEST_ASSETS / "dataset_tests" / "dataset_1" / "test_dataset_1.scene_dataset_config.json"
    for missing in (None, "kitchen"):
        with pytest.raises(SceneError, match=r"(?s)dataset_test_scene_0, dataset_test_scene_1.*H3-HABITAT-12[89]"):
            load_habitat_scene(config, missing)
    with pytest.raises(SceneError, match=r"(?s)^2 .*H3-HABITAT-130"):
        load_habitat_scene(config, "dataset_test_scene")
    scene = load_habitat_scene(config, "scene_1")
    assert scene.name == "dataset_test_scene_1"
    assert len(scene.instances) == 3
    assert any("modified_test_stage_0" in w for w in scene.source["warnings"])  # the scene says modified_test_stage


@needs_real
def test_habitats_object_origin_is_the_middle_of_its_node_boxes() -> None:
    """Measured from habitat-sim's own poses (room_rigid): 5boxes has turned nodes, where the mesh's own box differs."""
    np.testing.assert_allclose(node_box(TEST_ASSETS / "objects" / "5boxes.glb").mean(0), [0.2929, -2.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(
        node_box(TEST_ASSETS / "objects" / "chair.glb").mean(0), [-0.0740, -0.2070, 0.0059], atol=1e-4
    )


# --- small datasets ---------------------------------------------------------------------------------------------------
class Dataset:
    """A dataset folder to which a test adds what it needs."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.config = root / "home.scene_dataset_config.json"
        self.json(
            "home.scene_dataset_config.json",
            {
                "stages": {"paths": {".json": ["stages"]}},
                "objects": {"paths": {".json": ["objects/*", "objects"], ".glb": ["bare"]}},
                "scene_instances": {"paths": {".json": ["scenes"]}},
            },
        )
        self.brick("stages/room.glb", (10, 0.2, 8), (0, -0.1, 0))
        self.json("stages/room.stage_config.json", {"render_asset": "room.glb"})

    def json(self, name: str, content: Any) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    def brick(self, name: str, size: tuple[float, ...], center: tuple[float, ...] = (0, 0, 0)) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh = trimesh.creation.box(extents=size)
        mesh.apply_translation(center)
        mesh.export(path)

    def scene(self, *objects: dict[str, Any], **more: Any) -> Scene:
        content = {"stage_instance": {"template_name": "stages/room"}, "object_instances": list(objects), **more}
        self.json("scenes/one.scene_instance.json", content)
        return load_habitat_scene(self.config, "one")


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    made = Dataset(tmp_path)
    made.brick("objects/0/brick.glb", (2, 4, 6), (1, 2, 3))  # from the origin to (2, 4, 6)
    made.json("objects/0/brick.object_config.json", {"render_asset": "brick.glb", "semantic_id": 7})
    return made


def test_object_poses_are_moved_from_the_centre_of_mass(dataset: Dataset) -> None:
    turn = [S, 0, S, 0]  # w x y z: 90 degrees about y, (x, y, z) -> (z, y, -x)
    here = {"template_name": "brick", "translation": [10, 0, 0], "rotation": turn}
    scene = dataset.scene(
        here,
        {**here, "translation_origin": "asset_local"},
        {**here, "uniform_scale": 0.5},
        {**here, "motion_type": "STATIC", "non_uniform_scale": [1, 2, 1]},
    )
    com, local, half, tall = scene.instances[1:]
    np.testing.assert_allclose(com.pose[:3], [10 - 3, -2, 1], atol=1e-6)
    np.testing.assert_allclose(com.pose[3:], [0, S, 0, S], atol=1e-9)
    np.testing.assert_allclose(instance_bounds(scene, com).mean(0), [10, 0, 0], atol=1e-6)
    np.testing.assert_allclose(local.pose[:3], [10, 0, 0], atol=1e-12)
    np.testing.assert_allclose(instance_bounds(scene, half), [[8.5, -1, -0.5], [11.5, 1, 0.5]], atol=1e-6)
    np.testing.assert_allclose(instance_bounds(scene, tall), [[7, -4, -1], [13, 4, 1]], atol=1e-6)
    assert [i.motion for i in scene.instances] == ["static", "kinematic", "kinematic", "kinematic", "static"]
    assert [i.name for i in scene.instances[1:]] == [f"brick_:{k:04d}" for k in range(4)]
    assert com.semantic_id == 7


def test_scene_wide_origin_and_config_com(dataset: Dataset) -> None:
    dataset.json("objects/0/brick.object_config.json", {"render_asset": "brick.glb", "COM": [0, 1, 0]})
    scene = dataset.scene(
        {"template_name": "brick"},
        {"template_name": "brick", "translation_origin": "com"},
        translation_origin="ASSET_LOCAL",
    )
    np.testing.assert_array_equal(scene.instances[1].pose[:3], [0, 0, 0])
    np.testing.assert_array_equal(scene.instances[2].pose[:3], [0, -1, 0])


def test_collision_shapes(dataset: Dataset) -> None:
    base = {"render_asset": "0/brick.glb"}
    dataset.json("objects/hull.object_config.json", base)
    dataset.json("objects/crate.object_config.json", {**base, "use_bounding_box_for_collision": True})
    dataset.json("objects/ghost.object_config.json", {**base, "is_collidable": False})
    dataset.json(
        "objects/ball.object_config.json",
        {**base, "collision_asset": "icosphereSolid_subdivs_1", "collision_asset_size": [0.25] * 3},
    )
    names = ("hull", "crate", "ghost", "ball")
    scene = dataset.scene(*({"template_name": n} for n in names))
    (hull,), (crate,), ghost, (ball,) = (scene.assets[n].shapes for n in names)
    assert isinstance(hull, Hull)
    np.testing.assert_allclose([hull.points.min(0), hull.points.max(0)], [[0, 0, 0], [2, 4, 6]], atol=1e-6)
    assert isinstance(crate, Box)
    np.testing.assert_allclose(crate.half_extents, [1, 2, 3])
    np.testing.assert_allclose(crate.pose[:3], [1, 2, 3])
    assert ghost == ()
    assert isinstance(ball, Hull)
    np.testing.assert_allclose(np.linalg.norm(ball.points, axis=1), 0.25, atol=1e-6)


def test_templates_defaults_overrides_and_directives(dataset: Dataset) -> None:
    config = json.loads(dataset.config.read_text())
    config["objects"]["default_attributes"] = {"semantic_id": 1, "scale": [2, 2, 2]}
    config["objects"]["configs"] = [
        {
            "original_file": "objects/0/brick.object_config.json",
            "template_handle": "slick",
            "attributes": {"scale": [3, 3, 3]},
        },
        {"template_handle": "made_here", "attributes": {"render_asset": "objects/0/brick.glb", "semantic_id": 9}},
    ]
    dataset.json("home.scene_dataset_config.json", config)
    dataset.brick("objects/vase.glb", (1, 1, 1))
    dataset.json("objects/vase.object_config.json", {"render_asset": "%%CONFIG_NAME_AS_ASSET_FILENAME%%.glb"})
    dataset.brick("bare/lamp.glb", (1, 1, 1))
    scene = dataset.scene(*({"template_name": n} for n in ("brick", "slick", "made_here", "vase", "lamp")))
    assert [(i.asset, i.scale[0], i.semantic_id) for i in scene.instances[1:]] == [
        ("brick", 2, 7),
        ("slick", 3, 7),
        ("made_here", 2, 9),
        ("vase", 2, 1),
        ("lamp", 2, 1),
    ]


def test_a_name_finds_its_best_match(dataset: Dataset) -> None:
    for folder in ("a", "b"):
        dataset.brick(f"objects/{folder}/chair.glb", (1, 1, 1))
        dataset.json(f"objects/{folder}/chair.object_config.json", {"render_asset": "chair.glb"})
    dataset.json("objects/a/chair_big.object_config.json", {"render_asset": "chair.glb"})
    scene = dataset.scene({"template_name": "objects/b/chair"}, {"template_name": "air_b"}, {"template_name": "chair"})
    assert [i.asset for i in scene.instances[1:]] == ["chair", "chair_big", "chair~"]
    assert any("2 templates match 'chair'" in w for w in scene.source["warnings"])


def test_receptacles_of_objects(dataset: Dataset) -> None:
    """Boxes are volumes above a surface in the file's frame; a mesh gives the largest rectangle that it covers."""
    el = trimesh.Trimesh(
        vertices=[[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 3, 0], [0, 3, 0]],
        faces=[[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]],
        process=False,
    )
    el.export(dataset.root / "objects" / "0" / "top.ply")
    dataset.json(
        "objects/0/brick.object_config.json",
        {
            "render_asset": "brick.glb",
            "up": [0, 0, 1],
            "front": [0, 1, 0],
            "user_defined": {
                "receptacle_aabb_top": {"name": "receptacle_aabb_top", "position": [1, 2, 6.25], "scale": [1, 2, 0.25]},
                "receptacle_mesh_top": {"position": [0, 0, 0], "scale": [1, 1, 1], "mesh_filepath": "top.ply"},
                "receptacle_mesh_lost": {"position": [0, 0, 0], "scale": [1, 1, 1], "mesh_filepath": "lost.ply"},
                "receptacle_aabb_bad": {"position": "here"},
                "other": 3,
            },
        },
    )
    scene = dataset.scene({"template_name": "brick", "motion_type": "STATIC"})
    box, mesh = scene.assets["brick"].receptacles
    np.testing.assert_allclose(box.center, [1, 6, -2], atol=1e-9)
    np.testing.assert_allclose(box.half_size, [1, 2], atol=1e-9)
    assert box.clearance_m == pytest.approx(0.5)
    assert mesh.name == "receptacle_mesh_top.0000"
    np.testing.assert_allclose(mesh.center, [0.5, 0, -1.5], atol=0.05)  # the 1 x 3 leg of the L, not the 2 x 1 one
    np.testing.assert_allclose(mesh.half_size, [0.5, 1.5], atol=0.05)
    assert len([w for w in scene.source["warnings"] if "is left out" in w]) == 2
    assert sorted(f"{i.name}|{r.name}" for i, r in scene.receptacles())[0] == "brick_:0000|receptacle_aabb_top"


def test_turned_stage_boxes_shrink_to_what_fits_inside(tmp_path: Path) -> None:
    made = Dataset(tmp_path)
    c, s = np.cos(np.pi / 8), np.sin(np.pi / 8)  # 45 degrees about y
    entry = {"position": [0, 1, 0], "scale": [1, 0.1, 1], "rotation": [c, 0, s, 0]}
    tilted = {**entry, "rotation": [c, s, 0, 0]}
    made.json(
        "stages/room.stage_config.json",
        {"render_asset": "room.glb", "user_defined": {"receptacle_aabb_a": entry, "receptacle_aabb_b": tilted}},
    )
    scene = made.scene()
    (receptacle,) = scene.assets["room"].receptacles
    np.testing.assert_allclose(receptacle.half_size, [S, S], atol=1e-6)
    assert any("receptacle_aabb_b" in w for w in scene.source["warnings"])


def test_largest_rectangle_never_leaves_the_surface() -> None:
    angle = np.arange(48) * 2 * np.pi / 48
    rim = np.stack([np.cos(angle), np.zeros(48), np.sin(angle)], 1)
    vertices = np.concatenate([[[0, 0, 0]], rim]).astype(np.float32)
    faces = np.array([[0, 1 + i, 1 + (i + 1) % 48] for i in range(48)], np.int32)
    disc = Mesh(vertices=vertices, faces=faces, colors=np.zeros((49, 3), np.uint8))
    found = largest_rectangle(vertices.astype(np.float64), disc)
    assert found is not None
    center, half = found
    assert np.linalg.norm(np.abs(center[[0, 2]]) + half) < 1.001  # its corners lie on the disc
    assert 4 * half[0] * half[1] > 1.85  # the best one has area 2


@pytest.mark.parametrize("value", [1.5, -5, 1e20, True, "7"])
def test_semantic_ids_are_whole_numbers(dataset: Dataset, value: object) -> None:
    dataset.json("objects/0/brick.object_config.json", {"render_asset": "brick.glb", "semantic_id": value})
    with pytest.raises(FormatError, match=r"(?s)semantic_id.*H3-HABITAT-112"):
        dataset.scene({"template_name": "brick"})


# --- broken input -----------------------------------------------------------------------------------------------------
def test_missing_meshes_are_an_error_unless_allowed(dataset: Dataset) -> None:
    (dataset.root / "objects" / "0" / "brick.glb").unlink()
    with pytest.raises(MissingAssetError, match="H3-HABITAT-119"):
        dataset.scene({"template_name": "brick"})
    scene = load_habitat_scene(dataset.config, "one", allow_missing=True)
    assert [i.name for i in scene.instances] == ["stage"]
    assert any("do not exist" in w for w in scene.source["warnings"])
    with pytest.raises(
        SceneError, match=r"(?s)'sofa'; nothing is found below its paths 'objects', 'bare'.*H3-HABITAT-133"
    ):
        dataset.scene({"template_name": "sofa"})
    assert len(load_habitat_scene(dataset.config, allow_missing=True).instances) == 1


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("home.scene_dataset_config.json", "{"),
        ("home.scene_dataset_config.json", []),
        ("home.scene_dataset_config.json", {"stages": 3}),
        ("home.scene_dataset_config.json", {"scene_instances": {"paths": {".json": ["nowhere"]}}}),
        ("stages/room.stage_config.json", {"render_asset": "room.glb", "up": [0, 0]}),
        (
            "stages/room.stage_config.json",
            {"render_asset": "room.glb", "up": [0, 0, 1]},
        ),  # front is parallel to nothing
        ("stages/room.stage_config.json", {"render_asset": 5}),
        ("stages/room.stage_config.json", {"render_asset": "room.glb", "scale": ["a", 1, 1]}),
        ("stages/room.stage_config.json", {"render_asset": "room.glb", "units_to_meters": "m"}),
        ("scenes/one.scene_instance.json", {"stage_instance": {"template_name": "castle"}}),
        ("scenes/one.scene_instance.json", {"stage_instance": {}}),
        ("scenes/one.scene_instance.json", {"object_instances": [3]}),
        ("scenes/one.scene_instance.json", {"object_instances": [{"template_name": "brick", "rotation": [1, 0]}]}),
        ("scenes/one.scene_instance.json", {"object_instances": [{"template_name": "brick", "uniform_scale": None}]}),
        ("scenes/one.scene_instance.json", {"object_instances": {"a": 1}}),
        ("scenes/one.scene_instance.json", "nonsense"),
    ],
)
def test_broken_configs_give_one_clear_line(dataset: Dataset, file: str, content: Any) -> None:
    dataset.scene({"template_name": "brick"})
    dataset.json(file, content)
    with pytest.raises(H3DataError) as caught:
        load_habitat_scene(dataset.config, "one")
    assert "\n" not in str(caught.value)
    assert str(dataset.root) in str(caught.value)


def test_files_that_are_no_scenes(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="H3-HABITAT-125"):
        load_habitat_scene(tmp_path / "x.glb")
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(FormatError, match=r"(?s)scene_instance.*H3-HABITAT-124"):
        load_habitat_scene(tmp_path / "x.txt")
    made = Dataset(tmp_path / "d")
    stray = made.json("elsewhere/x.scene_instance.json", {})
    with pytest.raises(SceneError, match="H3-HABITAT-121"):
        load_habitat_scene(stray)
    with pytest.raises(SceneError, match="H3-HABITAT-126"):
        load_habitat_scene(tmp_path / "d" / "stages" / "room.glb", "one")
