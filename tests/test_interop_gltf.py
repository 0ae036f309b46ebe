"""glTF files of every shape: accessors, primitives, node graphs, materials and images; and files meant to do harm."""

from __future__ import annotations

import base64
import copy
import io
import json
import logging
import os
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from h3data.errors import SceneError
from h3data.interop import images
from h3data.interop.images import image_size, image_texture, largest_side, reduced
from h3data.interop.meshes import load_mesh, node_box
from h3data.scene.glb import GlbChunk, pack_glb
from h3data.scene.records import Mesh
from h3data.srgb import bytes_to_linear, linear_to_bytes

FLOAT, U8, U16, U32, I8 = 5126, 5121, 5123, 5125, 5120
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
TWO = np.array([0, 1, 2, 0, 2, 3], np.uint16)
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8).reshape(2, 2, 3)

# An 8 x 8 image of four colours, in KTX2 with UASTC blocks.
KTX2 = base64.b64decode(
    "q0tUWCAyMLsNChoKAAAAAAEAAAAIAAAACAAAAAAAAAAAAAAAAQAAAAEAAAAAAAAAaAAAACwAAACUAAAALAAAAAAAAAAAAAAAAAAA"
    "AAAAAADAAAAAAAAAAEAAAAAAAAAAQAAAAAAAAAAsAAAAAAAAAAIAKACmAQIAAwMAABAAAAAAAAAAAAB/AAAAAAAAAAAA/////x8A"
    "AABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuMTAAAAQAAAB/fwAAF9nD499cIQAAAAAAAAAAANcD2ePfDCsAAAAAAAAAAADX"
    "wwP53wxhAQAAAAAAAAAAl5ub+x9zzgEAAAAAAAAAAA=="
)


def encoded(pixels: np.ndarray, kind: str = "PNG", **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format=kind, **options)
    return file.getvalue()


class Builder:
    """A GLB with one square, to which tests add what they are about."""

    def __init__(self) -> None:
        self.chunk = GlbChunk()
        self.primitive: dict[str, Any] = {
            "attributes": {
                "POSITION": self.chunk.array(SQUARE, "VEC3", FLOAT),
                "TEXCOORD_0": self.chunk.array(UV, "VEC2", FLOAT),
            },
            "indices": self.chunk.array(TWO, "SCALAR", U16),
        }
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [self.primitive]}],
        }

    def attribute(self, name: str, values: np.ndarray, kind: str, component: int, **more: Any) -> None:
        self.primitive["attributes"][name] = self.chunk.array(values, kind, component, **more)

    def image(self, data: bytes, material: dict[str, Any] | None = None, **texture: Any) -> None:
        """Gives the square a material with this image."""
        stored = self.document.setdefault("images", [])
        stored.append({"bufferView": self.chunk.view(data), "mimeType": "image/png"})
        textures = self.document.setdefault("textures", [])
        textures.append(texture or {"source": len(stored) - 1})
        pbr = {"baseColorTexture": {"index": len(textures) - 1}}
        material = {"pbrMetallicRoughness": pbr, **(material or {})}
        self.document.setdefault("materials", []).append(material)
        self.primitive["material"] = len(self.document["materials"]) - 1

    def data(self) -> bytes:
        sizes = [{"byteLength": self.chunk.size}]
        more = {"accessors": self.chunk.accessors, "bufferViews": self.chunk.views, "buffers": sizes}
        return pack_glb({**more, **self.document}, self.chunk)

    def mesh(self, folder: Path) -> Mesh:
        path = folder / f"{len(list(folder.iterdir()))}.glb"
        path.write_bytes(self.data())
        return load_mesh(path)


# --- materials and images ---------------------------------------------------------------------------------------------
def test_texture_times_factor_times_vertex_colour(tmp_path: Path) -> None:
    build = Builder()
    factor, vertex = np.array([0.5, 1.0, 0.25]), np.array([0.4, 0.2, 0.8], np.float32)
    build.image(encoded(COLORS))
    build.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [*factor, 1]
    build.attribute("COLOR_0", np.tile(vertex, (4, 1)), "VEC3", FLOAT)
    mesh = build.mesh(tmp_path)
    np.testing.assert_array_equal(mesh.colors, np.tile(linear_to_bytes(factor * vertex), (4, 1)))
    assert mesh.uv is not None
    np.testing.assert_array_equal(mesh.uv, UV)
    np.testing.assert_array_equal(mesh.textures[0].pixels[..., :3], COLORS)


@pytest.mark.parametrize(("component", "dtype", "one"), [(U8, np.uint8, 255), (U16, np.uint16, 65535)])
def test_vertex_colours_count_although_there_is_a_material(
    tmp_path: Path, component: int, dtype: type, one: int
) -> None:
    build = Builder()
    build.document["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1]}}]
    build.primitive["material"] = 0
    colors = np.array([[one, 0, 0, one], [0, one // 2, 0, one], [one, one, one, 0], [0, 0, 0, 0]], dtype)
    build.attribute("COLOR_0", colors, "VEC4", component, normalized=True)
    expected = linear_to_bytes(colors[:, :3] / one * 0.5)
    assert np.abs(build.mesh(tmp_path).colors.astype(int) - expected).max() <= 1


def test_materials_of_several_primitives(tmp_path: Path) -> None:
    build = Builder()
    for pixels in (COLORS, COLORS[::-1], COLORS):
        build.image(encoded(pixels))
    build.document["materials"].append({})
    attributes = build.primitive["attributes"]
    build.document["meshes"][0]["primitives"] = [
        {"attributes": attributes, "indices": build.primitive["indices"], "material": k} for k in (0, 1, 2, 3)
    ]
    mesh = build.mesh(tmp_path)
    assert mesh.face_textures is not None
    assert mesh.face_textures.tolist() == [0, 0, 1, 1, 0, 0, -1, -1], "equal images are one texture"
    assert len(mesh.textures) == 2
    assert np.all(mesh.colors == 255)


def test_files_with_the_same_image_share_it(tmp_path: Path) -> None:
    meshes = []
    for height in (1.0, 2.0):
        build = Builder()
        build.image(encoded(COLORS))
        build.document["nodes"][0]["translation"] = [0, height, 0]
        meshes.append(build.mesh(tmp_path))
    assert meshes[0].textures[0] is meshes[1].textures[0]


def test_a_palette_becomes_colours(tmp_path: Path) -> None:
    build = Builder()
    uv = np.full((4, 2), (0.75, 1.25), np.float32)  # repeated: the upper right texel
    build.attribute("TEXCOORD_0", uv, "VEC2", FLOAT)
    build.image(encoded(COLORS))
    build.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 0.5, 1, 1]
    mesh = build.mesh(tmp_path)
    assert mesh.textures == ()
    assert mesh.colors[0].tolist() == [0, 188, 0]


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({"offset": [0.25, -1]}, UV + np.array([0.25, -1])),
        ({"scale": [2, 3]}, UV * (2, 3)),
        # a quarter turn counter-clockwise as seen on the image, whose v points down: right becomes up
        ({"rotation": np.pi / 2}, np.stack([UV[:, 1], -UV[:, 0]], -1)),
        # the extension's own example: the lower left quarter of the image
        (
            {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]},
            np.stack([0.5 * UV[:, 1], 1 - 0.5 * UV[:, 0]], -1),
        ),
        ({"texCoord": 1}, UV + 7),
    ],
)
def test_texture_transform(tmp_path: Path, transform: dict[str, Any], expected: np.ndarray) -> None:
    build = Builder()
    build.attribute("TEXCOORD_1", UV + np.float32(7), "VEC2", FLOAT)
    build.image(encoded(COLORS))
    info = build.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": transform}
    mesh = build.mesh(tmp_path)
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv, expected, atol=1e-6)


def test_opacity_counts_only_where_the_material_says_so(tmp_path: Path) -> None:
    pixels = np.dstack([COLORS, [[255, 0], [100, 200]]]).astype(np.uint8)
    for material, expected in (
        ({}, [255, 255, 255, 255]),
        ({"alphaMode": "MASK"}, [255, 0, 0, 255]),
        ({"alphaMode": "MASK", "alphaCutoff": 0.3}, [255, 0, 255, 255]),
        ({"alphaMode": "BLEND"}, [255, 0, 100, 200]),
    ):
        build = Builder()
        build.image(encoded(pixels), material)
        assert build.mesh(tmp_path).textures[0].pixels[..., 3].ravel().tolist() == expected


def test_images_of_every_kind(tmp_path: Path) -> None:
    large = COLORS.repeat(8, 0).repeat(8, 1)
    for kind, tolerance in (("PNG", 0), ("WEBP", 0), ("JPEG", 12), ("BMP", 0)):
        options = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"lossless": True}}.get(kind, {})
        build = Builder()
        build.image(encoded(large, kind, **options))
        pixels = build.mesh(tmp_path).textures[0].pixels
        assert np.abs(pixels[..., :3].astype(int) - large).max() <= tolerance
    gray = Builder()
    gray.image(encoded((np.arange(4, dtype=np.uint16) * 20_000).reshape(2, 2)))  # 16 bits
    assert gray.mesh(tmp_path).textures[0].pixels[..., 0].ravel().tolist() == [0, 78, 156, 234]
    fallback = Builder()
    fallback.image(encoded(COLORS, "WEBP", lossless=True), extensions={"EXT_texture_webp": {"source": 0}})
    np.testing.assert_array_equal(fallback.mesh(tmp_path).textures[0].pixels[..., :3], COLORS)


def ktx2_square(tmp_path: Path) -> Mesh:
    build = Builder()
    for _ in range(2):
        build.image(KTX2, extensions={"KHR_texture_basisu": {"source": 0}})
    build.document["materials"][1]["pbrMetallicRoughness"]["baseColorFactor"] = [0, 1, 0, 1]
    build.document["meshes"][0]["primitives"] = [{**build.primitive, "material": k} for k in (0, 1)]
    return build.mesh(tmp_path)


def test_ktx2_images(tmp_path: Path) -> None:
    pytest.importorskip("opengl_basisu")
    pixels = ktx2_square(tmp_path).textures[0].pixels
    assert pixels[[0, 0, 7, 7], [0, 7, 0, 7], :3].tolist() == [
        [200, 30, 30],
        [30, 200, 30],
        [30, 30, 200],
        [220, 220, 220],
    ]


def test_an_image_that_cannot_be_had_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "opengl_basisu", None)
    monkeypatch.setattr(images, "_textures", {})  # as if no file with it had been read yet
    with caplog.at_level(logging.WARNING):
        mesh = ktx2_square(tmp_path)
    assert mesh.textures == ()
    assert mesh.colors[[0, -1]].tolist() == [[255, 255, 255], [0, 255, 0]]
    assert len(caplog.records) == 1
    assert "h3data[gltf]" in caplog.text
    assert "0.glb" in caplog.text


@pytest.mark.parametrize("data", [b"", b"nothing", encoded(COLORS)[:40], KTX2[:90], KTX2[:12]])
def test_damaged_images_leave_the_material(tmp_path: Path, data: bytes, caplog: pytest.LogCaptureFixture) -> None:
    build = Builder()
    build.image(data)
    mesh = build.mesh(tmp_path)
    assert mesh.textures == ()
    assert len(mesh.faces) == 2
    assert len(caplog.records) == 1


def test_images_that_claim_to_be_huge_are_not_decoded() -> None:
    header = struct.pack(">4sIIBBBBB", b"IHDR", 60_000, 60_000, 8, 6, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + b"\0" * 4 + encoded(COLORS)[33:]
    ktx2 = KTX2[:20] + struct.pack("<II", 60_000, 60_000) + KTX2[28:]
    for data in (png, ktx2):
        with pytest.raises(SceneError):
            image_size(data)
        with pytest.raises(SceneError):
            image_texture(data)


def test_large_images_are_reduced_by_area_in_linear_light() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (64, 32, 4)).astype(np.uint8)
    pixels[..., 3] = 255
    light = bytes_to_linear(pixels[..., :3]).reshape(16, 4, 8, 4, 3).mean((1, 3))
    small = reduced(pixels, 16)
    assert small.shape == (16, 8, 4)
    assert np.abs(small[..., :3].astype(int) - linear_to_bytes(light)).max() <= 1
    assert image_texture(encoded(pixels), side=16).pixels.shape == (16, 8, 4)
    assert image_texture(encoded(pixels[..., :3], "JPEG"), side=16).pixels.shape == (16, 8, 4)
    assert reduced(pixels[:33, :31], 16).shape == (9, 8, 4)
    clear = pixels.copy()
    clear[::2, :, 3] = 0  # what is not seen does not count
    seen = bytes_to_linear(clear[1::2, :, :3]).reshape(32, 1, 16, 2, 3).mean((1, 3))
    half = reduced(clear, 32)
    assert np.abs(half[..., :3].astype(int) - linear_to_bytes(seen)).max() <= 1
    assert np.all(half[..., 3] == 128)


def test_many_images_share_the_memory_of_a_file() -> None:
    assert largest_side([(4096, 4096)]) == 2048
    assert largest_side([(2048, 2048)] * 32) == 2048
    assert largest_side([(2048, 2048)] * 33) == 1024
    assert largest_side([(64, 64)] * 1000) == 2048


# --- accessors --------------------------------------------------------------------------------------------------------
def test_interleaved_and_normalised_attributes(tmp_path: Path) -> None:
    """As EXT/KHR_mesh_quantization: 16-bit positions scaled by the node, 8-bit normals, all in one view of stride 20."""
    build = Builder()
    rows = np.zeros((4, 20), np.uint8)
    rows[:, :6] = (SQUARE * 1000).astype("<u2").view(np.uint8)
    rows[:, 8:11] = np.array([0, 0, 127], np.int8).view(np.uint8)
    rows[:, 12:16] = (UV * 65535).astype("<u2").view(np.uint8)
    view = build.chunk.view(rows.tobytes(), byteStride=20)
    for name, kind, component, offset in (("POSITION", "VEC3", U16, 0), ("NORMAL", "VEC3", I8, 8),
                                          ("TEXCOORD_0", "VEC2", U16, 12)):  # fmt: skip
        build.chunk.accessors.append({"bufferView": view, "byteOffset": offset, "componentType": component,
                                      "count": 4, "type": kind, "normalized": name != "POSITION"})  # fmt: skip
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
        with pytest.raises(SceneError, match="without triangles"):
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


# --- files beside -----------------------------------------------------------------------------------------------------
def separate(build: Builder, folder: Path, **uris: str) -> Path:
    """The same as a .gltf with its bytes in a file beside."""
    folder.mkdir(exist_ok=True)
    data = b"".join(build.chunk.parts)
    (folder / "some bytes.bin").write_bytes(data)
    document = {
        **build.document,
        "accessors": build.chunk.accessors,
        "bufferViews": build.chunk.views,
        "buffers": [{"byteLength": len(data), "uri": uris.get("buffer", "some%20bytes.bin")}],
    }
    if "image" in uris:
        document["images"] = [{"uri": uris["image"]}]
    path = folder / "x.gltf"
    path.write_text(json.dumps(document))
    os.utime(path, ns=(len(list(folder.iterdir())), hash(str(uris)) % 2**40))
    return path


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
    "uri", ["../secret.bin", "a/../../secret.bin", "%2e%2e/secret.bin", "..\\secret.bin", "{}/secret.bin",
            "file:///secret.bin", "https://example.org/secret.bin", "..", "C:\\secret.bin"],
)  # fmt: skip
@pytest.mark.parametrize("what", ["buffer", "image"])
def test_files_outside_the_folder_are_refused(tmp_path: Path, uri: str, what: str) -> None:
    build = Builder()
    build.image(encoded(COLORS))
    (tmp_path / "secret.bin").write_bytes(b"".join(build.chunk.parts))
    path = separate(build, tmp_path / "folder", **{what: uri.format(tmp_path)})
    with pytest.raises(SceneError, match=r"leads out of .*x\.gltf$"):
        load_mesh(path)


def test_an_obj_does_not_reach_outside_either(tmp_path: Path) -> None:
    (tmp_path / "out.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "folder").mkdir()
    obj = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    for k, name in enumerate(("../out.mtl", str(tmp_path / "out.mtl"), "..\\out.mtl")):
        path = tmp_path / "folder" / f"{k}.obj"
        path.write_text(obj.format(name))
        with pytest.raises(SceneError, match="leads out of"):
            load_mesh(path)


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
    "no positions": (("meshes", 0, "primitives", 0, "attributes"), {}),
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
    "compressed in a way that is not read": (("extensionsRequired",), ["EXT_meshopt_compression"]),
    "meshes that are numbers": (("meshes",), [1]),
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
    with pytest.raises(SceneError, match=r"hostile\.glb$"):
        load_mesh(path)
    if "materials" not in keys and "extensionsRequired" not in keys:
        with suppress(SceneError):
            node_box(path)


def test_vertices_that_are_not_numbers(tmp_path: Path) -> None:
    build = Builder()
    points = SQUARE.copy()
    points[2] = np.nan
    build.attribute("POSITION", points, "VEC3", FLOAT)
    with pytest.raises(SceneError, match="not finite"):
        build.mesh(tmp_path)
    build.primitive["indices"] = build.chunk.array(np.array([0, 1, 3], np.uint16), "SCALAR", U16)
    assert np.isfinite(build.mesh(tmp_path).vertices).all(), "a vertex that nothing uses does no harm"


def test_copies_by_nodes_do_not_take_gigabytes(tmp_path: Path) -> None:
    build = Builder()
    order = np.tile(TWO, 100_000)
    build.primitive["indices"] = build.chunk.array(order, "SCALAR", U16)
    build.document["nodes"] = [{"mesh": 0}] * 1000
    build.document["scenes"] = [{"nodes": list(range(1000))}]
    with pytest.raises(SceneError, match="200000000 triangles"):
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
        with pytest.raises(SceneError, match=r"x\.glb"):
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
        with pytest.raises(SceneError, match=r"\.ply$"):
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
