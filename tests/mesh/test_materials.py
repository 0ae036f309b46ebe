"""Materials and images of mesh files: factors, vertex colours, textures of every kind, images that cannot be had."""

from __future__ import annotations

import base64
import logging
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import SceneError
from h3data.mesh import images
from h3data.mesh.images import image_size, image_texture, largest_side, reduced
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh
from h3data.srgb import bytes_to_linear, linear_to_bytes
from tests.mesh.gltf_builder import COLORS, FLOAT, U8, U16, UV, Builder, encoded, separate

# An 8 x 8 image of four colours, in KTX2 with UASTC blocks.
KTX2 = base64.b64decode(
    "q0tUWCAyMLsNChoKAAAAAAEAAAAIAAAACAAAAAAAAAAAAAAAAQAAAAEAAAAAAAAAaAAAACwAAACUAAAALAAAAAAAAAAAAAAAAAAA"
    "AAAAAADAAAAAAAAAAEAAAAAAAAAAQAAAAAAAAAAsAAAAAAAAAAIAKACmAQIAAwMAABAAAAAAAAAAAAB/AAAAAAAAAAAA/////x8A"
    "AABLVFh3cml0ZXIAQmFzaXMgVW5pdmVyc2FsIDIuMTAAAAQAAAB/fwAAF9nD499cIQAAAAAAAAAAANcD2ePfDCsAAAAAAAAAAADX"
    "wwP53wxhAQAAAAAAAAAAl5ub+x9zzgEAAAAAAAAAAA=="
)


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
    """The texture's, times that of the base colour factor."""
    pixels = np.dstack([COLORS, [[255, 0], [100, 200]]]).astype(np.uint8)
    for material, factor, expected in (
        ({}, 1, [255, 255, 255, 255]),
        ({}, 0.5, [255, 255, 255, 255]),
        ({"alphaMode": "MASK"}, 1, [255, 0, 0, 255]),
        ({"alphaMode": "MASK"}, 0.6, [255, 0, 0, 0]),
        ({"alphaMode": "MASK", "alphaCutoff": 0.3}, 1, [255, 0, 255, 255]),
        ({"alphaMode": "MASK", "alphaCutoff": 0.3}, 0.6, [255, 0, 0, 255]),
        ({"alphaMode": "BLEND"}, 1, [255, 0, 100, 200]),
        ({"alphaMode": "BLEND"}, 0.6, [153, 0, 60, 120]),
    ):
        build = Builder()
        build.image(encoded(pixels), material)
        build.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, factor]
        assert build.mesh(tmp_path).textures[0].pixels[..., 3].ravel().tolist() == expected


def test_missing_textures_show_the_materials_colour_and_are_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    build = Builder()
    factors = ([1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1])
    primitives = []
    for k, factor in enumerate(factors):
        build.image(encoded(COLORS))
        build.document["materials"][k]["pbrMetallicRoughness"]["baseColorFactor"] = factor
        primitives.append({**build.primitive, "material": k})
    build.document["meshes"][0]["primitives"] = primitives
    build.document["images"] = [{"uri": f"gone{k}.png"} for k in range(len(factors))]
    mesh = load_mesh(separate(build, tmp_path / "a"))
    assert mesh.textures == ()
    seen = {tuple(color) for color in mesh.colors[mesh.faces[:, 0]].tolist()}
    assert seen == {(255, 0, 0), (0, 255, 0), (0, 0, 255)}
    (warning,) = caplog.records
    assert "gone0.png" in warning.getMessage()
    load_mesh(separate(build, tmp_path / "b"))
    assert len(caplog.records) == 2  # one for each file


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
