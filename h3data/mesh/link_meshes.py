"""Meshes for links: simple shapes made here, our own plain GLB files read here, anything else through trimesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import FormatError, SceneError
from h3data.geometry import Array, normalized
from h3data.mesh.accessors import GltfArrays
from h3data.mesh.glb import FLOAT32, INDICES, UINT16, VERTICES, GlbChunk, pack_glb, unpack_glb
from h3data.mesh.meshes import joined, painted
from h3data.mesh.records import Mesh, Texture
from h3data.srgb import bytes_to_linear, linear_to_bytes

DEFAULT_COLOR = (176, 178, 182)
"""sRGB of things whose file gives no colour: light grey."""
MAX_SIDE_PX = 2048
"""Larger textures are reduced to this."""


def load_mesh(path: Path, *, color: tuple[int, int, int] | None = None) -> Mesh:
    """The triangles of a mesh file in its own frame, with its colours and textures; ``color`` (sRGB) replaces both.

    Raises:
        SceneError: the file cannot be read, or holds no triangles.
    """
    mesh = read_plain_glb(path) if path.suffix.lower() == ".glb" else None
    if mesh is None:
        mesh = _load_with_trimesh(path)
    return mesh if color is None else painted(mesh, color)


def _load_with_trimesh(path: Path) -> Mesh:
    import trimesh

    linear = path.suffix.lower() in (".glb", ".gltf")
    try:
        scene = trimesh.load_scene(path, process=False)
        order = {name: k for k, name in enumerate(scene.geometry)}
        nodes = [(order[scene.graph[node][1]], str(node), *scene.graph[node]) for node in scene.graph.nodes_geometry]
        parts = [(matrix, scene.geometry[name]) for _, _, matrix, name in sorted(nodes, key=lambda node: node[:2])]
        meshes = [_mesh_of(p, matrix, linear) for matrix, p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces)]
    except Exception as error:  # trimesh raises whatever its many parsers raise
        raise SceneError(f"Expected a mesh file, could not read this one ({error}): {path}") from error
    if not meshes:
        raise SceneError(f"Expected a mesh file, this one has no triangles: {path}")
    return joined(meshes)


def _mesh_of(geometry: Any, matrix: Array, linear: bool) -> Mesh:
    """One geometry of trimesh's, moved by its node's matrix [4, 4]; ``linear`` says that its colours are not sRGB."""
    visual: Any = geometry.visual
    part = geometry.copy()
    part.apply_transform(matrix)
    colors = np.tile(np.array(DEFAULT_COLOR, np.uint8), (len(part.vertices), 1))
    uv, textures = None, ()
    image = _image_of(visual)
    if image is not None:
        factor = getattr(visual.material, "baseColorFactor", None)
        colors[:] = 255 if factor is None else linear_to_bytes(np.asarray(factor)[:3] / 255)
        uv = np.nan_to_num(np.asarray(visual.uv, np.float64)[:, :2] * [1, -1] + [0, 1]).astype(np.float32)
        textures = (_texture(image),)
    elif visual is not None and visual.defined:
        shown = visual if visual.kind == "vertex" else visual.to_color()
        given = np.atleast_2d(np.asarray(shown.vertex_colors))[:, :3].astype(np.uint8)
        colors[:] = linear_to_bytes(given / 255) if linear else given  # a material gives one colour for all
    return Mesh(
        vertices=np.ascontiguousarray(part.vertices, np.float32),
        faces=np.ascontiguousarray(part.faces, np.int32),
        colors=np.ascontiguousarray(colors),
        normals=np.ascontiguousarray(part.vertex_normals, np.float32),
        uv=uv,
        textures=textures,
    )


def _image_of(visual: Any) -> Any:
    """The Pillow image on a textured visual, or None."""
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    images = (getattr(material, name, None) for name in ("baseColorTexture", "image"))
    image = next((i for i in images if i is not None), None)
    stand_in = getattr(image, "format", None) is None  # what trimesh makes up for a material that is not there
    return None if stand_in or uv is None or not len(uv) else image


def _texture(image: Any) -> Texture:
    small = image.convert("RGB")
    small.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX))
    rgb = np.asarray(small, np.uint8)
    return Texture(pixels=np.concatenate([rgb, np.full((*rgb.shape[:2], 1), 255, np.uint8)], 2))


# --- plain GLB --------------------------------------------------------------------------------------------------------
def read_plain_glb(path: Path) -> Mesh | None:
    """The mesh of a GLB that holds only triangles with normals and untextured materials in one unmoved node, as
    `write_plain_glb` makes it; None if there is anything more in it (then trimesh reads it)."""
    tree, binary = unpack_glb(path.read_bytes(), str(path), what="a mesh as GLB")
    try:
        return _plain_mesh(tree, binary)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise FormatError(f"Expected a GLB file, could not read this one ({error}): {path}") from error


def _plain_mesh(tree: dict, binary: memoryview) -> Mesh | None:
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    moved = any(key in node for node in nodes for key in ("matrix", "translation", "rotation", "scale", "children"))
    if len(nodes) != 1 or len(meshes) != 1 or moved or tree.get("textures") or tree.get("extensionsUsed"):
        return None
    parts, arrays = [], GltfArrays(tree, lambda index: binary)
    for primitive in meshes[0]["primitives"]:
        if set(primitive["attributes"]) != {"POSITION", "NORMAL"} or primitive.get("mode", 4) != 4:
            return None
        position, normal = (arrays.floats(primitive["attributes"][key]) for key in ("POSITION", "NORMAL"))
        faces = arrays.accessor(primitive["indices"]).reshape(-1, 3)
        linear = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorFactor"][:3]
        parts.append(_mesh(position, faces, normal, linear_to_bytes(linear)))
    return joined(parts)


def write_plain_glb(path: Path, mesh: Mesh) -> None:
    """Write a mesh as GLB, one primitive per colour; the same mesh gives the same bytes."""
    assert mesh.normals is not None
    palette, index = np.unique(mesh.colors, axis=0, return_inverse=True)
    face_color = index.ravel()[mesh.faces[:, 0]]
    chunk = GlbChunk()
    tree: dict = {
        "asset": {"version": "2.0", "generator": "h3data"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": []}],
        "materials": [],
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
    }

    def vectors(values: NDArray) -> int:
        low, high = values.min(0).tolist(), values.max(0).tolist()
        return chunk.array(values, "VEC3", FLOAT32, VERTICES, min=low, max=high)

    for k, color in enumerate(palette):
        used, faces = np.unique(mesh.faces[face_color == k], return_inverse=True)
        if not len(used):
            continue
        linear = [round(float(v), 6) for v in bytes_to_linear(color)]
        tree["materials"].append(
            {"pbrMetallicRoughness": {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.6}}
        )
        tree["meshes"][0]["primitives"].append(
            {
                "attributes": {
                    "POSITION": vectors(mesh.vertices[used]),
                    "NORMAL": vectors(mesh.normals[used]),
                },
                "indices": chunk.array(faces.ravel().astype(np.uint16), "SCALAR", UINT16, INDICES),
                "material": len(tree["materials"]) - 1,
            }
        )
    tree["buffers"] = [{"byteLength": chunk.size}]
    path.write_bytes(pack_glb(tree, chunk))


# --- simple shapes, flat-shaded where they have edges ------------------------------------------------------------------
def box_mesh(size: Sequence[float], color: tuple[int, int, int]) -> Mesh:
    """A box centred at the origin, four vertices per face."""
    corners, faces, normals = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            side = np.roll(np.eye(3)[axis], 1)
            other = np.cross(normal, side)
            square = [normal + a * side + b * other for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            first = len(corners)
            corners += square
            normals += [normal] * 4
            faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return _mesh(np.array(corners) * np.asarray(size) / 2, np.array(faces), np.array(normals), color)


def round_mesh(
    radius: float, length: float, color: tuple[int, int, int], *, caps: bool, segments: int = 20, rings: int = 6
) -> Mesh:
    """A capsule (``caps``) or a cylinder along z, centred at the origin; a capsule of length 0 is a sphere."""
    half = length / 2
    if caps:
        angle = np.linspace(-np.pi / 2, np.pi / 2, 2 * rings)
        profile = np.stack([radius * np.cos(angle), radius * np.sin(angle) + np.where(angle > 0, half, -half)], axis=1)
        slope = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:  # rim vertices twice: once for the flat end, once for the side
        profile = np.array([[0, -half], [radius, -half], [radius, -half], [radius, half], [radius, half], [0, half]])
        slope = np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1.0]])
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)

    def swept(rows: Array) -> Array:
        flat = rows[:, None, :1] * ring
        return np.concatenate([flat, np.broadcast_to(rows[:, None, 1:], (*flat.shape[:2], 1))], axis=2).reshape(-1, 3)

    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    quads = np.stack([np.stack([a, b, b + segments], -1), np.stack([a, b + segments, a + segments], -1)])
    return _mesh(swept(profile), quads.reshape(-1, 3), normalized(swept(slope)), color)


def _mesh(vertices: Array, faces: NDArray, normals: Array, color: ArrayLike) -> Mesh:
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        colors=np.tile(np.array(color, np.uint8), (len(vertices), 1)),
        normals=normals.astype(np.float32),
    )


def moved(mesh: Mesh, matrix: Array, scale: Sequence[float] = (1.0, 1.0, 1.0)) -> Mesh:
    """The mesh scaled along its own axes and then moved by a rigid matrix [4, 4]."""
    stretch = np.asarray(scale, np.float64)
    rotation = matrix[:3, :3]
    normals = mesh.normals
    if normals is not None:
        normals = normalized((normals / stretch) @ rotation.T).astype(np.float32)
    faces = mesh.faces if np.prod(stretch) > 0 else mesh.faces[:, ::-1]
    vertices = (mesh.vertices * stretch) @ rotation.T + matrix[:3, 3]
    return replace(mesh, vertices=vertices.astype(np.float32), faces=np.ascontiguousarray(faces), normals=normals)
