"""Our homes as USD come back: shapes, joints, rooms and free floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pxr", reason="needs usd-core: pip install 'h3data[usd]'")

from pxr import Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdValidation

import h3data
from h3data.errors import InputError, SceneError
from h3data.mesh.mesh_operations import face_texture_indices
from h3data.scene import Asset, Box, Capsule, Cylinder, FreeSpace, Hull, Instance, Mesh, Scene, Texture
from h3data.scene.scene_json import articulation_record, asset_record, instance_record, light_record, room_record
from h3data_pipelines.cli import main
from h3data_worlds.usd.reading import read_usd
from h3data_worlds.usd.writing import write_usd
from tests.worlds.usd_homes import quad


def assert_same(scene: Scene, back: Scene) -> None:
    """All records are equal, and the meshes but for the rounding of flipped texture coordinates."""
    assert [instance_record(i) for i in back.instances] == [instance_record(i) for i in scene.instances]
    assert [room_record(r) for r in back.rooms] == [room_record(r) for r in scene.rooms]
    assert [articulation_record(a) for a in back.articulations] == [articulation_record(a) for a in scene.articulations]
    assert [light_record(a) for a in back.lights or ()] == [light_record(a) for a in scene.lights or ()]
    assert (back.name, dict(back.source)) == (scene.name, dict(scene.source))
    assert list(back.assets) == list(scene.assets)
    for key, asset in scene.assets.items():
        one, other = asset.mesh, back.assets[key].mesh
        assert asset_record(asset, None) == asset_record(back.assets[key], None)
        for name in ("vertices", "faces", "colors", "normals"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=f"{key} {name}")
        np.testing.assert_array_equal(face_texture_indices(one), face_texture_indices(other))
        assert (one.uv is None) == (other.uv is None)
        if one.uv is not None:
            np.testing.assert_allclose(one.uv, other.uv, atol=1e-5)
        for a, b in zip(one.textures, other.textures, strict=True):
            np.testing.assert_array_equal(a.pixels, b.pixels)


@pytest.mark.parametrize(
    ("home", "ending"),
    [("small-open:3", "usda"), pytest.param("small2-doors:3", "usdc", marks=pytest.mark.slow), ("small:1", "usdz")],
)
def test_a_home_comes_back_whole(home: str, ending: str, tmp_path: Path) -> None:
    scene = h3data.load_scene(home)
    file = tmp_path / f"home.{ending}"
    write_usd(scene, file)
    back = h3data.load_scene(file)
    assert_same(scene, back)
    one, other = (FreeSpace.from_scene(s, radius_m=0.25, height_m=1.4) for s in (scene, back))
    assert one.polygon.symmetric_difference(other.polygon).area < 1e-9
    assert one.polygon.hausdorff_distance(other.polygon) < 1e-3
    assert_same(scene, h3data.load_scene(file))  # of the cache


@pytest.mark.slow
def test_the_command_writes_what_scenes_are_named_by(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "home.usdz"
    assert main(["scenes", "export", "small:3", "--to", "usd", "-o", str(out)]) == 0
    assert main(["scenes", "export", "small:3", "--to", "usd", "-o", str(out)]) == 2
    assert main(["scenes", "export", "small:3", "small:4", "--to", "usd", "-o", str(out), "--force"]) == 2
    assert main(["scenes", "export", "small:3", "--to", "usd", "-o", str(tmp_path / "folder")]) == 0
    assert [p.suffix for p in (tmp_path / "folder").iterdir() if p.is_file()] == [".usdc"]
    capsys.readouterr()
    assert main(["scenes", "list", str(out)]) == 0
    assert "5" in capsys.readouterr().out


def test_what_is_written_is_valid_and_means_in_usd_what_it_means_here(tmp_path: Path) -> None:
    scene = h3data.load_scene("small-open:3")
    write_usd(scene, tmp_path / "home.usda")
    stage = Usd.Stage.Open(str(tmp_path / "home.usda"))
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = [error.GetMessage() for error in context.Validate(stage)]
    assert errors == []
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    prims = list(stage.Traverse())
    joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
    assert len(joints) == sum(len(thing.parts) for thing in scene.articulations) > 0
    labelled = [UsdSemantics.LabelsAPI(p, "class").GetLabelsAttr().Get()[0] for p in prims if p.IsInstance()]
    assert sorted(labelled) == sorted(scene.assets[i.asset].category for i in scene.instances)
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetPseudoRoot())
    np.testing.assert_allclose(np.array([*box.ComputeAlignedRange().GetMin()]), scene.bounds[0], atol=0.02)


@pytest.mark.slow
def test_changes_in_another_program_are_kept(tmp_path: Path) -> None:
    scene = h3data.load_scene("small-open:3")
    write_usd(scene, tmp_path / "home.usda")
    stage = Usd.Stage.Open(str(tmp_path / "home.usda"))
    moved, gone, mirrored = [i for i in scene.instances if i.motion == "kinematic"][:3]
    for prim in list(stage.Traverse()):
        if prim.IsInstance() and prim.GetName() == moved.name:
            prim.GetAttribute("xformOp:translate").Set(
                prim.GetAttribute("xformOp:translate").Get()
                + type(prim.GetAttribute("xformOp:translate").Get())(0.5, 0, 0)
            )
        elif prim.IsInstance() and prim.GetName() == gone.name:
            prim.SetActive(False)
        elif prim.IsInstance() and prim.GetName() == mirrored.name:
            UsdGeom.Xformable(prim).AddScaleOp(opSuffix="mirror").Set((-1, 1, 1))
    joint = next(prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.RevoluteJoint))
    joint.GetAttribute("physics:upperLimit").Set(45.0)
    stage.Save()
    back = h3data.load_scene(tmp_path / "home.usda")
    named = {i.name: i for i in back.instances}
    assert gone.name not in named
    assert mirrored.name in named
    np.testing.assert_allclose(named[moved.name].pose[:3] - moved.pose[:3], [0.5, 0, 0], atol=1e-9)
    assert back.source["kind"] == "usd"  # no longer the home that the generator makes
    assert any(abs(p.joint.upper - np.pi / 4) < 1e-6 for a in back.articulations for p in a.parts)
    assert len(back.rooms) == len(scene.rooms)


@given(st.lists(st.floats(-2, 2), min_size=14, max_size=14), st.integers(0, 2**31))
def test_any_shapes_come_back(tmp_path_factory: pytest.TempPathFactory, numbers: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    quat = np.add(numbers[:4], [0, 0, 0, 5.0])
    pose = np.array([*numbers[4:7], *(quat / np.linalg.norm(quat))])
    size = np.abs(numbers[7:10]) + 0.01
    pixels = rng.integers(0, 255, (4, 4, 4), np.uint8)
    mesh = quad(texture=Texture(pixels=pixels, name="a b/c"), colors=rng.integers(0, 255, (4, 3), np.uint8))
    shapes = (
        Box(pose=pose, half_extents=size),
        Cylinder(pose=pose, radius=float(size[0]), half_height=float(size[1])),
        Capsule(start=np.array(numbers[10:13]), end=np.array(numbers[11:14]), radius=float(size[2])),
        Hull(points=rng.normal(size=(9, 3))),
    )
    asset = Asset(name="1 thing|ü", mesh=mesh, category="object", shapes=shapes)
    one = Instance(name="thing/1", asset="k", pose=pose, scale=size + 0.1, motion="kinematic", layer="l", semantic_id=7)
    two = replace(one, name="thing|1", pose=np.array([0, 0, 0, 0, 0, 0, 1.0]), scale=np.ones(3))
    scene = Scene(name="s", assets={"k": asset}, instances=(one, two), source={"kind": "test"})
    file = tmp_path_factory.mktemp("any") / "s.usda"
    write_usd(scene, file)
    back, _ = read_usd(file, strict=True)
    assert_same(scene, back)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    mesh = quad()
    bad = Mesh(vertices=mesh.vertices * np.float32(np.nan), faces=mesh.faces, colors=mesh.colors)
    here = Instance(name="a", asset="a", pose=np.array([0, 0, 0, 0, 0, 0, 1.0]))
    scene = Scene(name="s", assets={"a": Asset(name="a", mesh=bad)}, instances=(here,))
    with pytest.raises(SceneError, match="H3-WORLD"):
        write_usd(scene, tmp_path / "a.usda")
    with pytest.raises(InputError, match="H3-WORLD"):
        write_usd(scene, tmp_path / "a.obj")
    assert [*tmp_path.iterdir()] == []
