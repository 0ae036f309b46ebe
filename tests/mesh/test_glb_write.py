"""GLB files for other programs: what our own reader and trimesh see in them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from h3data.errors import SceneError
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh_operations import face_texture_indices, joined
from h3data.scene import Mesh, Texture
from h3data.srgb import bytes_to_linear, linear_to_bytes
from h3data_exporters.glb_write import MAX_LOOKS, GlbNode, glb_bytes
from h3data_homes import HomeSpec, build_home

RNG = np.random.default_rng(4)
WOOD, CLOTH = (
    Texture(pixels=RNG.integers(0, 256, (4, 8, 4)).astype(np.uint8) | np.array([0, 0, 0, 255], np.uint8), name=name)
    for name in ("wood", "cloth")
)


def strip(*, textures: tuple[Texture, ...], choice: list[int] | None, colors: list[tuple[int, int, int]]) -> Mesh:
    """A triangle for each colour, side by side, with texture coordinates beyond 0..1."""
    count = len(colors)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    vertices = (corners + np.arange(count, dtype=np.float32)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        colors=np.repeat(np.array(colors, np.uint8), 3, axis=0),
        uv=(vertices[:, :2] * 1.7 - 0.3).astype(np.float32),
        textures=textures,
        face_textures=None if choice is None else np.array(choice, np.int16),
    )


def seen(mesh: Mesh) -> list[tuple]:
    """Every triangle as where it is, its colours, its texture and where on it; in a fixed order."""
    kinds = face_texture_indices(mesh)
    uv = np.zeros((len(mesh.vertices), 2)) if mesh.uv is None else mesh.uv
    rows = []
    for face, kind in zip(mesh.faces, kinds, strict=True):
        texels = mesh.textures[kind].pixels.tobytes() if kind >= 0 else b""
        rows.append(
            (mesh.vertices[face].tolist(), mesh.colors[face].tolist(), texels, uv[face].tolist() if texels else [])
        )
    return sorted(rows)


def test_textures_times_colours_come_back(tmp_path: Path) -> None:
    meshes = [
        strip(
            textures=(WOOD, CLOTH),
            choice=[0, -1, 1, 0, 0, -1],
            colors=[(255, 255, 255), (10, 20, 30), (200, 100, 0), (3, 200, 90), (255, 255, 255), (0, 0, 0)],
        ),
        strip(textures=(CLOTH,), choice=None, colors=[(200, 100, 0)]),
        strip(textures=(), choice=None, colors=[(1, 2, 3)]),
    ]
    data = glb_bytes(meshes)
    assert data == glb_bytes(meshes)
    (tmp_path / "m.glb").write_bytes(data)
    assert seen(load_mesh(tmp_path / "m.glb")) == seen(joined(meshes))
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert [len(m["primitives"]) for m in document["meshes"]] == [1] * 6, (
        "habitat-sim may cull by the box of one of several"
    )
    assert [len(n.get("children", [])) for n in document["nodes"][:3]] == [4, 0, 0]
    assert len(document["materials"]) == 4, "a palette, wood in two colours, cloth in one that two meshes share"
    assert len(document["images"]) == 3


def test_trimesh_sees_the_same_materials(tmp_path: Path) -> None:
    mesh = strip(textures=(WOOD,), choice=[0, -1], colors=[(200, 100, 0), (9, 8, 7)])
    (tmp_path / "m.glb").write_bytes(glb_bytes([mesh]))
    scene = trimesh.load_scene(tmp_path / "m.glb", process=False)
    parts = {p.visual.material.name: p for p in scene.geometry.values()}
    wood, palette = parts["wood #c86400"], parts["palette"]
    factor = wood.visual.material.baseColorFactor[:3]
    assert np.abs(linear_to_bytes(factor / 255).astype(int) - (200, 100, 0)).max() <= 3, "trimesh keeps 8 linear bits"
    np.testing.assert_array_equal(np.asarray(wood.visual.material.baseColorTexture), WOOD.pixels[..., :3])
    np.testing.assert_allclose(wood.visual.uv * (1, -1) + (0, 1), mesh.uv[:3], atol=1e-6)
    image = np.asarray(palette.visual.material.baseColorTexture)
    at = np.floor((palette.visual.uv * (1, -1) + (0, 1)) * image.shape[1::-1]).astype(int)
    assert np.unique(image[at[:, 1], at[:, 0]], axis=0).tolist() == [[9, 8, 7]]


def test_a_floor_of_many_colours_is_drawn_in_few(tmp_path: Path) -> None:
    colors = [tuple(c) for c in RNG.integers(100, 140, (500, 3)).tolist()]
    mesh = strip(textures=(WOOD, CLOTH), choice=[k % 3 - 1 for k in range(500)], colors=colors)
    data = glb_bytes([mesh])
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert MAX_LOOKS / 8 < len(document["materials"]) <= MAX_LOOKS + 1
    (tmp_path / "m.glb").write_bytes(data)
    again = seen(load_mesh(tmp_path / "m.glb"))
    for ours, theirs in zip(seen(mesh), again, strict=True):
        assert ours[2:] == theirs[2:]
        limit = 31 if ours[2] else 0  # cells of 32 levels
        assert np.abs(np.array(ours[1]) - theirs[1]).max() <= limit


def test_corners_of_several_colours_keep_their_texture(tmp_path: Path) -> None:
    mesh = strip(textures=(WOOD,), choice=None, colors=[(0, 0, 0), (50, 50, 50)])
    colors = mesh.colors.copy()
    colors[0] = (90, 30, 0)
    (tmp_path / "m.glb").write_bytes(glb_bytes([replace(mesh, colors=colors)]))
    again = load_mesh(tmp_path / "m.glb")
    assert np.unique(again.colors, axis=0).tolist() == [[30, 10, 0], [50, 50, 50]]
    assert [row[3] for row in seen(again)] == [row[3] for row in seen(mesh)]


def test_clear_texels_are_masked(tmp_path: Path) -> None:
    pixels = WOOD.pixels.copy()
    pixels[::2, :, 3] = 0
    mesh = strip(textures=(Texture(pixels=pixels),), choice=None, colors=[(255, 255, 255)])
    (tmp_path / "m.glb").write_bytes(glb_bytes([mesh]))
    np.testing.assert_array_equal(load_mesh(tmp_path / "m.glb").textures[0].pixels, pixels)


def test_a_home_comes_back_with_its_textures(tmp_path: Path) -> None:
    home = build_home(HomeSpec(seed=2))
    keys = sorted({i.asset for i in home.instances})
    meshes = [home.assets[k].mesh for k in keys if len(home.assets[k].mesh.faces)]
    (tmp_path / "m.glb").write_bytes(glb_bytes(meshes))
    again, whole = load_mesh(tmp_path / "m.glb"), joined(meshes)
    assert len(again.faces) == len(whole.faces)
    for mesh in (again, whole):
        assert len(mesh.textures) > 3

    def mean_light(mesh: Mesh) -> np.ndarray:
        """Per texture (by its texels): area, and colour weighted by it."""
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        light = bytes_to_linear(mesh.colors[mesh.faces].mean(1))
        kinds = face_texture_indices(mesh)
        rows = {b"" if k < 0 else mesh.textures[k].pixels.tobytes(): k for k in np.unique(kinds)}
        return np.array(
            [[*(area[kinds == k] @ light[kinds == k]), area[kinds == k].sum()] for _, k in sorted(rows.items())]
        )

    np.testing.assert_allclose(mean_light(again), mean_light(whole), rtol=0.01, atol=0.01)


def test_nodes_place_meshes(tmp_path: Path) -> None:
    mesh = strip(textures=(WOOD,), choice=None, colors=[(255, 255, 255)])
    nodes = [GlbNode(name=f"n{k}", mesh=0, pose=np.array([k, 0, 0, 0, 0, 0, 1.0])) for k in range(3)]
    (tmp_path / "m.glb").write_bytes(glb_bytes([mesh], nodes))
    again = load_mesh(tmp_path / "m.glb")
    assert len(again.faces) == 3
    np.testing.assert_allclose(again.bounds, [[0, 0, 0], [3, 1, 0]])


def test_what_cannot_be_written() -> None:
    mesh = strip(textures=(WOOD,), choice=None, colors=[(255, 255, 255)])
    with pytest.raises(SceneError, match=r"(?s)uv that are not finite.*H3-MESH-008"):
        glb_bytes([replace(mesh, uv=np.full((3, 2), np.nan, np.float32))])
    with pytest.raises(SceneError, match=r"(?s)no triangles.*H3-MESH-008"):
        glb_bytes([replace(mesh, faces=mesh.faces[:0])])
