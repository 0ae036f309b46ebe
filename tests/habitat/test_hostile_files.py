"""Files that nobody would write on purpose: every fault is an `H3DataError` that names the file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import FormatError, H3DataError, InputError, SceneError
from h3data.formats import detect
from h3data.mesh.loading import load_mesh
from h3data.mesh.primitives import primitive_mesh
from h3data.recording import AssetRef
from h3data.recording.assets.library import AssetLibrary
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.scenes.node_boxes import node_box
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data_pipelines.cli import main

POSE = {"translation": [1, 0, 2], "rotation": [1, 0, 0, 0]}


def replay_text(
    *, load: dict[str, Any] | None = None, pose: dict[str, Any] | None = None, name: str = "a.glb"
) -> bytes:
    frame = {
        "loads": [{"filepath": name, **(load or {})}],
        "creations": [{"instanceKey": 0, "creation": {"filepath": name}}],
        "stateUpdates": [{"instanceKey": 0, "state": {"absTransform": {**POSE, **(pose or {})}}}],
    }
    return json.dumps({"keyframes": [frame]}).encode()


REPLAYS = {
    "brackets without end": b'{"keyframes":' + b"[" * 100_000,
    "nested too deep": b'{"keyframes":[{"lights":[{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}]}]}",
    "not UTF-8": b'{"keyframes":[{"loads":[{"filepath":"\xe9"}]}]}',
    "a number of 6000 digits": b'{"keyframes":[{"deletions":[' + b"9" * 6000 + b"]}]}",
    "a position beyond float32": replay_text(pose={"translation": [1e39, 0, 0]}),
    "a rotation beyond float32": replay_text(pose={"rotation": [1e200, 0, 0, 0]}),
    "units of zero": replay_text(load={"virtualUnitToMeters": 0}),
    "an axis beyond float32": replay_text(load={"frame": {"up": [0, 1e200, 0], "front": [0, 0, -1]}}),
}


@pytest.mark.parametrize("case", REPLAYS)
def test_hostile_replays_are_refused(case: str, tmp_path: Path) -> None:
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(REPLAYS[case])
    detect(path)  # never raises on content
    with pytest.raises(FormatError, match=r"(?s)x\.gfx_replay\.json.*H3-(FORMAT-00[89]|HABITAT-059)"):
        read_gfx_replay(path)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(b"\xef\xbb\xbf" + replay_text())
    assert detect(path).name == "gfx_replay"
    assert len(read_gfx_replay(path)) == 1


def test_a_colour_of_too_many_digits_is_no_crash(tmp_path: Path) -> None:
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(replay_text(name="a.glb?phong_amb_1_dif_" + "9" * 5000))
    assert len(read_gfx_replay(path)) == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(replay_text())
    path.chmod(0)
    with pytest.raises(InputError, match=r"(?s)Permission denied.*H3-FORMAT-015"):
        read_gfx_replay(path)


def test_a_loop_of_links_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.symlink_to(path)
    with pytest.raises(InputError, match=r"(?s)x\.json.*H3-FORMAT-015"):
        read_gfx_replay(path)


def test_a_pipe_is_refused_before_it_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.gfx_replay.json"
    os.mkfifo(path)  # nobody writes to it: reading would never end
    assert main(["import", str(path), "-o", str(tmp_path / "rec")]) == 2
    assert "pipe or device" in capsys.readouterr().err


def test_names_in_a_file_do_not_decide_how_much_memory_is_taken() -> None:
    for name in (
        "cylinderSolid_rings_99999999_segments_99999999_halfLen_1_useTexCoords_false_useTangents_false_capEnds_true",
        "capsule3DSolid_hemiRings_99999999_cylRings_1_segments_0_halfLen_1e300",
        "uvSphereSolid_rings_1e999_segments_99999999",
        "icosphereSolid_subdivs_99",
    ):
        mesh = primitive_mesh(name)
        assert len(mesh.vertices) < 500_000
        assert np.isfinite(mesh.vertices).all()


def test_a_name_too_long_for_the_file_system_is_missing(tmp_path: Path) -> None:
    library = AssetLibrary([tmp_path])
    assert library.mesh(AssetRef(name="a", uri="a" * 5000 + ".glb")) is None
    assert len(library.missing) == 1


# --- meshes -----------------------------------------------------------------------------------------------------------
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
{}
3 0 1 {}
"""


def test_triangles_between_vertices_that_do_not_exist(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    path.write_text(PLY.format("0 1 0", 999_999))
    with pytest.raises(SceneError, match=r"(?s)x\.ply.*H3-MESH-021"):
        load_mesh(path)
    with pytest.raises(SceneError, match=r"(?s)x\.ply.*H3-MESH-021"):
        node_box(path)


def test_vertices_that_are_too_large_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    path.write_text(PLY.format("0 1e30 0", 2))
    with pytest.raises(SceneError, match="H3-MESH-026"):
        load_mesh(path, units_m=1e30)


# --- scene datasets ---------------------------------------------------------------------------------------------------
SCENES: dict[str, dict[str, Any]] = {
    "objects that are a number": {"object_instances": 5},
    "objects that are numbers": {"object_instances": [5]},
    "articulated objects that are a number": {"articulated_object_instances": 5},
    "a stage with a list as name": {"stage_instance": {"template_name": []}},
}
DATASETS: dict[str, dict[str, Any]] = {
    "configs that are a number": {"objects": {"configs": 5}},
    "an original file that is a number": {"objects": {"configs": [{"original_file": 5}]}},
    "a handle that is a list": {"objects": {"configs": [{"template_handle": []}]}},
    "a pattern that is none": {"objects": {"paths": {".json": ["***"]}}},
}


@pytest.mark.parametrize("case", [*SCENES, *DATASETS])
def test_hostile_scene_datasets_are_refused(case: str, tmp_path: Path) -> None:
    dataset: dict[str, Any] = {"scene_instances": {"paths": {".json": ["*"]}}, **DATASETS.get(case, {})}
    (tmp_path / "d.scene_dataset_config.json").write_text(json.dumps(dataset))
    (tmp_path / "s.scene_instance.json").write_text(json.dumps(SCENES.get(case, {})))
    with pytest.raises(H3DataError, match=rf"(?s){tmp_path}.*H3-HABITAT-1(12|23)"):
        load_habitat_scene(tmp_path / "s.scene_instance.json")


def test_a_mesh_name_too_long_for_the_file_system(tmp_path: Path) -> None:
    path = tmp_path / "x.stage_config.json"
    path.write_text(json.dumps({"render_asset": "a" * 5000}))
    with pytest.raises(SceneError, match="H3-HABITAT-119"):
        load_habitat_scene(path)


def test_strict_import_refuses_recordings_with_missing_assets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.gfx_replay.json"
    path.write_bytes(replay_text(name="data/lost.glb"))
    assert main(["import", str(path), "-o", str(tmp_path / "rec"), "--strict"]) == 2
    assert "lost.glb" in capsys.readouterr().err
    assert list((tmp_path / "rec").glob("*.mcap")) == []
    assert main(["import", str(path), "-o", str(tmp_path / "rec")]) == 0
