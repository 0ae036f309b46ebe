"""Habitat scenes opened: where files are looked for, what is wrong in them, and the short ways in."""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import h3data
from h3data.errors import FormatError, H3DataError, MissingAssetError, SceneError
from h3data.formats import SourceFile, detect
from h3data.scene import save_scene, scene_digest
from h3data.scene.records import instance_bounds
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data_pipelines.cli import main
from tests.habitat.scenes.dataset_folder import Dataset


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset(tmp_path)


# --- files ------------------------------------------------------------------------------------------------------------
def test_a_config_cannot_reach_out_of_its_dataset(tmp_path: Path) -> None:
    made = Dataset(tmp_path / "home" / "set")
    made.brick()
    os.rename(made.root / "objects" / "brick.glb", tmp_path / "brick.glb")
    made.json("objects/brick.object_config.json", {"render_asset": "../../../brick.glb"})
    scene = made.load({"template_name": "brick"})
    assert [i.name for i in scene.instances] == ["stage"]
    assert any("leads out of the dataset" in w and "assets=" in w for w in scene.source["warnings"])
    with pytest.raises(SceneError, match=r"(?s)leads out.*H3-HABITAT-120"):
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
    with pytest.raises(MissingAssetError, match=r"(?s)looked for.*data/fpss.*H3-HABITAT-119"):
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
    with pytest.raises(SceneError, match=r"(?s)'two'.*H3-HABITAT-129"):
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
    with pytest.raises(SceneError, match="H3-HABITAT-120"):
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
    dataset.write("scenes/one.scene_instance.json", content)
    with pytest.raises(FormatError, match="H3-FORMAT-012"):
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
    monkeypatch.setattr("h3data.formats.source_file.UNPACKED_BYTES", 1 << 16)
    bomb = tmp_path / "x.scene_instance.json.gz"
    bomb.write_bytes(gzip.compress(b" " * (1 << 20)))
    assert detect(bomb).name == "unknown"
    with pytest.raises(FormatError, match=r"(?s)x\.scene_instance\.json\.gz.*H3-FORMAT-016"):
        _ = SourceFile(bomb).data
    fine = tmp_path / "y.json.gz"
    fine.write_bytes(gzip.compress(b'{"stage_instance": {}}'))
    assert detect(fine).name == "scene_instance"


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
        with pytest.raises(H3DataError, match=r"(?s)x\.scene_dataset_config\.json.*(H3-FORMAT-013|H3-HABITAT-125)"):
            h3data.open(missing)


def test_open_says_what_to_do_with_other_files_of_habitat(dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / "flat.navmesh").write_bytes(b"TESM" + bytes(100))
    for path, hint in {
        dataset.json("val.json", {"episodes": []}): "--episodes-file",
        dataset.json("lighting/l.lighting_config.json", {"lights": {}}): "open a scene that names it",
        tmp_path / "flat.navmesh": "read_navmesh",
    }.items():
        with pytest.raises(FormatError, match=f"(?s){hint}.*H3-RECORDING-048"):
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
