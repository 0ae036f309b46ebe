"""Finding recorded files below the user's folders."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from h3data.errors import SceneError
from h3data.recording.assets.folders import ASSETS_VARIABLE, clean_path
from h3data.recording.assets.library import EMPTY_URI, AssetLibrary
from h3data.recording.records import AssetRef
from h3data.scene.records import Asset, Scene


def put(path: Path, size: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents=(size, size, size)).export(path)
    return path


def test_exact_path_with_dots_and_material_suffix(tmp_path: Path) -> None:
    file = put(tmp_path / "data" / "robots" / "arm" / "meshes" / "link.glb")
    library = AssetLibrary([tmp_path])
    uris = (
        "data/robots/arm/meshes/link.glb",
        "data/robots/arm/urdf/../meshes/link.glb",
        "data\\robots\\arm\\meshes\\link.glb",
        "./data/robots/arm/meshes/link.glb?phong_amb_1_dif_2_spec_3",
    )
    for uri in uris:
        assert library.resolve(uri) == file


@pytest.mark.parametrize(
    "home", ["data/fpss", "data/scene_datasets/hssd-hab", "hssd-hab", "scene_datasets/hssd-hab", "."]
)
def test_hssd_is_found_under_each_of_its_names(tmp_path: Path, home: str) -> None:
    file = put(tmp_path / home / "objects" / "9" / "9a68c68b29616cdfda7f81cf4de8d484714282fe.glb")
    library = AssetLibrary([tmp_path])
    for prefix in ("data/fpss", "data/scene_datasets/hssd-hab"):
        found = library.resolve(f"{prefix}/objects/9/9a68c68b29616cdfda7f81cf4de8d484714282fe.glb")
        assert found is not None
        assert found.samefile(file)


def test_a_shared_file_name_is_not_enough(tmp_path: Path) -> None:
    put(tmp_path / "my_ycb" / "024_bowl" / "google_16k" / "textured.glb")
    library = AssetLibrary([tmp_path])
    assert library.resolve("data/objects/ycb/meshes/024_bowl/google_16k/textured.glb") is not None
    assert library.resolve("data/objects/ycb/meshes/009_gelatin_box/google_16k/textured.glb") is None
    assert library.resolve("somewhere/else/textured.glb") is None


def test_longest_shared_end_wins(tmp_path: Path) -> None:
    put(tmp_path / "a" / "spot" / "meshes" / "base.glb")
    wanted = put(tmp_path / "b" / "robots" / "spot" / "meshes" / "base.glb")
    assert AssetLibrary([tmp_path]).resolve("x/robots/spot/meshes/base.glb") == wanted


def test_first_root_wins_and_nothing_outside_the_roots_is_opened(tmp_path: Path) -> None:
    first = put(tmp_path / "one" / "data" / "x" / "thing.stl")
    put(tmp_path / "two" / "data" / "x" / "thing.stl")
    secret = put(tmp_path / "secret" / "thing.stl")
    library = AssetLibrary([tmp_path / "one", tmp_path / "two"])
    assert library.resolve("data/x/thing.stl") == first
    assert library.resolve("../secret/thing.stl") is None
    assert library.resolve(str(secret)) is None
    assert clean_path("../../a/../b.glb") == "b.glb"


def test_roots_come_from_the_environment_and_must_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(tmp_path / "data" / "x.glb")
    monkeypatch.setenv(ASSETS_VARIABLE, str(tmp_path))
    assert AssetLibrary().resolve("data/x.glb") is not None
    assert AssetLibrary([]).roots == (tmp_path,)
    with pytest.raises(SceneError, match=r"(?s)nowhere.*H3-HABITAT-001"):
        AssetLibrary([tmp_path / "nowhere"])


def test_meshes_of_every_sort_of_uri(tmp_path: Path) -> None:
    put(tmp_path / "brick.ply", 2.0)
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    library = AssetLibrary([tmp_path])
    brick = library.mesh(AssetRef(name="brick", uri="brick.ply", units_m=0.5, color=(1, 2, 3)))
    assert brick is not None
    np.testing.assert_allclose(brick.bounds, [[-0.5] * 3, [0.5] * 3])
    assert np.all(brick.colors == (1, 2, 3))
    cube = library.mesh(AssetRef(name="cube", uri="primitive:cubeSolid"))
    assert cube is not None
    assert len(cube.faces) == 12
    empty = library.mesh(AssetRef(name="hidden", uri=EMPTY_URI))
    assert empty is not None
    assert len(empty.faces) == 0
    assert library.missing == []
    assert library.mesh(AssetRef(name="gone", uri="data/gone.glb")) is None
    assert library.mesh(AssetRef(name="gone2", uri="data/gone.glb")) is None
    assert library.missing == ["data/gone.glb"]
    assert library.mesh(AssetRef(name="broken", uri="broken.glb")) is None
    assert "Truncated" in library.unreadable["broken.glb"]
    assert library.mesh(AssetRef(name="teapot", uri="primitive:teapotSolid")) is None
    assert "primitive:teapotSolid" in library.unreadable


def test_scene_uris_come_from_the_scene(tmp_path: Path) -> None:
    library = AssetLibrary([tmp_path])
    mesh = library.placeholder("x.glb")
    scene = Scene(name="s", assets={"sofa": Asset(name="sofa", mesh=mesh)}, instances=())
    ref = AssetRef(name="sofa", uri="scene:sofa")
    assert library.mesh(ref) is None
    assert library.with_scene(scene).mesh(ref) is mesh
    assert library.with_scene(scene).mesh(AssetRef(name="x", uri="scene:bed")) is None


def test_importing_the_asset_library_stays_light() -> None:
    code = (
        "import sys, h3data.recording.assets.library; "
        "heavy = {'trimesh', 'torch', 'numba', 'scipy', 'cv2', 'rerun', 'av', 'fcl', 'shapely'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
