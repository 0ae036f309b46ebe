"""Homes in Habitat's formats: what our reader gets back, what habitat-sim needs, and folders that must not be harmed."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from h3data.errors import InputError, SceneError
from h3data.geometry import quat_from_axis_angle, transform_points
from h3data.mesh.loading import load_mesh
from h3data.render import Renderer, look_at, pinhole
from h3data.render.sheets.scene_map import render_scene
from h3data.scene import (
    Asset,
    Box,
    Capsule,
    Cylinder,
    FreeSpace,
    Hull,
    Instance,
    Mesh,
    Receptacle,
    Room,
    Scene,
    instance_bounds,
    instance_matrix,
)
from h3data.scene.articulation import joints_of, posed
from h3data_exporters.glb_write import glb_bytes
from h3data_habitat.exporters import scenes as export_module
from h3data_habitat.exporters.scenes import NAVMESH_SETTINGS, export_habitat, export_habitat_dataset
from h3data_habitat.navmesh.file import read_navmesh
from h3data_habitat.navmesh.navmesh import NavMeshSettings
from h3data_habitat.scenes.colliders import part_mesh, part_points
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data_homes import HomeSpec, build_home

S = 0.5**0.5


def brick(low: tuple[float, ...], high: tuple[float, ...], color: tuple[int, int, int] = (10, 120, 250)) -> Mesh:
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    hull = ConvexHull(corners)
    faces = hull.simplices.astype(np.int32)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    wrong = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[wrong] = faces[wrong][:, ::-1]
    return Mesh(vertices=corners.astype(np.float32), faces=faces, colors=np.tile(np.array(color, np.uint8), (8, 1)))


def pose(x: float, y: float, z: float, axis: tuple[float, ...] = (0, 1, 0), angle: float = 0.0) -> np.ndarray:
    return np.concatenate([[x, y, z], quat_from_axis_angle(np.array(axis, float), np.array(angle))])


def small_scene(*more: Instance, name: str = "tiny") -> Scene:
    """A floor with a window sill, and things of every collision shape."""
    sill = Receptacle(name="sill", center=np.array([0.0, 1.0, 0.0]), half_size=np.array([0.5, 0.1]), clearance_m=0.4)
    top = Receptacle(name="top", center=np.array([0.1, 0.5, 0.0]), half_size=np.array([0.3, 0.2]), clearance_m=0.7)
    shapes = (
        Box(pose=pose(0, 0.25, 0, (0, 1, 0), 0.3), half_extents=np.array([0.3, 0.25, 0.2])),
        Cylinder(pose=pose(0.3, 0.25, 0), radius=0.1, half_height=0.2),
        Capsule(start=np.array([0.0, 0.1, 0.0]), end=np.array([0.0, 0.4, 0.1]), radius=0.1),
        Hull(points=np.random.default_rng(0).normal(size=(12, 3)) * 0.2),
    )
    assets = {
        "ground": Asset(name="ground", mesh=brick((-3, -0.1, -3), (3, 0, 3)), category="floor"),
        "window": Asset(
            name="window", mesh=brick((-0.5, 0, -0.1), (0.5, 1, 0.1)), category="window", receptacles=(sill,)
        ),
        "table": Asset(
            name="table",
            mesh=brick((-0.4, 0, -0.3), (0.5, 0.5, 0.3), (200, 3, 77)),
            category="table",
            shapes=shapes,
            receptacles=(top,),
        ),
        "twin": Asset(
            name="twin",
            mesh=brick((-0.4, 0, -0.3), (0.5, 0.5, 0.3), (200, 3, 77)),
            category="table",
            shapes=shapes,
            receptacles=(top,),
        ),
        "rug": Asset(name="rug", mesh=brick((-1, 0, -1), (1, 0.01, 1)), category="rug"),
    }
    instances = (
        Instance(name="floor", asset="ground", pose=pose(0, 0, 0), semantic_id=2),
        Instance(name="window_0", asset="window", pose=pose(2.9, 0, 0, (0, 1, 0), 0.5 * np.pi), semantic_id=5),
        Instance(name="table_0", asset="table", pose=pose(1, 0, 1, (0, 1, 0), 0.5 * np.pi), semantic_id=20),
        Instance(
            name="table_1", asset="twin", pose=pose(-1, 0.2, 1, (1, 2, 3), 1.0), semantic_id=20, motion="kinematic"
        ),
        Instance(name="table_2", asset="table", pose=pose(-1, 0, -1), semantic_id=21),
        Instance(name="rug_0", asset="rug", pose=pose(0, 0, 0), semantic_id=30),
        *more,
    )
    rooms = (Room(name="only", category="living", rectangles=np.array([[-3.0, -3, 0, 3], [0, -3, 3, 3]])),)
    return Scene(name=name, assets=assets, instances=instances, rooms=rooms)


def triangles(scene: Scene) -> np.ndarray:
    """Middle, area vector and spread of every world triangle, shape [F, 7]: the same whichever corner comes first."""
    found = []
    for instance in scene.instances:
        mesh, matrix = scene.assets[instance.asset].mesh, instance_matrix(instance)
        faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0 else mesh.faces[:, ::-1]
        found.append(transform_points(matrix, mesh.vertices.astype(np.float64))[faces])
    corners = np.concatenate(found)
    middle = corners.mean(1)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    spread = np.linalg.norm(corners - middle[:, None], axis=2).sum(1)
    return np.concatenate([middle, area, spread[:, None]], axis=1)


def surfaces(scene: Scene) -> np.ndarray:
    """World corner, opposite corner and clearance of every receptacle, sorted, shape [R, 7]."""
    rows = []
    for instance, r in scene.receptacles():
        half = np.array([r.half_size[0], 0, r.half_size[1]])
        ends = transform_points(instance_matrix(instance), np.stack([r.center - half, r.center + half]))
        low, high = np.minimum(*ends), np.maximum(*ends)
        rows.append([*low, *high, r.clearance_m])
    out = np.round(np.array(rows), 6)
    return out[np.lexsort(out.T)]


def same_triangles(a: Scene, b: Scene) -> None:
    """Every triangle of each scene is one of the other, within 20 micrometres (float32 poses of the stage's corners)."""
    first, second = triangles(a), triangles(b)
    assert first.shape == second.shape
    assert cKDTree(second).query(first)[0].max() < 2e-5
    assert cKDTree(first).query(second)[0].max() < 2e-5
    np.testing.assert_allclose(first.sum(0), second.sum(0), atol=0.05)


def without_roof(home: Scene) -> Scene:
    """A home of ours (all parts of the building in place) without what faces up from 2.59 m on."""
    assets = dict(home.assets)
    for name in ("walls", "ceiling", "trim"):
        mesh = assets[name].mesh
        corners = mesh.vertices[mesh.faces]
        up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1] > 0
        kept = ~(up & (corners[:, :, 1].min(1) > 2.59))
        textures = None if mesh.face_textures is None else mesh.face_textures[kept]
        assets[name] = replace(assets[name], mesh=replace(mesh, faces=mesh.faces[kept], face_textures=textures))
    return replace(home, assets=assets)


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=3))


@pytest.fixture(scope="module")
def exported(home: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_habitat(home, tmp_path_factory.mktemp("export") / "small_3")


# --- round trip -------------------------------------------------------------------------------------------------------
def test_a_home_comes_back(home: Scene, exported: Path) -> None:
    again = load_habitat_scene(exported)
    assert again.source["warnings"] == []
    same_triangles(without_roof(home), again)
    np.testing.assert_allclose(surfaces(again), surfaces(home), atol=2e-6)

    def things(scene: Scene) -> Counter:
        return Counter(
            (i.semantic_id, i.motion, *np.round(i.pose[:3], 9) + 0.0)
            for i in scene.instances
            if scene.assets[i.asset].category not in export_module.STAGE_CATEGORIES
        )

    assert things(again) == things(home)
    assert again.instances[0].name == "stage"


def test_colours_come_back_exactly(home: Scene, exported: Path) -> None:
    """Whatever happens to vertex colours elsewhere: they travel as a palette and in materials."""

    def triangles(mesh: Mesh, chosen: np.ndarray | slice = slice(None)) -> set[bytes]:
        rows = np.concatenate([mesh.vertices[mesh.faces], mesh.colors[mesh.faces].astype(np.float32)], -1)[chosen]
        return {row.tobytes() for row in rows}

    again = load_habitat_scene(exported)
    for scene_asset in ("sofa", "bed"):
        ours = next(a for a in home.assets.values() if a.category == scene_asset).mesh
        theirs = next(a for n, a in again.assets.items() if n.startswith(f"{scene_asset}_")).mesh
        uniform = (ours.colors[ours.faces] == ours.colors[ours.faces][:, :1]).all((1, 2))
        assert uniform.mean() > 0.9
        assert triangles(ours, uniform) <= triangles(theirs)
        assert len(theirs.textures) == len(ours.textures)


def test_shapes_scales_and_a_sill_come_back(tmp_path: Path) -> None:
    more = (
        Instance(name="tall", asset="table", pose=pose(1, 0, -1, (0, 1, 0), 0.3), scale=np.array([1.0, 2.0, 0.5])),
        Instance(name="mirror", asset="table", pose=pose(2, 0, -2), scale=np.array([-1.0, 1.0, 1.0])),
        Instance(name="big", asset="twin", pose=pose(2, 0, 2), scale=np.full(3, 1.5)),
    )
    scene = small_scene(*more)
    again = load_habitat_scene(export_habitat(scene, tmp_path / "x"))
    same_triangles(scene, again)
    ours = {tuple(r[:6]): r[6] for r in surfaces(scene)}
    theirs = {tuple(r[:6]): r[6] for r in surfaces(again)}
    assert len(ours) == len(theirs) == 6
    near = [min(theirs, key=lambda k, o=o: np.abs(np.array(k) - o).max()) for o in ours]
    np.testing.assert_allclose(np.array(near), np.array(list(ours)), atol=2e-6)
    tall = next(r for i, r in again.receptacles() if np.allclose(i.pose[:3], [1, 0, -1]))
    assert tall.clearance_m == pytest.approx(1.4)  # scaled with the table: habitat-lab scales no receptacle itself
    assert [tuple(i.scale) for i in again.instances] == [(1.0, 1.0, 1.0)] * 8


def test_poses_are_written_as_habitat_reads_them(tmp_path: Path) -> None:
    folder = export_habitat(small_scene(), tmp_path / "x").parent
    content = json.loads((folder / "scenes/tiny.scene_instance.json").read_text())
    table = next(o for o in content["object_instances"] if o["user_defined"]["h3data"]["name"] == "table_0")
    np.testing.assert_allclose(table["rotation"], [S, 0, S, 0], atol=1e-12)  # w x y z
    assert table["translation"] == [1, 0, 1]
    assert table["translation_origin"] == content["translation_origin"] == "asset_local"
    assert [o["motion_type"] for o in content["object_instances"]] == ["STATIC", "KINEMATIC", "STATIC", "STATIC"]
    config = json.loads((folder / "objects" / f"{table['template_name']}.object_config.json").read_text())
    assert config["COM"] == [0, 0, 0]  # so that both of Habitat's origins are the asset's
    assert config["compute_COM_from_shape"] is False
    assert config["use_bounding_box_for_collision"] is False  # habitat-sim would put that box around the COM
    assert config["semantic_id"] == 20
    top = config["user_defined"]["receptacle_aabb_top"]
    assert top["scale"] == [0.3, 0.35, 0.2]  # half extents of the free volume,
    assert top["position"] == pytest.approx([0.1, 0.85, 0.0])  # whose bottom is the surface
    stage = json.loads((folder / "stages/tiny.stage_config.json").read_text())
    assert (stage["up"], stage["front"]) == ([0, 1, 0], [0, 0, -1])  # or habitat-sim takes it as Z-up
    regions = json.loads((folder / "semantics/scenes/tiny.semantic_config.json").read_text())["region_annotations"]
    assert [r["name"] for r in regions] == ["only.0", "only.1"]
    assert regions[0]["label"] == "living"
    rug = next(o for o in content["object_instances"] if o["user_defined"]["h3data"]["name"] == "rug_0")
    assert (
        json.loads((folder / "objects" / f"{rug['template_name']}.object_config.json").read_text())["is_collidable"]
        is False
    )


# --- what habitat-sim needs of a dataset ------------------------------------------------------------------------------
def test_every_reference_leads_to_a_file(exported: Path) -> None:
    folder = exported.parent
    for file in folder.rglob("*.json"):
        content = json.loads(file.read_text(), parse_constant=pytest.fail)
        for key in ("render_asset", "collision_asset"):
            if key in content:
                assert (file.parent / content[key]).is_file(), (file.name, key)
    instance = json.loads((folder / "scenes/home_small_3.scene_instance.json").read_text())
    for path in (
        instance["stage_instance"]["template_name"],
        instance["default_lighting"],
        instance["user_defined"]["scene_filter_file"],
    ):
        assert (folder / path).is_file()
    assert (folder / "semantics/scenes" / instance["semantic_scene_instance"]).is_file()
    config = json.loads(exported.read_text())
    lexicon = config["semantic_scene_descriptor_instances"]["default_attributes"]["semantic_descriptor_filename"]
    assert (folder / "semantics/scenes" / lexicon).resolve().is_file()
    endings = {"stages": "stage_config", "objects": "object_config", "light_setups": "lighting_config"}
    for section, ending in {**endings, "scene_instances": "scene_instance"}.items():
        (where,) = config[section]["paths"][".json"]
        assert list((folder / where).glob(f"*.{ending}.json")), section


def test_no_handle_is_a_part_of_another(exported: Path) -> None:
    """habitat-sim takes the first template whose handle contains the name that a scene gives."""
    folder = exported.parent
    handles = [str(p.relative_to(folder)) for p in folder.rglob("*_config.json")]
    instance = json.loads((folder / "scenes/home_small_3.scene_instance.json").read_text())
    for name in {o["template_name"] for o in instance["object_instances"]}:
        assert sum(name in handle for handle in handles) == 1


def test_filter_names_receptacles_as_habitat_does(home: Scene, exported: Path) -> None:
    content = json.loads((exported.parent / "scene_filter_files/home_small_3.rec_filter.json").read_text())
    again = load_habitat_scene(exported)
    assert sorted(content["active"]) == sorted(f"{i.name}|{r.name}" for i, r in again.receptacles())
    assert len(content["active"]) == sum(1 for _ in home.receptacles()) > 10
    assert {"manually_filtered", "access_filtered", "stability_filtered", "height_filtered"} < set(content)


def test_equal_assets_are_written_once(tmp_path: Path) -> None:
    folder = export_habitat(small_scene(), tmp_path / "x").parent
    meshes = [p.name for p in (folder / "objects").glob("*.glb") if not p.name.endswith(".collider.glb")]
    assert len(meshes) == 2  # the table with its twin, the rug
    handles = {
        o["template_name"]
        for o in json.loads((folder / "scenes/tiny.scene_instance.json").read_text())["object_instances"]
    }
    assert len(handles) == 3  # the table has two semantic ids


def test_scenes_share_the_objects_of_a_dataset(tmp_path: Path) -> None:
    config = export_habitat_dataset([small_scene(), small_scene(name="tiny_1")], tmp_path / "both")
    assert config.name == "both.scene_dataset_config.json"
    objects = sorted(p.name for p in (tmp_path / "both/objects").iterdir())
    alone = export_habitat(small_scene(), tmp_path / "one").parent
    assert objects == sorted(p.name for p in (alone / "objects").iterdir())
    for name in ("tiny", "tiny_1"):
        same_triangles(load_habitat_scene(tmp_path / "both/scenes" / f"{name}.scene_instance.json"), small_scene())
    with pytest.raises(InputError, match="H3-EXPORT-018"):
        export_habitat_dataset([small_scene(), small_scene()], tmp_path / "twice")
    with pytest.raises(InputError, match="H3-EXPORT-017"):
        export_habitat_dataset([], tmp_path / "none")


def test_navmesh_settings_have_habitats_keys(real: Path) -> None:
    theirs = json.loads((real / "habitat-sim/data/test_assets/test_navmeshsettings.json").read_text())
    assert set(theirs) <= set(NAVMESH_SETTINGS)
    assert NAVMESH_SETTINGS["agentRadius"] == 0.25
    assert "includeStaticObjects" not in NAVMESH_SETTINGS, "NavMeshSettings::readFromJSON does not read it"


def test_the_navmesh_is_written_and_named_as_habitat_looks_for_it(home: Scene, exported: Path) -> None:
    """`Simulator::createSceneInstance` loads the file of ``navmesh_instance`` in ``navmesh_instances``."""
    config = json.loads(exported.read_text())
    instance = json.loads((exported.parent / "scenes/home_small_3.scene_instance.json").read_text())
    file = exported.parent / config["navmesh_instances"][instance["navmesh_instance"]]
    navmesh = read_navmesh(file)
    free = FreeSpace.from_scene(home)
    assert navmesh.area_m2 == pytest.approx(free.polygon.area, rel=0.02)  # furniture is left out of it
    settings = navmesh.settings
    assert settings.include_static_objects
    assert (settings.agent_radius, settings.agent_height) == pytest.approx((0.25, 1.41))
    rest = {"agent_radius", "agent_height", "include_static_objects"}
    for name in NavMeshSettings.__dataclass_fields__.keys() - rest:
        assert getattr(settings, name) == pytest.approx(getattr(NavMeshSettings(), name)), (
            "else habitat-sim bakes another"
        )
    assert file == exported.parent / "navmeshes/home_small_3.navmesh"  # where habitat-lab's rearrangement looks


def test_nothing_on_the_roof_can_be_walked_on(exported: Path) -> None:
    """What Recast marks as walkable: triangles less steep than 45 degrees that face up."""
    mesh = load_mesh(exported.parent / "stages/home_small_3.glb")
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    walkable = normal[:, 1] > np.cos(np.radians(45)) * np.linalg.norm(normal, axis=1)
    assert corners[walkable][:, :, 1].max() < 2.55
    assert corners[:, :, 1].max() == pytest.approx(2.7)  # the ceiling is there
    down = normal[:, 1] < -0.9 * np.linalg.norm(normal, axis=1)
    assert np.linalg.norm(normal[down & (corners[:, :, 1].min(1) > 2.55)], axis=1).sum() / 2 > 60  # m2 seen from below


def test_rooms_are_lit_from_all_sides(exported: Path) -> None:
    """habitat-sim's material shader has no ambient light: what faces away from all lights is black."""
    stage = json.loads((exported.parent / "stages/home_small_3.stage_config.json").read_text())
    assert stage["shader_type"] == "material"
    lights = json.loads((exported.parent / "lighting/home_small_3.lighting_config.json").read_text())["lights"].values()
    vectors = np.array([light["direction"] for light in lights], float)
    colors = np.array([light["color"] for light in lights]) * [[light["intensity"]] for light in lights]
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    received = np.maximum(-normals @ vectors.T, 0) @ colors
    up, down = received[1], received[4]
    assert down.min() > 0.6
    assert up.max() <= 1.0
    assert (up > down).all()


# --- colliders and GLB ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("k", range(4))
def test_collider_parts_enclose_their_shapes_tightly(k: int) -> None:
    shape = small_scene().assets["table"].shapes[k]
    mesh = part_mesh(shape)
    hull = ConvexHull(mesh.vertices)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    volume = float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    assert volume == pytest.approx(hull.volume, rel=1e-4)  # closed, faces outwards
    exact = {0: 0.6 * 0.5 * 0.4, 1: np.pi * 0.01 * 0.4, 3: ConvexHull(part_points(shape)).volume}
    length = float(np.hypot(0.3, 0.1))
    exact[2] = np.pi * 0.01 * length + 4 / 3 * np.pi * 0.001
    assert exact[k] * 0.999 <= volume <= exact[k] * 1.08


def test_collider_file_keeps_its_parts_apart(tmp_path: Path) -> None:
    import trimesh

    folder = export_habitat(small_scene(), tmp_path / "x").parent
    colliders = list((folder / "objects").glob("table_*.collider.glb"))
    assert len(colliders) == 2
    assert len(trimesh.load_scene(colliders[0]).geometry) == 4


def test_triangles_of_several_colours_get_their_mean(tmp_path: Path) -> None:
    mesh = brick((0, 0, 0), (1, 1, 1))
    colors = np.zeros((8, 3), np.uint8)
    colors[0] = (90, 30, 0)
    (tmp_path / "m.glb").write_bytes(glb_bytes([replace(mesh, colors=colors)]))
    again = load_mesh(tmp_path / "m.glb")
    seen = {tuple(c) for c in again.colors[again.faces].reshape(-1, 3).tolist()}
    assert seen == {(0, 0, 0), (30, 10, 0)}
    np.testing.assert_allclose(np.ptp(again.vertices, axis=0), 1)


def test_the_stage_names_its_parts(exported: Path) -> None:
    data = (exported.parent / "stages/home_small_3.glb").read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    walls = next(n for n in document["nodes"] if n["name"] == "walls")
    assert walls["extras"]["h3data"] == {"category": "wall", "semantic_id": 1, "layer": ""}


@pytest.mark.slow
def test_a_split_building_has_semantic_ids(home: Scene, exported: Path, tmp_path: Path) -> None:
    split = load_habitat_scene(export_habitat(home, tmp_path / "split", split_building=True))
    assert split.source["warnings"] == []
    whole = load_habitat_scene(exported)

    def seen(scene: Scene, output: str) -> np.ndarray:
        room = home.rooms[0].rectangles[0]
        eye = np.array([(room[0] + room[2]) / 2, 1.5, (room[1] + room[3]) / 2])
        renderer, images = Renderer(render_scene(scene)), []
        for direction in ([1, 0.1, 0], [-1, 0, 0.5], [0.2, 0.9, 1], [0, -0.3, -1]):
            camera = pinhole(64, 64, hfov_deg=90, pose=look_at(eye, eye + direction))
            images.append(renderer.render(camera, outputs=(output,))[output])
        return np.stack(images)

    assert {1, 2, 3} <= set(np.unique(seen(split, "semantic"))), "walls, floors, ceilings"
    np.testing.assert_array_equal(seen(split, "depth"), seen(whole, "depth"))
    np.testing.assert_array_equal(seen(split, "semantic"), seen(home, "semantic"))
    assert (seen(whole, "semantic") == 0).mean() > 0.3
    free, before = (FreeSpace.from_scene(s, radius_m=0.25, height_m=1.41) for s in (split, whole))
    np.testing.assert_array_equal(free.sdf, before.sdf)


# --- the folder -------------------------------------------------------------------------------------------------------
def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_same_scene_same_bytes(home: Scene, exported: Path, tmp_path: Path) -> None:
    again = export_habitat(build_home(HomeSpec(preset="small", seed=3)), tmp_path / "elsewhere")
    assert contents(again.parent) == contents(exported.parent)


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "x"
    export_habitat(small_scene(), target)
    before = contents(target)
    with pytest.raises(InputError, match="H3-EXPORT-024"):
        export_habitat(small_scene(), target)
    (target / "stray.txt").write_text("old")
    export_habitat(small_scene(), target, force=True)
    assert contents(target) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x"]
    (tmp_path / "empty").mkdir()
    export_habitat(small_scene(), tmp_path / "empty")


def test_force_deletes_nothing_that_it_did_not_write(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter_1.tex").write_text("dear reader")
    (tmp_path / "thesis/hssd.scene_dataset_config.json").write_text('{"stages": {}}')
    with pytest.raises(InputError, match="H3-EXPORT-020"):
        export_habitat(small_scene(), tmp_path / "thesis", force=True)
    assert (tmp_path / "thesis/chapter_1.tex").read_text() == "dear reader"
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="H3-EXPORT-023"):
        export_habitat(small_scene(), tmp_path / "file", force=True)
    with pytest.raises(InputError, match="H3-EXPORT-026"):
        export_habitat(small_scene(), tmp_path / "file" / "below")


def test_a_failed_export_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "x"
    export_habitat(small_scene(), target)
    before = contents(target)
    write = Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if "scenes" in self.parts:
            raise OSError(28, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"(?s)No space left.*H3-EXPORT-026"):
        export_habitat(small_scene(), target, force=True)
    assert contents(target) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"pose": np.full(7, np.nan)}, "H3-EXPORT-021"),
        ({"scale": np.array([1.0, 0.0, 1.0])}, "H3-EXPORT-021"),
    ],
)
def test_poses_that_are_none_are_refused(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    scene = small_scene()
    broken = replace(scene, instances=(*scene.instances[:-1], replace(scene.instances[-1], **change)))
    with pytest.raises(SceneError, match=says):
        export_habitat(broken, tmp_path / "x")
    assert not list(tmp_path.iterdir())


def test_meshes_with_nan_and_scenes_without_a_building_are_refused(tmp_path: Path) -> None:
    scene = small_scene()
    bad = brick((0, 0, 0), (1, 1, 1))
    bad.vertices[0, 0] = np.nan
    with pytest.raises(SceneError, match=r"(?s)not finite.*H3-MESH-008"):
        export_habitat(replace(scene, assets={**scene.assets, "rug": Asset(name="rug", mesh=bad)}), tmp_path / "x")
    with pytest.raises(SceneError, match="H3-EXPORT-019"):
        export_habitat(replace(scene, instances=scene.instances[2:]), tmp_path / "x")


def test_names_become_file_names(tmp_path: Path) -> None:
    config = export_habitat(small_scene(name="../../my home: 1"), tmp_path / "x")
    assert config.parent == tmp_path / "x"
    assert config.name == "_my_home_1.scene_dataset_config.json"
    assert load_habitat_scene(config).name == "_my_home_1"


# --- things that open ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.slow), 0.7])
def test_things_that_open_come_back_as_articulated_objects(tmp_path: Path, share: float) -> None:
    """Exported, read and posed: the same places as posed here, whatever the joints' rest positions."""
    home = build_home(HomeSpec(seed=2, articulated=True))
    joints = joints_of(home)
    at = joints.closed + share * (joints.opened - joints.closed)
    scene = posed(home, at)
    again = load_habitat_scene(export_habitat(scene, tmp_path / "out"), "home_small_2_articulated")
    assert not [w for w in again.source["warnings"] if "joint" in w]
    theirs = joints_of(again)
    assert len(theirs) == len(joints)
    # things are written in order, parts read parents first: match them by thing and part
    things = [thing.name for thing in home.articulations]
    order = [f"{things[list(again.articulations).index(thing)]}/{part.name}" for thing, part in theirs.parts]
    assert sorted(order) == sorted(joints.names)
    numbers = [joints.index(name) for name in order]
    np.testing.assert_allclose(theirs.rest, at[numbers], atol=1e-9)
    np.testing.assert_allclose(theirs.opened, joints.opened[numbers], atol=1e-9)
    for positions in (joints.closed, joints.opened):
        ours, read = posed(home, positions), posed(again, positions[numbers])
        for name, k in zip(order, range(len(order)), strict=True):
            mine = next(i for i in ours.instances if i.name == joints.parts[joints.index(name)][1].instances[0])
            other = next(i for i in read.instances if i.name == theirs.parts[k][1].instances[0])
            np.testing.assert_allclose(instance_bounds(ours, mine), instance_bounds(read, other), atol=1e-4)
    if share == 0:  # open doors do not say what is behind them
        assert len(theirs.enclosing) == len(joints.enclosing)
    receptacles = {tuple(np.round(receptacle_place(i, r), 4)) for i, r in scene.receptacles()}
    assert {tuple(np.round(receptacle_place(i, r), 4)) for i, r in again.receptacles()} == receptacles


def receptacle_place(instance: Instance, receptacle: Receptacle) -> np.ndarray:
    return (instance_matrix(instance) @ np.append(receptacle.center, 1.0))[:3] + 0.0
