"""glTF files of every shape: accessors, primitives, node graphs; real files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import SceneError
from h3data.mesh.loading import load_mesh
from h3data_habitat.scenes.node_boxes import node_box
from tests.mesh.gltf_builder import COLORS, FLOAT, I8, SQUARE, TWO, U8, U16, U32, UV, Builder, encoded


# --- accessors --------------------------------------------------------------------------------------------------------
def test_interleaved_and_normalised_attributes(tmp_path: Path) -> None:
    """As EXT/KHR_mesh_quantization: 16-bit positions scaled by the node, 8-bit normals, all in one view of stride 20."""
    build = Builder()
    rows = np.zeros((4, 20), np.uint8)
    rows[:, :6] = (SQUARE * 1000).astype("<u2").view(np.uint8)
    rows[:, 8:11] = np.array([0, 0, 127], np.int8).view(np.uint8)
    rows[:, 12:16] = (UV * 65535).astype("<u2").view(np.uint8)
    view = build.chunk.view(rows.tobytes(), byteStride=20)
    for name, kind, component, offset in (
        ("POSITION", "VEC3", U16, 0),
        ("NORMAL", "VEC3", I8, 8),
        ("TEXCOORD_0", "VEC2", U16, 12),
    ):
        build.chunk.accessors.append(
            {
                "bufferView": view,
                "byteOffset": offset,
                "componentType": component,
                "count": 4,
                "type": kind,
                "normalized": name != "POSITION",
            }
        )
        build.primitive["attributes"][name] = len(build.chunk.accessors) - 1
    build.document["nodes"][0]["scale"] = [0.001, 0.001, 0.001]
    build.image(encoded(COLORS))
    mesh = build.mesh(tmp_path)
    np.testing.assert_allclose(mesh.vertices, SQUARE, atol=1e-6)
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1], (4, 1)))
    np.testing.assert_array_equal(mesh.uv, UV)


def test_sparse_accessors(tmp_path: Path) -> None:
    build = Builder()
    places = build.chunk.view(np.array([2, 3], np.uint8).tobytes())
    values = build.chunk.view(np.array([[5, 5, 5], [6, 6, 6]], np.float32).tobytes())
    sparse = {"count": 2, "indices": {"bufferView": places, "componentType": U8}, "values": {"bufferView": values}}
    build.chunk.accessors[0]["sparse"] = sparse
    assert build.mesh(tmp_path).vertices.tolist() == [[0, 0, 0], [1, 0, 0], [5, 5, 5], [6, 6, 6]]
    del build.chunk.accessors[0]["bufferView"]  # then the rest is zero
    assert build.mesh(tmp_path).vertices.tolist() == [[0, 0, 0], [0, 0, 0], [5, 5, 5], [6, 6, 6]]


def reference_triangles(order: list[int], mode: int) -> list[list[int]]:
    if mode == 5:
        faces = [[order[k], order[k + 1 + k % 2], order[k + 2 - k % 2]] for k in range(len(order) - 2)]
    elif mode == 6:
        faces = [[order[0], order[k + 1], order[k + 2]] for k in range(len(order) - 2)]
    else:
        faces = [order[k : k + 3] for k in range(0, len(order) - 2, 3)] if mode == 4 else []
    return [f for f in faces if len(set(f)) == 3]


def turned(faces: np.ndarray) -> set[tuple[tuple[float, ...], ...]]:
    """Triangles as corners, from their smallest corner on."""
    out = set()
    for corners in faces.tolist():
        k = corners.index(min(corners))
        out.add(tuple(tuple(c) for c in corners[k:] + corners[:k]))
    return out


@given(
    st.lists(st.integers(0, 5), min_size=3, max_size=12), st.sampled_from([4, 5, 6]), st.sampled_from([U8, U16, U32])
)
def test_triangles_strips_and_fans(tmp_path_factory: Any, order: list[int], mode: int, component: int) -> None:
    build = Builder()
    points = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    dtype = {U8: np.uint8, U16: np.uint16, U32: np.uint32}[component]
    build.primitive["attributes"] = {"POSITION": build.chunk.array(points, "VEC3", FLOAT)}
    build.primitive["indices"] = build.chunk.array(np.array(order, dtype), "SCALAR", component)
    build.primitive["mode"] = mode
    expected = reference_triangles(order, mode)
    folder = tmp_path_factory.mktemp("gltf")
    if not expected:
        with pytest.raises(SceneError, match="H3-MESH-024"):
            build.mesh(folder)
        return
    mesh = build.mesh(folder)
    assert len(mesh.faces) == len(expected)
    assert turned(mesh.vertices[mesh.faces]) == turned(points[expected])
    assert len(mesh.vertices) == len(set(np.ravel(expected))), "only vertices that are used"


def test_without_indices_and_points_left_out(tmp_path: Path) -> None:
    build = Builder()
    del build.primitive["indices"]
    build.primitive["mode"] = 5
    build.document["meshes"][0]["primitives"].append({**build.primitive, "mode": 0})
    assert len(build.mesh(tmp_path).faces) == 2


def test_draco_triangles(tmp_path: Path) -> None:
    draco = pytest.importorskip("DracoPy")
    build = Builder()
    packed = draco.encode(SQUARE, TWO.reshape(-1, 3), tex_coord=UV.astype(np.float64), preserve_order=True)
    ids = {a["attribute_type"]: a["unique_id"] for a in draco.decode(packed).attributes}
    view = build.chunk.view(packed)
    build.primitive["extensions"] = {
        "KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": ids[0], "TEXCOORD_0": ids[3]}}
    }
    build.image(encoded(COLORS))
    mesh = build.mesh(tmp_path)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [1, 1, 0]], atol=1e-3)
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv, np.stack([mesh.vertices[:, 0], 1 - mesh.vertices[:, 1]], -1), atol=2e-3)


# --- node graph -------------------------------------------------------------------------------------------------------
def test_nodes_with_matrices_and_parts_nested(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    build = Builder()
    rotation = rng.normal(size=4)
    rotation /= np.linalg.norm(rotation)
    matrix = rng.normal(size=(4, 4))
    matrix[3] = [0, 0, 0, 1]
    build.document["nodes"] = [
        {"children": [1], "translation": [1, 2, 3], "rotation": rotation.tolist(), "scale": [2, -1, 0.5]},
        {"mesh": 0, "matrix": matrix.T.ravel().tolist()},
    ]
    turn = trimesh.transformations.quaternion_matrix(rotation[[3, 0, 1, 2]])
    outer = trimesh.transformations.translation_matrix([1, 2, 3]) @ turn @ np.diag([2, -1, 0.5, 1])
    expected = trimesh.transform_points(SQUARE, outer @ matrix)
    mesh = build.mesh(tmp_path)
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-5)
    flipped = np.linalg.det(outer @ matrix) < 0
    assert mesh.faces.tolist() == ([[2, 1, 0], [3, 2, 0]] if flipped else [[0, 1, 2], [0, 2, 3]])


def test_normals_follow_mirrored_and_flat_nodes(tmp_path: Path) -> None:
    for scale, expected in (([1, 1, -2], [0, 0, -1]), ([-1, 1, 1], [0, 0, 1]), ([3, 3, 0], [0, 0, 1])):
        build = Builder()
        build.attribute("NORMAL", np.tile(np.float32([0, 0, 1]), (4, 1)), "VEC3", FLOAT)
        build.document["nodes"][0]["scale"] = scale
        mesh = build.mesh(tmp_path)
        assert mesh.normals is not None
        np.testing.assert_allclose(mesh.normals, np.tile(expected, (4, 1)), atol=1e-6)
    nothing = Builder()
    nothing.document["nodes"][0]["scale"] = [0, 0, 0]
    assert np.all(nothing.mesh(tmp_path).vertices == 0)


def test_meshes_shown_twice_and_files_without_a_scene(tmp_path: Path) -> None:
    build = Builder()
    build.document["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 0, "translation": [5, 0, 0]}, {"mesh": 0}]
    np.testing.assert_allclose(build.mesh(tmp_path).bounds, [[0, 0, 0], [6, 1, 0]])
    assert len(build.mesh(tmp_path).faces) == 4, "the third node is not in the scene"
    del build.document["scenes"]
    assert len(build.mesh(tmp_path).faces) == 6
    del build.document["nodes"]
    assert len(build.mesh(tmp_path).faces) == 2


def test_primitives_that_share_large_accessors_take_only_their_part(tmp_path: Path) -> None:
    build = Builder()
    points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    attributes = {"POSITION": build.chunk.array(points, "VEC3", FLOAT)}
    order = np.arange(999, dtype=np.uint16)
    build.document["meshes"][0]["primitives"] = [
        {"attributes": attributes, "indices": build.chunk.array(part, "SCALAR", U16)}
        for part in np.split(order, [300, 303])
    ]
    mesh = build.mesh(tmp_path)
    assert mesh.vertices[mesh.faces].tolist() == points[order.reshape(-1, 3)].tolist()
    assert len(mesh.vertices) == 999


# --- real files -------------------------------------------------------------------------------------------------------
def test_real_files_are_as_trimesh_reads_them(real: Path) -> None:
    for path in sorted(real.rglob("*.glb")):
        mesh = load_mesh(path)
        other = trimesh.load_scene(path, process=False).to_mesh()
        assert len(mesh.faces) == len(other.faces)
        np.testing.assert_allclose(
            np.sort(mesh.vertices[mesh.faces].reshape(-1, 9), 0), np.sort(other.triangles.reshape(-1, 9), 0), atol=1e-4
        )
        assert np.isfinite(node_box(path)).all()


def test_real_textures(real: Path) -> None:
    sizes = {p.name: [t.pixels.shape[:2] for t in load_mesh(p).textures] for p in real.rglob("*.glb")}
    assert sizes["chair.glb"]
    assert {name for name, found in sizes.items() if found} >= {"chair.glb", "body.glb", "top_door.glb"}
