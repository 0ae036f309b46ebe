"""Mesh files that name files elsewhere, claim what they do not hold, or are damaged: always one `SceneError`."""

from __future__ import annotations

import base64
import copy
import json
import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import SceneError
from h3data.mesh.glb import pack_glb
from h3data.mesh.loading import load_mesh
from h3data_habitat.scenes.node_boxes import node_box
from tests.mesh.gltf_builder import COLORS, FLOAT, SQUARE, TWO, U16, Builder, encoded, separate


# --- files beside -----------------------------------------------------------------------------------------------------
def test_files_beside_and_data_uris(tmp_path: Path) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    assert len(load_mesh(separate(build, tmp_path)).textures) == 1
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.png").write_bytes(encoded(COLORS[::-1]))
    mesh = load_mesh(separate(build, tmp_path, image="./pictures/../pictures/a.png"))
    np.testing.assert_array_equal(mesh.textures[0].pixels[..., :3], COLORS[::-1])
    inside = "data:application/octet-stream;base64," + base64.b64encode(b"".join(build.chunk.parts)).decode()
    assert len(load_mesh(separate(build, tmp_path, buffer=inside)).faces) == 2


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "a/../../secret.bin",
        "%2e%2e/secret.bin",
        "..\\secret.bin",
        "{}/secret.bin",
        "file:///secret.bin",
        "https://example.org/secret.bin",
        "..",
        "C:\\secret.bin",
    ],
)
@pytest.mark.parametrize("what", ["buffer", "image"])
def test_files_outside_the_folder_are_refused(tmp_path: Path, uri: str, what: str) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    (tmp_path / "secret.bin").write_bytes(b"".join(build.chunk.parts))
    path = separate(build, tmp_path / "folder", **{what: uri.format(tmp_path)})
    with pytest.raises(SceneError, match=r"(?s)leads out.*x\.gltf.*H3-MESH-021"):
        load_mesh(path)


def test_an_obj_does_not_reach_outside_either(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "out.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "folder").mkdir()
    obj = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    for k, name in enumerate(("../out.mtl", str(tmp_path / "out.mtl"), "..\\out.mtl")):
        path = tmp_path / "folder" / f"{k}.obj"
        path.write_text(obj.format(name))
        caplog.clear()
        assert np.all(load_mesh(path).colors == 204)  # the material's red is not read
        assert "leads out of" in caplog.text


def test_an_obj_of_colors_only(tmp_path: Path) -> None:
    (tmp_path / "x.mtl").write_text("newmtl m\nNs 96\nKa 0 0 0\nKd 1 0.5 0\nd 1\nnewmtl n\nKd 0 0 1\n")
    (tmp_path / "x.obj").write_text(
        "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl m\nf 1 2 3\nusemtl n\nf 1 2 4\n"
    )
    mesh = load_mesh(tmp_path / "x.obj")
    assert {tuple(c) for c in mesh.colors[mesh.faces[:, 0]].tolist()} == {(255, 128, 0), (0, 0, 255)}


def test_an_obj_without_its_material_is_told_and_grey(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "x.obj").write_text(
        "mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    mesh = load_mesh(tmp_path / "x.obj")
    assert mesh.textures == ()
    assert np.all(mesh.colors == 204)
    assert "gone.mtl" in caplog.text


def test_obj_with_a_texture(tmp_path: Path) -> None:
    (tmp_path / "m.png").write_bytes(encoded(COLORS))
    (tmp_path / "m.mtl").write_text("newmtl m\nKd 0.5 0.5 0.5\nmap_Kd m.png\nnewmtl n\nKd 1 0 0\n")
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "usemtl m\nf 1/1 2/2 3/3\nusemtl n\nf 1/1 3/3 4/4\n"
    )
    mesh = load_mesh(tmp_path / "m.obj")
    assert mesh.uv is not None
    assert mesh.face_textures is not None
    assert sorted(mesh.face_textures.tolist()) == [-1, 0]
    plain, textured = (mesh.faces[mesh.face_textures == k][0] for k in (-1, 0))
    assert mesh.colors[plain].tolist() == [[255, 0, 0]] * 3
    assert mesh.colors[textured].tolist() == [[255, 255, 255]] * 3
    np.testing.assert_allclose(mesh.uv[textured, 0], mesh.vertices[textured, 0])
    np.testing.assert_allclose(mesh.uv[textured, 1], 1 - mesh.vertices[textured, 1])
    np.testing.assert_array_equal(mesh.textures[0].pixels[..., :3], COLORS)


def test_ply_with_face_colours(tmp_path: Path) -> None:
    square = trimesh.Trimesh(vertices=SQUARE, faces=TWO.reshape(-1, 3), process=False)
    square.visual.face_colors = [[255, 0, 0, 255], [0, 0, 255, 255]]
    square.export(tmp_path / "x.ply")
    mesh = load_mesh(tmp_path / "x.ply")
    assert mesh.colors[mesh.faces].tolist() == [[[255, 0, 0]] * 3, [[0, 0, 255]] * 3]
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], SQUARE[TWO.reshape(-1, 3)])


# --- hostile files ----------------------------------------------------------------------------------------------------
HOSTILE: dict[str, tuple[tuple[Any, ...], Any]] = {
    "a billion vertices": (("accessors", 0, "count"), 10**9),
    "more vertices than any number holds": (("accessors", 0, "count"), 10**30),
    "a billion vertices without bytes": (("accessors", 0), {"componentType": FLOAT, "type": "VEC3", "count": 10**9}),
    "a negative count": (("accessors", 0, "count"), -1),
    "a count of text": (("accessors", 0, "count"), "4"),
    "an offset before the start": (("accessors", 0, "byteOffset"), -12),
    "an offset past the end": (("accessors", 0, "byteOffset"), 10**12),
    "a view before the start": (("bufferViews", 0, "byteOffset"), -8),
    "a view past the end": (("bufferViews", 0, "byteLength"), 10**9),
    "a stride of one": (("bufferViews", 0, "byteStride"), 1),
    "a stride past the end": (("bufferViews", 0, "byteStride"), 10**9),
    "an accessor of matrices": (("accessors", 0, "type"), "MAT4"),
    "positions of two numbers": (("accessors", 0, "type"), "VEC2"),
    "an unknown component": (("accessors", 0, "componentType"), 5130),
    "a component that is a list": (("accessors", 0, "componentType"), []),
    "indices past the vertices": (("accessors", 0, "count"), 2),
    "indices that are fractions": (("meshes", 0, "primitives", 0, "indices"), 0),
    "no such accessor": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), 99),
    "an accessor before the first": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), -1),
    "attributes that are a list": (("meshes", 0, "primitives", 0, "attributes"), []),
    "fewer texture coordinates": (("accessors", 1, "count"), 3),
    "no such mesh": (("nodes", 0, "mesh"), 5),
    "no such node": (("scenes", 0, "nodes"), [7]),
    "no such scene": (("scene",), 3),
    "a node below itself": (("nodes", 0, "children"), [0]),
    "two nodes below each other": (("nodes",), [{"children": [1]}, {"children": [0], "mesh": 0}]),
    "a node with two parents": (("nodes",), [{"children": [1, 1]}, {"mesh": 0}]),
    "children that are a number": (("nodes", 0, "children"), 5),
    "a matrix of three": (("nodes", 0, "matrix"), [1, 2, 3]),
    "a scale of text": (("nodes", 0, "scale"), ["a", "b", "c"]),
    "a scale beyond float32": (("nodes", 0, "scale"), [1e300, 1, 1]),
    "no such material": (("meshes", 0, "primitives", 0, "material"), 9),
    "no such texture": (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index"), 9),
    "no such image": (("textures", 0, "source"), 9),
    "a factor that is none": (("materials", 0, "pbrMetallicRoughness", "baseColorFactor"), ["red"]),
    "no such buffer": (("bufferViews", 0, "buffer"), 4),
    "a buffer of nowhere": (("buffers",), [{"byteLength": 5, "uri": "gone.bin"}]),
    "buffers that are none": (("buffers",), None),
    "compressed in a way that is not read": (("extensionsRequired",), ["MAKER_mesh_compression"]),
    "glTF 1.0": (("asset", "version"), "1.0"),
    "meshes that are numbers": (("meshes",), [1]),
    "required extensions that are a text": (("extensionsRequired",), "KHR_materials_unlit"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_documents_are_refused(tmp_path: Path, case: str) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    size = [{"byteLength": build.chunk.size}]
    document = {"accessors": build.chunk.accessors, "bufferViews": build.chunk.views, "buffers": size, **build.document}
    document = copy.deepcopy(document)
    keys, value = HOSTILE[case]
    at: Any = document
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    path = tmp_path / "hostile.glb"
    path.write_bytes(pack_glb(document, build.chunk))
    with pytest.raises(SceneError, match=r"(?ms)hostile\.glb$.*H3-MESH-02[16]"):
        load_mesh(path)
    if "materials" not in keys and "extensionsRequired" not in keys:
        with suppress(SceneError):
            node_box(path)


def test_a_primitive_without_positions_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    build = Builder()
    build.document["meshes"][0]["primitives"].append({"attributes": {"NORMAL": 0}})
    assert len(build.mesh(tmp_path).faces) == 2
    assert "meshes[0].primitives[1] has no POSITION" in caplog.text
    del build.document["meshes"][0]["primitives"][0]
    with pytest.raises(SceneError, match="H3-MESH-024"):
        build.mesh(tmp_path)


def test_gltf_1_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "1.0"}, "scene": "s", "scenes": {"s": {}}}))
    with pytest.raises(SceneError, match=r"(?s)is glTF 1\.0.*gltf-pipeline.*H3-MESH-021"):
        load_mesh(tmp_path / "a.gltf")
    (tmp_path / "a.glb").write_bytes(b"glTF" + struct.pack("<4I", 1, 24, 4, 0) + b"{}  ")
    with pytest.raises(SceneError, match=r"(?s)1, which is not read.*gltf-pipeline.*H3-MESH-003"):
        load_mesh(tmp_path / "a.glb")


def test_unknown_required_extensions_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    build = Builder()
    build.document["extensionsRequired"] = ["KHR_texture_transform", "MAKER_materials_hologram"]
    assert len(build.mesh(tmp_path).faces) == 2
    assert "['MAKER_materials_hologram']" in caplog.text
    build.document["extensionsRequired"] = ["MAKER_mesh_hologram"]
    with pytest.raises(SceneError, match=r"(?s)MAKER_mesh_hologram, which is not.*H3-MESH-021"):
        build.mesh(tmp_path)


def test_vertices_that_are_not_numbers(tmp_path: Path) -> None:
    build = Builder()
    points = SQUARE.copy()
    points[2] = np.nan
    build.attribute("POSITION", points, "VEC3", FLOAT)
    with pytest.raises(SceneError, match="H3-MESH-026"):
        build.mesh(tmp_path)
    build.primitive["indices"] = build.chunk.array(np.array([0, 1, 3], np.uint16), "SCALAR", U16)
    assert np.isfinite(build.mesh(tmp_path).vertices).all(), "a vertex that nothing uses does no harm"


def test_copies_by_nodes_do_not_take_gigabytes(tmp_path: Path) -> None:
    build = Builder()
    order = np.tile(TWO, 100_000)
    build.primitive["indices"] = build.chunk.array(order, "SCALAR", U16)
    build.document["nodes"] = [{"mesh": 0}] * 1000
    build.document["scenes"] = [{"nodes": list(range(1000))}]
    with pytest.raises(SceneError, match=r"(?s)200000000 triangles.*H3-MESH-021"):
        build.mesh(tmp_path)


def test_one_image_named_many_times_is_decoded_once(tmp_path: Path) -> None:
    build = Builder()
    for _ in range(200):
        build.image(encoded(COLORS))
    primitives = [{**build.primitive, "material": k} for k in range(200)]
    build.document["meshes"][0]["primitives"] = primitives
    assert len(build.mesh(tmp_path).textures) == 1


def test_cut_off_anywhere(tmp_path: Path) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    data = build.data()
    path = tmp_path / "x.glb"
    for cut in [*range(24), *range(24, len(data), 29), len(data) - 1]:
        path.write_bytes(data[:cut])
        os.utime(path, ns=(cut, cut))
        with pytest.raises(SceneError, match=r"(?s)x\.glb.*H3-MESH-0(02|04|21)"):
            load_mesh(path)
    path = separate(build, tmp_path / "folder")
    for k, file in enumerate((path, path.parent / "some bytes.bin")):
        whole = file.read_bytes()
        for cut in range(0, len(whole), 11):
            file.write_bytes(whole[:cut])
            os.utime(path, ns=(cut, k))
            with suppress(SceneError):  # the end of the bytes is an image
                load_mesh(path)
        file.write_bytes(whole)


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj"])
def test_other_formats_cut_off_anywhere(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x.{suffix}"
    trimesh.creation.box().export(path)
    whole = path.read_bytes()
    for cut in range(0, len(whole), 13):
        path.write_bytes(whole[:cut])
        os.utime(path, ns=(cut, cut))
        with suppress(SceneError):
            load_mesh(path)


def test_a_ply_of_a_billion_vertices(tmp_path: Path) -> None:
    for kind in ("ascii", "binary_little_endian"):
        path = tmp_path / f"{kind}.ply"
        path.write_text(
            f"ply\nformat {kind} 1.0\nelement vertex 1000000000\nproperty float x\nproperty float y\n"
            "property float z\nelement face 1000000000\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n"
        )
        with pytest.raises(SceneError, match=r"(?ms)\.ply$.*H3-MESH-02[14]"):
            load_mesh(path)


@settings(max_examples=150)
@given(st.data())
def test_flipped_bits_never_crash(tmp_path_factory: Any, data: st.DataObject) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    build.attribute("NORMAL", SQUARE, "VEC3", FLOAT)
    raw = bytearray(build.data())
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(12, len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.mktemp("flip") / "x.glb"
    path.write_bytes(raw)
    for read in (load_mesh, node_box):
        with suppress(SceneError):
            read(path)
