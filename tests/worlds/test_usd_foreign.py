"""USD files of other programs: units, axes, references and instances are read; damage and what is missing is named."""

from __future__ import annotations

import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs usd-core: pip install 'h3data[usd]'")

from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, UsdUtils

import h3data
from h3data.errors import H3DataError
from h3data.scene import FreeSpace
from h3data_pipelines.cli import main
from h3data_worlds.usd.polygons import triangles_of
from h3data_worlds.usd.reading import read_usd
from tests.worlds.usd_homes import box, flat, label


def code_of(path: Path, **options: bool) -> str:
    """The code with which a file is refused, in one line."""
    with pytest.raises(H3DataError) as refused:
        read_usd(path, **options)
    assert "\n" not in str(refused.value)
    assert path.name in str(refused.value)
    assert "crateFile.cpp" not in str(refused.value)
    return str(refused.value.code)


def written(path: Path, body: str, *, metres: str = "1", up: str = "Y") -> Path:
    path.write_text(f'#usda 1.0\n(\n    metersPerUnit = {metres}\n    upAxis = "{up}"\n)\n{body}\n')
    return path


@pytest.mark.parametrize(("up", "metres", "ending"), [("Z", 0.01, "usda"), ("Y", 1.0, "usdc"), ("Z", 0.0254, "usd")])
def test_a_flat_of_another_program_has_the_right_size_and_floor(
    up: str, metres: float, ending: str, tmp_path: Path
) -> None:
    scene, files = read_usd(flat(tmp_path, up=up, metres=metres, ending=ending), strict=True)
    np.testing.assert_allclose(scene.bounds, [[-0.1, -0.1, -4.1], [6.1, 2.5, 0.1]], atol=1e-5)
    named = {i.name: i for i in scene.instances}
    assert len(named) == 17
    assert len([n for n in named if n.startswith("Chair_")]) == 4
    np.testing.assert_allclose(named["Table"].pose, [1.5, 0, -2, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(named["Chair_2"].pose[:3], [1.2, 0, -2.7], atol=1e-5)
    assert [i.name for i in scene.instances if i.motion == "kinematic"] == ["Mug"]
    assert {scene.assets[i.asset].category for i in scene.instances} >= {"wall", "floor", "table", "chair", "mug"}
    assert len({named[f"Chair_{k}"].asset for k in range(4)}) == 1  # one prototype
    (mug,) = scene.assets[named["Mug"].asset].shapes
    np.testing.assert_allclose([mug.radius, mug.half_height], [0.04, 0.05], atol=1e-6)
    np.testing.assert_allclose(np.ptp(scene.assets["Lamp"].mesh.vertices[:, 1]), 1.5, atol=1e-5)  # the chosen variant
    assert len(scene.assets["Table"].mesh.textures) == 1
    assert files is not None
    assert {Path(f).name for f in files} == {f"flat.{ending}", f"table.{ending}", "wood.png"}
    free = FreeSpace.from_scene(scene, radius_m=0.25, height_m=1.4).polygon
    np.testing.assert_allclose(free.bounds, [0.25, -3.75, 5.75, -0.25], atol=0.01)
    assert 12 < free.area < 13.5


def test_what_opens_opens_towards_the_room(tmp_path: Path) -> None:
    scene, _ = read_usd(flat(tmp_path))
    things = {a.name: a for a in scene.articulations}
    slide, hinge = (things[name].parts[0].joint for name in ("Cabinet", "Fridge"))
    assert (slide.kind, hinge.kind) == ("prismatic", "revolute")
    ends = np.array([slide.lower, slide.upper])[:, None] * slide.axis
    assert np.abs(ends - [0, 0, 0.4]).max(1).min() < 1e-6
    assert slide.rest == 0
    np.testing.assert_allclose(hinge.axis, [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose([hinge.lower, hinge.upper], [0, np.pi / 2], atol=1e-6)


def test_a_missing_reference_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = flat(tmp_path)
    (tmp_path / "props" / "table.usda").unlink()
    assert code_of(file) == "H3-WORLD-001"
    scene, files = read_usd(file, allow_missing=True)
    assert files is None
    assert "Table" not in {i.name for i in scene.instances}
    assert any("table.usda" in str(words) for words in scene.source["warnings"])
    assert code_of(file, allow_missing=True, strict=True) == "H3-WORLD-002"
    assert main(["scenes", "list", str(file)]) == 2
    assert "H3-WORLD-001" in capsys.readouterr().err


def test_a_missing_image_is_named(tmp_path: Path) -> None:
    file = flat(tmp_path)
    (tmp_path / "props" / "wood.png").unlink()
    assert code_of(file) == "H3-WORLD-001"


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    file = tmp_path / "a.usda"
    stage = Usd.Stage.CreateNew(str(file))
    box(stage, "/Floor", (0, 0, 0), (4, 0.1, 4))
    UsdGeom.BasisCurves.Define(stage, "/Cable")
    outer = UsdGeom.PointInstancer.Define(stage, "/Forest")
    UsdGeom.Xform.Define(stage, "/Forest/Group")
    UsdGeom.PointInstancer.Define(stage, "/Forest/Group/Trees")
    outer.CreatePrototypesRel().SetTargets(["/Forest/Group"])
    outer.CreateProtoIndicesAttr([0])
    outer.CreatePositionsAttr([Gf.Vec3f(0, 0, 0)])
    stage.Save()
    scene, _ = read_usd(file)
    said = " ".join(map(str, scene.source["warnings"]))
    assert "/Cable" in said
    assert "/Forest/Group/Trees" in said
    assert code_of(file, strict=True) == "H3-WORLD-002"


def test_copies_with_other_labels_are_other_things_and_holes_are_open(tmp_path: Path) -> None:
    file = tmp_path / "a.usda"
    stage = Usd.Stage.CreateNew(str(file))
    stage.CreateClassPrim("/Proto")
    box(stage, "/Proto/Body", (0, 0, 0), (1, 1, 1)).CreateHoleIndicesAttr([0, 3])
    for name in ("table", "desk"):
        prim = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
        prim.GetReferences().AddInternalReference("/Proto")
        prim.SetInstanceable(True)
        label(prim, name)
    stage.Save()
    scene, _ = read_usd(file)
    assert [scene.assets[i.asset].category for i in scene.instances] == ["table", "desk"]
    assert {len(a.mesh.faces) for a in scene.assets.values()} == {8}


def test_instances_of_instances_have_names_of_their_own_and_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten lines may stand for a thousand things, and thirty for a billion."""
    classes = ['class Xform "P0" {\n def Cube "Body" {}\n}']
    for k in range(1, 5):
        two = "\n".join(f'def Xform "{name}" (\ninstanceable = true\nreferences = </P{k - 1}>\n) {{}}' for name in "xy")
        classes.append(f'class Xform "P{k}" {{\n{two}\n}}')
    body = "\n".join([*classes, 'def Xform "a" (\ninstanceable = true\nreferences = </P4>\n) {}'])
    scene, _ = read_usd(written(tmp_path / "a.usda", body))
    assert {i.name for i in scene.instances} == {f"{k}{n}" for k in "xy" for n in ("", *(f"_{m}" for m in range(2, 9)))}
    monkeypatch.setattr("h3data_worlds.usd.things.MAX_COPIES", 10)
    assert code_of(written(tmp_path / "b.usda", body)) == "H3-WORLD-014"


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.usda", b"hello"), ("a.usd", b""), ("a.usdc", b""), ("b.usd", b"\0" * 100), ("b.usda", b"#usda 1.0\n\xff\xfe\0"),
        ("b.usdc", np.random.default_rng(0).bytes(4000)), ("b.usdz", np.random.default_rng(0).bytes(4000)),
        ("c.usdc", b"PXR-USDC" + bytes([0, 8, 0]) + np.random.default_rng(1).bytes(4000)),
        ("c.usda", b'#usda 1.0\ndef Mesh "a" { point3f[] points = [(0,'),
    ],
)  # fmt: skip
def test_what_is_not_usd_is_refused(name: str, data: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    assert code_of(tmp_path / name) == "H3-WORLD-010"


@pytest.fixture(scope="module")
def binary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flat(tmp_path_factory.mktemp("flat"), up="Y", metres=1.0, ending="usdc")


@settings(max_examples=60, deadline=None)
@given(
    changes=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=12), share=st.floats(0.3, 2)
)
def test_damaged_binaries_are_read_or_refused(
    binary: Path, changes: list[tuple[float, int]], share: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(binary.read_bytes())
    for at, value in changes:
        data[int(at * (len(data) - 1))] = value
    file = tmp_path_factory.mktemp("damaged") / "flat.usdc"
    file.write_bytes(bytes(data[: int(share * len(data))]))
    with suppress(H3DataError):
        scene, _ = read_usd(file, allow_missing=True)
        assert np.isfinite(scene.bounds).all()


@pytest.mark.parametrize(
    ("body", "metres", "up", "code"),
    [
        ('def Cube "a" {}', "0", "Y", "H3-WORLD-007"),
        ('def Cube "a" {}', "-1", "Y", "H3-WORLD-007"),
        ('def Cube "a" {}', "nan", "Y", "H3-WORLD-007"),
        ('def Cube "a" {}', "1e30", "Y", "H3-WORLD-007"),
        ('def Cube "a" {}', "1", "W", "H3-WORLD-008"),
        ('def Cube "a" { double size = nan\n}', "1", "Y", "H3-WORLD-003"),
        ('def Xform "a" {}', "1", "Y", "H3-WORLD-003"),
        ('def Mesh "a" { point3f[] points = [(nan, 0, 0), (1, 0, 0), (0, 1, 0)]\n int[] faceVertexCounts = [3]\n'
         " int[] faceVertexIndices = [0, 1, 2]\n}", "1", "Y", "H3-WORLD-003"),
        ('def Mesh "a" { point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\n int[] faceVertexCounts = [3]\n'
         " int[] faceVertexIndices = [0, 1, 7]\n}", "1", "Y", "H3-WORLD-003"),
        ('def Cube "a" ( references = </a> ) {}', "1", "Y", "H3-WORLD-002"),
        ('def Cube "a" ( customData = { string h3data = "[" } ) {}', "1", "Y", "H3-WORLD-013"),
    ],
)  # fmt: skip
def test_senseless_values_are_refused(body: str, metres: str, up: str, code: str, tmp_path: Path) -> None:
    file = written(tmp_path / "a.usda", body, metres=metres, up=up)
    assert code_of(file, strict=code == "H3-WORLD-002") == code


def test_a_package_may_hold_all_it_needs_and_nothing_else(tmp_path: Path) -> None:
    file = flat(tmp_path, ending="usdc")
    assert UsdUtils.CreateNewUsdzPackage(str(file), str(tmp_path / "flat.usdz"))
    scene = h3data.load_scene(tmp_path / "flat.usdz")
    assert "Table" in {i.name for i in scene.instances}
    assert len(scene.assets["Table"].mesh.textures) == 1
    secret = written(tmp_path / "secret.usda", 'def Cube "Secret" {}')
    for target in (str(secret), "../secret.usda", "./secret.usda"):
        layer = written(tmp_path / "inner.usda", f'def Xform "a" ( references = @{target}@</Secret> ) {{}}')
        with zipfile.ZipFile(tmp_path / "out.usdz", "w") as package:
            package.write(layer, "inner.usda")
        code = code_of(tmp_path / "out.usdz")
        assert code in ("H3-WORLD-011", "H3-WORLD-001"), target
    assert code_of(tmp_path / "none.usda") == "H3-WORLD-006"


@given(seed=st.integers(0, 2**31), corners=st.integers(3, 40), bent=st.booleans())
def test_triangles_cover_concave_polygons_once(seed: int, corners: int, bent: bool) -> None:
    rng = np.random.default_rng(seed)
    angle = np.arange(corners) * 2 * np.pi / corners
    radius = rng.uniform(0.2, 1, corners)
    frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(corners)], -1)
    if bent:  # a comb, into which nobody sees from one corner
        x = np.arange(corners, dtype=float)
        flat = np.stack([x, np.where(x % 2, 0.2, radius), 0 * x], -1)
        flat = np.concatenate([[[0, -1, 0]], [[corners - 1, -1, 0]], flat[::-1]])
    flat = np.roll(flat, int(rng.integers(len(flat))), axis=0)
    points = flat @ frame.T
    rows, face_of = triangles_of(points, np.array([3, len(flat)]), np.array([0, 1, 2, *range(len(flat))]))
    assert face_of.tolist() == [0] + [1] * (len(flat) - 2)
    a, b, c = (flat[rows[1:, k] - 3][:, :2] for k in range(3))
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert areas.min() > -1e-9
    x, y = flat[:, 0], flat[:, 1]
    np.testing.assert_allclose(areas.sum(), (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2, rtol=1e-9)
