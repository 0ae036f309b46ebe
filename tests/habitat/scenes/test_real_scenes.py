"""Every scene file among habitat-sim's own test assets loads, and no key in them is overlooked."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.geometry import pose_to_matrix
from h3data.mesh.loading import MESH_SUFFIXES
from h3data.render import Renderer
from h3data.render.camera import pinhole
from h3data.render.sheets.scene_map import render_scene
from h3data.scene import FreeSpace, Scene
from h3data_habitat.navmesh.file import read_navmesh
from h3data_habitat.navmesh.navmesh import free_space_from_navmesh
from h3data_habitat.scenes.articulated import (
    default_positions,
    joint_order,
    link_frames,
    pose_of_links,
    read_links,
)
from h3data_habitat.scenes.config_keys import IGNORED, IGNORED_FILES, READ, KeyNotes, ignored_table
from h3data_habitat.scenes.lights import read_lights
from h3data_habitat.scenes.scene_dataset import DATASET_ENDING, load_scene_dataset
from h3data_habitat.scenes.scene_instance import HABITAT_ENDINGS, load_habitat_scene
from h3data_habitat.scenes.semantics import read_rooms
from tests.paths import HABITAT_SIM, ROOT

ASSETS = HABITAT_SIM / "data" / "test_assets"
REFERENCE = HABITAT_SIM / "reference"
pytestmark = pytest.mark.skipif(not ASSETS.is_dir(), reason="habitat-sim's test assets are not on this machine")

FILES = [str(p.relative_to(HABITAT_SIM)) for p in sorted(HABITAT_SIM.rglob("*")) if p.is_file()]


def names(*endings: str) -> list[str]:
    return [f for f in FILES if f.lower().endswith(endings)]


# --- everything loads -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("file", names(*(e for e in HABITAT_ENDINGS if e not in (*MESH_SUFFIXES, DATASET_ENDING))))
def test_every_config_and_urdf_loads(file: str) -> None:
    scene = load_habitat_scene(HABITAT_SIM / file)
    assert len(scene.instances) >= 1
    assert not [w for w in scene.source["warnings"] if "left out" in w or "not known" in w]
    assert np.isfinite(scene.bounds).all()


@pytest.mark.parametrize("file", names(".glb", ".gltf"))
def test_every_mesh_loads_as_a_stage(file: str) -> None:
    scene = load_habitat_scene(HABITAT_SIM / file)
    assert [i.name for i in scene.instances] == ["stage"]
    assert len(scene.assets[scene.instances[0].asset].mesh.faces) > 0


@pytest.mark.parametrize("file", names(DATASET_ENDING))
def test_every_scene_of_every_dataset_loads(file: str) -> None:
    dataset = load_scene_dataset(HABITAT_SIM / file)
    assert dataset.scenes
    assert dataset.scenes[0] in repr(dataset)
    for name in dataset.scenes:
        scene = load_habitat_scene(f"{HABITAT_SIM / file}#{name}")
        assert scene.name == name
        assert scene.lights is not None
        assert [light.intensity for light in scene.lights] == [2.4, 2.1, -0.5]
        assert [light.kind for light in scene.lights] == ["point"] * 3


@pytest.mark.parametrize("file", names(".lighting_config.json"))
def test_every_lighting_config_is_read(file: str) -> None:
    content, keys = json.loads((HABITAT_SIM / file).read_text()), KeyNotes()
    lights = read_lights(content, keys, where=HABITAT_SIM / file)
    assert [light.name for light in lights] == list(content["lights"])
    assert not keys.unknown
    for light in lights:
        entry = content["lights"][light.name]
        np.testing.assert_array_equal(light.vector, entry.get("position", entry.get("direction")))
        assert light.intensity == entry["intensity"]


@pytest.mark.parametrize("file", names(".semantic_config.json"))
def test_every_semantic_config_gives_rooms(file: str) -> None:
    keys = KeyNotes()
    rooms, warnings = read_rooms(json.loads((HABITAT_SIM / file).read_text()), keys, where=HABITAT_SIM / file)
    assert warnings == []
    assert not keys.unknown
    assert [(r.name, r.category, r.floor_y) for r in rooms] == [
        ("test_region_negativeX", "bedroom", -2.0),
        ("test_region_positiveX", "bathroom", -2.0),
    ]
    for room in rooms:  # hexagons of 10 m between two triangles of 5 m, 20 m long
        x0, z0, x1, z1 = room.rectangles.T
        assert np.sum((x1 - x0) * (z1 - z0)) == pytest.approx(300)
        assert (x0.min(), x1.max()) == pytest.approx((-25, -5) if "negative" in room.name else (5, 25), abs=0.1)


# --- no key is overlooked ---------------------------------------------------------------------------------------------
_ENTRIES = {
    "scene_instance": {
        "stage_instance": "stage_instance",
        "object_instances": "object_instance",
        "articulated_object_instances": "articulated_instance",
    },
    "lighting_config": {"lights": "light"},
    "semantic_config": {"region_annotations": "region"},
}
_SECTIONS = {
    "stages": "stage_config",
    "objects": "object_config",
    "articulated_objects": "ao_config",
    "light_setups": "lighting_config",
    "scene_instances": "scene_instance",
    "semantic_scene_descriptor_instances": "semantic_config",
}


def keys_of(kind: Any, content: dict[str, Any]) -> set[tuple[Any, str]]:
    """Every key with the sort of object in which it stands; written without the reader's help."""
    found = {(kind, key) for key in content}
    for key, inner in _ENTRIES.get(kind, {}).items():
        value = content.get(key, [])
        if key == "stage_instance":
            value = [value] if value else []
        for entry in value.values() if isinstance(value, dict) else value:
            found |= keys_of(inner, entry)
    for key, value in content.get("user_defined", {}).items() if kind != "scene_instance" else ():
        if key.startswith("receptacle_"):
            found |= keys_of("receptacle", value)
    if kind == "scene_dataset_config":
        for section, inner in _SECTIONS.items():
            entry = content.get(section, {})
            if section != "semantic_scene_descriptor_instances":
                found |= {("dataset_section", key) for key in entry}
            found |= keys_of(inner, entry.get("default_attributes", {}))
            for item in entry.get("configs", []):
                found |= {("dataset_override", key) for key in item} | keys_of(inner, item["attributes"])
    return found


def test_every_key_in_the_real_files_is_read_or_listed_with_a_reason() -> None:
    seen: set[tuple[Any, str]] = set()
    unread = []
    for file in names(".json"):
        if not file.startswith("data/"):
            continue
        kind = re.search(r"\.(\w+)\.json$", file)
        if kind is not None and kind[1] in READ:
            seen |= keys_of(kind[1], json.loads((HABITAT_SIM / file).read_text()))
        elif not file.endswith(tuple(IGNORED_FILES)):
            unread.append(file)
    assert unread == []
    assert len(seen) > 60
    assert not [f"{kind}.{key}" for kind, key in seen if key not in READ[kind] and key not in IGNORED[kind]]


def test_the_reader_says_which_keys_it_did_not_read() -> None:
    scene = load_habitat_scene(ASSETS / "objects" / "donut.object_config.json")
    assert {"object_config.mass", "object_config.friction_coefficient"} <= set(scene.source["ignored_keys"])
    config = ASSETS / "dataset_tests" / "dataset_0" / "test_dataset_0.scene_dataset_config.json"
    ignored = load_habitat_scene(config).source["ignored_keys"]
    assert {"stage_config.origin", "stage_config.gravity", "object_config.inertia"} <= set(ignored)


def test_keys_that_count_as_read_are_named_by_the_readers() -> None:
    code = "".join(
        p.read_text() for p in (ROOT / "pipelines" / "h3data_habitat" / "scenes").glob("*.py") if "keys" not in p.name
    )
    for kind, keys in READ.items():
        for key in keys:
            named = f'"{key}"' in code or f"'{key}'" in code
            assert named or (kind == "lighting_config" and 'f"{sign}_intensity_scale"' in code), f"{kind}.{key}"
        assert not set(keys) & set(IGNORED[kind]), kind


def test_the_docs_hold_the_same_table() -> None:
    assert ignored_table() in (ROOT / "docs" / "scenes.md").read_text()


# --- compared with habitat-sim itself ---------------------------------------------------------------------------------
@pytest.mark.parametrize("robot_name", ["fridge", "kuka", "prim_chain", "skinned_prism", "amass_male"])
def test_links_stand_where_habitat_sim_puts_them(robot_name: str) -> None:
    """Over 40 base poses and joint positions, in habitat-sim's own order of joints."""
    truth = json.loads((REFERENCE / "physics" / "forward_kinematics.json").read_text())[robot_name]
    robot, _ = read_links(HABITAT_SIM / truth["urdf"])
    order = joint_order(robot, "default")
    for sample in truth["samples"]:
        positions = default_positions(robot)
        positions[order] = sample["joint_positions"]
        w, x, y, z = sample["base_rotation_wxyz"]
        base = pose_to_matrix(np.array([*sample["base_translation"], x, y, z, w])).astype(np.float64)
        frames = pose_of_links(robot, base, link_frames(robot, positions), scale=1.0)
        for name, world in sample["links"].items():
            index = robot.link_names.index(name)
            np.testing.assert_allclose(frames[index] @ robot.links[index].inertial, world, atol=1e-5)


def room_with(folder: Path, **instances: Any) -> Scene:
    """The simple room with more in it."""
    templates = {
        "stages": {"room": {"render_asset": "scenes/simple_room.glb", "up": [0, 0, 1], "front": [0, 1, 0]}},
        "objects": {"chair": {"render_asset": "objects/chair.glb"}},
        "articulated_objects": {
            "fridge": {"urdf_filepath": "urdf/fridge/fridge.urdf"},
            "model_free_base": {"urdf_filepath": "urdf/kuka_iiwa/model_free_base.urdf"},
            "prim_chain": {"urdf_filepath": "urdf/prim_chain.urdf"},
        },
    }
    config: dict[str, Any] = {
        section: {"configs": [{"template_handle": k, "attributes": v} for k, v in of.items()]}
        for section, of in templates.items()
    }
    config["scene_instances"] = {"paths": {".json": ["."]}}
    (folder / "d.scene_dataset_config.json").write_text(json.dumps(config))
    scene = folder / "s.scene_instance.json"
    scene.write_text(json.dumps({"stage_instance": {"template_name": "room"}, **instances}))
    return load_habitat_scene(scene, assets=[ASSETS], strict=True)


@pytest.mark.parametrize("keyframe", [0, 34])
def test_articulated_objects_look_as_in_habitat_sim(tmp_path: Path, keyframe: int) -> None:
    """Depth of the room with a fridge, an arm and a chain; the fridge's doors are open at keyframe 34."""
    folder = REFERENCE / "replays" / "room_articulated"
    frame = json.loads((folder / "meta.json").read_text())["keyframes"][keyframe]
    entries = [
        {
            "template_name": a["handle"].partition("_:")[0],
            "translation": a["base_translation"],
            "rotation": a["base_rotation_wxyz"],
            "initial_joint_pose": a["joint_positions"],
        }
        for a in frame["articulated"]
    ]
    scene = room_with(tmp_path, articulated_object_instances=entries)
    camera = pinhole(256, 256, hfov_deg=90, pose=np.array(frame["camera_to_world"]) @ np.diag([1, -1, -1, 1]))
    depth = Renderer(render_scene(scene)).render(camera, outputs=("depth",))["depth"]
    truth = np.load(folder / "gt" / f"{keyframe:04d}_depth_256x256.npy")
    assert np.mean(np.abs(depth - truth) > 1e-3) < 2e-3  # silhouettes
    door = next(i for i in scene.instances if i.name == "fridge_:0000/top_door")
    assert len(scene.assets[door.asset].mesh.textures) == 1


def test_free_floor_between_chairs_is_that_of_habitat_sim(tmp_path: Path) -> None:
    folder = REFERENCE / "navmesh" / "simple_room_6chairs"
    reference = json.loads((folder / "reference.json").read_text())
    chairs = [
        {
            "template_name": "chair",
            "translation": o["translation"],
            "rotation": o["rotation_wxyz"],
            "motion_type": "STATIC",
        }
        for o in reference["static_objects"]
    ]
    scene = room_with(tmp_path, object_instances=chairs)
    settings = reference["settings"]
    ours = FreeSpace.from_scene(scene, radius_m=settings["agent_radius"], height_m=settings["agent_height"])
    theirs = free_space_from_navmesh(read_navmesh(folder / "simple_room_6chairs.navmesh"))
    low, high = scene.bounds
    xs, zs = (np.arange(low[k], high[k], 0.1) for k in (0, 2))
    points = np.stack(np.meshgrid(xs, zs), -1).reshape(-1, 2)
    a, b = ours.is_navigable(points), theirs.is_navigable(points)
    assert np.sum(a & b) / np.sum(a | b) > 0.97
    assert len(scene.assets["chair"].shapes) == 3  # seat and two bows of the legs
