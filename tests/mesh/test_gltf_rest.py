"""glTF as it stands at rest: skins, morph targets, instances, and surfaces that are see-through by their colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from h3data.mesh.mesh import Mesh
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole
from tests.mesh.gltf_builder import FLOAT, U8, U16, Builder

HALF = np.sqrt(0.5)


def skinned(nodes: list[dict], roots: list[int], *, joint: int, bind: np.ndarray | None = None) -> Builder:
    """The builder's square, all of it held by one joint; ``bind`` is its inverse bind matrix."""
    build = Builder()
    build.attribute("JOINTS_0", np.zeros((4, 4), np.uint8), "VEC4", U8)
    build.attribute("WEIGHTS_0", np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1)), "VEC4", FLOAT)
    build.attribute("NORMAL", np.tile(np.array([0, 0, 1], np.float32), (4, 1)), "VEC3", FLOAT)
    skin: dict = {"joints": [joint]}
    if bind is not None:
        skin["inverseBindMatrices"] = build.chunk.array(bind.T.reshape(1, 16).astype(np.float32), "MAT4", FLOAT)
    build.document |= {"nodes": nodes, "scenes": [{"nodes": roots}], "skins": [skin]}
    return build


def moved(x: float = 0, y: float = 0, z: float = 0, *, scale: float = 1) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


SHOWN = {"mesh": 0, "skin": 0}
SKINS = {
    "own transform": ([{**SHOWN, "translation": [0, 5, 0]}, {}], [0, 1], 1, None, (0, 0, 0), (1, 1, 0)),
    "parent's transform": ([SHOWN, {}, {"children": [0], "scale": [9, 9, 9]}], [2, 1], 1, None, (0, 0, 0), (1, 1, 0)),
    "joint raised": ([SHOWN, {"translation": [0, 1, 0]}], [0, 1], 1, None, (0, 1, 0), (1, 2, 0)),
    "bind pose of a small armature": (
        [SHOWN, {"translation": [0, 100, 0]}, {"scale": [0.01] * 3, "children": [0, 1]}],
        [2],
        1,
        moved(0, -100, 0) @ moved(scale=100),
        (0, 0, 0),
        (1, 1, 0),
    ),
    "z-up armature": (
        [SHOWN, {"translation": [0, 0, 1]}, {"rotation": [-HALF, 0, 0, HALF], "children": [0, 1]}],
        [2],
        1,
        None,
        (0, 1, -1),
        (1, 1, 0),
    ),
    "a joint outside the scene": ([SHOWN, {"translation": [0, 0, 2]}], [0], 1, None, (0, 0, 2), (1, 1, 2)),
}


@pytest.mark.parametrize("case", SKINS)
def test_a_skin_stands_where_its_joints_are(tmp_path: Path, case: str) -> None:
    nodes, roots, joint, bind, low, high = SKINS[case]
    mesh = skinned(nodes, roots, joint=joint, bind=bind).mesh(tmp_path)
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=1e-5)


def test_normals_and_winding_of_skins(tmp_path: Path) -> None:
    turned = skinned([SHOWN, {"rotation": [HALF, 0, 0, HALF]}], [0, 1], joint=1).mesh(tmp_path)
    assert turned.normals is not None
    np.testing.assert_allclose(turned.normals[0], (0, -1, 0), atol=1e-6)
    mirrored = skinned([SHOWN, {"scale": [-1, 1, 1]}], [0, 1], joint=1).mesh(tmp_path)
    a, b, c = mirrored.vertices[mirrored.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0
    assert mirrored.normals is not None
    np.testing.assert_allclose(mirrored.normals[0], (0, 0, 1), atol=1e-6)


def test_a_damaged_skin_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    build = skinned([SHOWN, {}], [0, 1], joint=1)
    build.attribute("JOINTS_0", np.full((4, 4), 7, np.uint8), "VEC4", U8)
    assert len(build.mesh(tmp_path).faces) == 2
    assert "JOINTS_0 goes up to 7" in caplog.text


@pytest.mark.parametrize(
    ("of_mesh", "of_node", "raised"), [([1.0, 0.0], None, 2), (None, [0.5, 0], 1), ([1, 0], [0, 1], 7), (None, None, 0)]
)
def test_morph_targets_have_the_files_weights(
    tmp_path: Path, of_mesh: list[float] | None, of_node: list[float] | None, raised: float
) -> None:
    build = Builder()
    targets = [np.tile(np.array([0, y, 0], np.float32), (4, 1)) for y in (2, 7)]
    build.primitive["targets"] = [{"POSITION": build.chunk.array(t, "VEC3", FLOAT)} for t in targets]
    if of_mesh is not None:
        build.document["meshes"][0]["weights"] = of_mesh
    if of_node is not None:
        build.document["nodes"][0]["weights"] = of_node
    np.testing.assert_allclose(build.mesh(tmp_path).bounds, [(0, raised, 0), (1, raised + 1, 0)], atol=1e-6)


def test_instances_of_a_node(tmp_path: Path) -> None:
    build = Builder()
    attributes = {
        "TRANSLATION": build.chunk.array(np.array([[0, 0, 0], [3, 0, 0]], np.float32), "VEC3", FLOAT),
        "ROTATION": build.chunk.array(np.array([[0, 0, 0, 1], [0, 0, HALF, HALF]], np.float32), "VEC4", FLOAT),
        "SCALE": build.chunk.array(np.array([[1, 1, 1], [1, 2, 1]], np.float32), "VEC3", FLOAT),
    }
    build.document["nodes"][0] |= {
        "translation": [0, 0, 5],
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
    }
    build.document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    mesh = build.mesh(tmp_path)
    assert len(mesh.faces) == 4
    np.testing.assert_allclose(mesh.vertices[4:].min(0), (1, 0, 5), atol=1e-5)
    np.testing.assert_allclose(mesh.vertices[4:].max(0), (3, 1, 5), atol=1e-5)


def seen(mesh: Mesh) -> np.ndarray:
    """Opacity 0..255 at the vertices."""
    if not mesh.textures or mesh.uv is None:
        return np.full(len(mesh.vertices), 255)
    row = mesh.textures[0].pixels[0, :, 3]
    return row[np.minimum((mesh.uv[:, 0] * len(row)).astype(int), len(row) - 1)]


@pytest.mark.parametrize(
    ("material", "opacity"),
    [
        ({"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.7, 1, 0.1]}}, 26),
        ({"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.7, 1, 1]}}, 255),
        ({"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.7, 1, 0]}}, 0),
        ({"alphaMode": "MASK", "alphaCutoff": 0.2, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.3]}}, 255),
        ({"alphaMode": "OPAQUE", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.1]}}, 255),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.1]}}, 255),
    ],
)
def test_colour_alone_makes_glass(tmp_path: Path, material: dict, opacity: int) -> None:
    build = Builder()
    build.document["materials"] = [material]
    build.primitive["material"] = 0
    mesh = build.mesh(tmp_path)
    assert (np.abs(seen(mesh).astype(int) - opacity) <= 1).all()
    renderer = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))]))
    depth = renderer.render(pinhole(8, 8, hfov_deg=20, pose=look_at((0.6, 0.4, 2), (0.6, 0.4, 0))), outputs=("depth",))
    assert bool(np.isfinite(depth["depth"]).all() and depth["depth"].any()) == (opacity == 255)


def test_vertex_colours_make_glass(tmp_path: Path) -> None:
    build = Builder()
    build.document["materials"] = [{"alphaMode": "BLEND"}]
    build.primitive["material"] = 0
    colors = np.full((4, 4), 65535, np.uint16)
    colors[2:, 3] = 0
    build.attribute("COLOR_0", colors, "VEC4", U16, normalized=True)
    assert seen(build.mesh(tmp_path)).tolist() == [255, 255, 0, 0]
