"""Writer of meshes as GLB (glTF 2.0 binary) with colours in materials, which all viewers and habitat-sim show.

Many programs, such as habitat-sim with its PBR shader, ignore vertex colours of meshes that have a material. This
module therefore stores colours of triangles without a texture in a small palette image. Triangles with a texture get
one material per pair of texture and colour. `h3data.scene.save_scene` stores scenes exactly, with vertex colours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skinning import Influences
from h3data.errors import SceneError
from h3data.geometry import IDENTITY_POSE
from h3data.mesh.glb import UINT8, VERTICES, GlbChunk, cutout, gltf_document, matte, pack_glb, placement
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.mesh_operations import face_texture_indices
from h3data.srgb import bytes_to_linear

_PIXELS = {"magFilter": 9728, "minFilter": 9728, "wrapS": 33071, "wrapT": 33071}
"""Texture sampler: nearest, clamped."""
_SMOOTH = {"magFilter": 9729, "minFilter": 9987}
"""Texture sampler: linear with mipmaps, repeated."""
_BLOCK_PX = 4
"""Side of the square of one colour in the palette: viewers that make mipmaps get two levels without bleeding."""

MAX_LOOKS = 32
"""Largest number of pairs of texture and colour of one mesh."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GlbNode:
    """Mesh with its pose in the file."""

    name: str
    mesh: int
    """Index of the mesh in the file."""
    pose: NDArray[np.float64] = field(default_factory=IDENTITY_POSE.copy)
    """Pose (pose7) of the mesh, shape [7]."""
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    extras: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON that other programs preserve or ignore."""


def glb_bytes(meshes: Sequence[Mesh], nodes: Sequence[GlbNode] | None = None) -> bytes:
    """Return a GLB with ``nodes`` (default: one per mesh); the same meshes give the same bytes.

    A mesh with several materials is a node with one child per material.

    Positions, texture coordinates and textures are exact. Colours are exact where a triangle has a single one; a
    triangle whose corners differ gets their mean. If a mesh shows its textures in more than `MAX_LOOKS` colours, such
    as a floor of boards, similar colours are replaced by their mean, because every pair of texture and colour costs a
    draw call.
    """
    if nodes is None:
        nodes = [GlbNode(name=f"part_{k}", mesh=k) for k in range(len(meshes))]
    chunk = GlbChunk()
    lists = mesh_lists(chunk, meshes)
    single, of_mesh = _one_primitive_each(lists["meshes"])
    lists["meshes"] = single
    records: list[dict[str, Any]] = [
        {
            "name": n.name,
            **placement(n.pose, n.scale),
            **({"extras": dict(n.extras)} if n.extras else {}),
        }
        for n in nodes
    ]
    for n, record in zip(nodes, records[: len(nodes)], strict=True):
        parts = of_mesh[n.mesh]
        if len(parts) == 1:
            record["mesh"] = parts[0]
        else:
            # children come after all nodes of the caller, whose numbers are those of the scene
            record["children"] = [len(records) + k for k in range(len(parts))]
            records += [{"name": f"{n.name}.{k}", "mesh": part} for k, part in enumerate(parts)]
    document = gltf_document({"nodes": list(range(len(nodes)))}, nodes=records, **lists, **chunk.lists())
    return pack_glb(document, chunk)


def _one_primitive_each(meshes: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[list[int]]]:
    """Return meshes of one primitive, and which of them each mesh has become.

    habitat-sim culls by the box of a node, which may be that of one primitive only: a rug of six vanished in some pictures.
    """
    single: list[dict[str, Any]] = []
    of_mesh = []
    for mesh in meshes:
        primitives = mesh["primitives"]
        of_mesh.append(list(range(len(single), len(single) + len(primitives))))
        names = [mesh["name"]] if len(primitives) == 1 else [f"{mesh['name']}.{k}" for k in range(len(primitives))]
        single += [{"name": name, "primitives": [p]} for name, p in zip(names, primitives, strict=True)]
    return single, of_mesh


def mesh_lists(
    chunk: GlbChunk, meshes: Sequence[Mesh], influences: Mapping[int, Influences] | None = None
) -> dict[str, Any]:
    """Return the glTF members with meshes and materials, after adding their arrays to ``chunk``.

    Args:
        chunk: binary chunk of the file.
        meshes: meshes to write, at least one.
        influences: joints and weights of the skinned meshes, by index.
    """
    split = [_one_color_per_triangle(mesh) for mesh in meshes]
    plain = [m.colors[m.faces[face_texture_indices(m) < 0].ravel()] for m, _ in split]
    # one palette for all meshes, so that the file has one image and one material for them
    materials = _Materials(chunk, np.unique(np.concatenate(plain), axis=0))
    records = []
    for k, (mesh, source) in enumerate(split):
        moved = (influences or {}).get(k)
        if moved is not None:
            moved = Influences(joints=moved.joints[source], weights=moved.weights[source])
        records.append({"name": f"mesh_{k}", "primitives": _primitives(chunk, mesh, materials, moved)})
    return {
        "meshes": records,
        "materials": materials.materials,
        "textures": materials.textures,
        "samplers": [_PIXELS, _SMOOTH],
        "images": materials.images,
    }


class _Materials:
    """The materials of a file: the palette of colours without a texture, then pairs of texture and colour."""

    def __init__(self, chunk: GlbChunk, palette: NDArray[np.uint8]) -> None:
        self._chunk, self._palette = chunk, palette
        self._side = int(np.ceil(np.sqrt(len(palette))))
        self._images: dict[int, int] = {}
        self._pairs: dict[tuple[int, int], int] = {}
        self.materials: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []
        if len(palette):
            texels = np.full((self._side**2, 4), (0, 0, 0, 255), np.uint8)
            texels[: len(palette), :3] = palette
            pixels = texels.reshape(self._side, self._side, 4).repeat(_BLOCK_PX, 0).repeat(_BLOCK_PX, 1)
            image = self._image("palette", pixels, sampler=0)
            self.materials.append({"name": "palette", "pbrMetallicRoughness": matte(image)})

    def palette_uv(self, colors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the texture coordinates [V, 2] of colours in the palette, which is material 0."""
        index = np.searchsorted(_codes(self._palette), _codes(colors))  # np.unique sorts rows as the codes do
        return (np.stack([index % self._side + 0.5, index // self._side + 0.5], -1) / self._side).astype(np.float32)

    def pair(self, texture: Texture, color: NDArray[np.uint8]) -> int:
        """Return the index of the material that shows a texture in an sRGB colour [3]."""
        # by identity: meshes of a home share their textures, and comparing pixels is slow
        key = (id(texture), int(_codes(color)))
        if key not in self._pairs:
            if id(texture) not in self._images:
                self._images[id(texture)] = self._image(texture.name, texture.pixels, sampler=1)
            # glTF has factors in linear light, textures in sRGB
            factor = [*bytes_to_linear(color).tolist(), 1.0]
            look = matte(self._images[id(texture)], baseColorFactor=factor)
            name = f"{texture.name or 'texture'} #{bytes(color.tolist()).hex()}"
            self._pairs[key] = len(self.materials)
            self.materials.append({"name": name, "pbrMetallicRoughness": look, **cutout(texture.pixels)})
        return self._pairs[key]

    def _image(self, name: str, pixels: NDArray[np.uint8], *, sampler: int) -> int:
        self.images.append(self._chunk.image(pixels, name, gray=False))
        self.textures.append({"sampler": sampler, "source": len(self.images) - 1})
        return len(self.textures) - 1


def _primitives(
    chunk: GlbChunk, mesh: Mesh, materials: _Materials, influences: Influences | None
) -> list[dict[str, Any]]:
    """Return one primitive for the triangles without a texture, one for each pair of texture and colour."""
    primitives = []
    for kind, color, faces in _looks(mesh):
        used, corners = np.unique(faces, return_inverse=True)
        if kind < 0:
            material, uv = 0, materials.palette_uv(mesh.colors[used])
        else:
            assert mesh.uv is not None
            material, uv = materials.pair(mesh.textures[kind], color), mesh.uv[used]
        attributes = {"POSITION": chunk.vectors(mesh.vertices[used], limits=True)}
        if mesh.normals is not None:
            attributes["NORMAL"] = chunk.vectors(mesh.normals[used])
        attributes["TEXCOORD_0"] = chunk.vectors(uv)
        triangles = chunk.triangles(corners)
        if influences is not None:
            # glTF's validator warns of a joint that has no weight unless it is 0
            joints = np.where(influences.weights[used] > 0, influences.joints[used], 0).astype(np.uint8)
            attributes["JOINTS_0"] = chunk.array(joints, "VEC4", UINT8, VERTICES)
            attributes["WEIGHTS_0"] = chunk.vectors(influences.weights[used])
        primitives.append({"attributes": attributes, "indices": triangles, "material": material, "mode": 4})
    return primitives


def _looks(mesh: Mesh) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.int32]]]:
    """Yield texture (-1: none), sRGB colour and triangles of each look of a mesh; `MAX_LOOKS` limits the textures."""
    kinds = face_texture_indices(mesh).astype(np.int64)
    colors = np.where(kinds[:, None] < 0, 0, mesh.colors[mesh.faces[:, 0]])
    # colours are made coarser by powers of two until there are few enough
    step = 1
    while True:
        keys, look = np.unique(np.column_stack([kinds, colors // step]), axis=0, return_inverse=True)
        if np.count_nonzero(keys[:, 0] >= 0) <= max(MAX_LOOKS, len(mesh.textures)) or step == 256:
            break
        step *= 2
    # stable, so that equal meshes give equal bytes
    order, counts = np.argsort(look.ravel(), kind="stable"), np.bincount(look.ravel())
    ends = np.cumsum(counts)[:-1]
    for key, faces, members in zip(keys, np.split(mesh.faces[order], ends), np.split(colors[order], ends), strict=True):
        yield int(key[0]), np.rint(members.mean(0)).astype(np.uint8), faces


def _codes(colors: NDArray[np.uint8]) -> NDArray[np.int64]:
    return colors.astype(np.int64) @ np.array([65536, 256, 1])


def _one_color_per_triangle(mesh: Mesh) -> tuple[Mesh, NDArray[np.integer]]:
    """Return the mesh with a single colour, the mean, for each triangle whose corners differ, and the source of each vertex.

    Such triangles get corners of their own; the second value is the index into the vertices of ``mesh``.

    Raises:
        SceneError: the mesh has no triangles, or numbers that are not finite.
    """
    faults = [
        what
        for what, values in (("vertices", mesh.vertices), ("normals", mesh.normals), ("uv", mesh.uv))
        if values is not None and not np.isfinite(values).all()
    ]
    if faults or not len(mesh.faces):
        what = f"{' and '.join(faults)} that are not finite" if faults else "no triangles"
        raise SceneError(f"A mesh with {what} cannot be written as GLB.", code="H3-MESH-008")
    # a palette has no gradients, so a triangle can have one colour only
    corners = mesh.colors[mesh.faces]
    mixed = (corners != corners[:, :1]).any((1, 2))
    source = np.arange(len(mesh.vertices))
    if not mixed.any():
        return mesh, source
    old = mesh.faces[mixed]
    mean = np.rint(corners[mixed].mean(1)).astype(np.uint8)
    faces = mesh.faces.copy()
    faces[mixed] = len(mesh.vertices) + np.arange(old.size, dtype=np.int32).reshape(-1, 3)
    source = np.concatenate([source, old.ravel()])
    split = replace(
        mesh,
        vertices=mesh.vertices[source],
        faces=faces,
        colors=np.concatenate([mesh.colors, np.repeat(mean, 3, axis=0)]),
        normals=None if mesh.normals is None else mesh.normals[source],
        uv=None if mesh.uv is None else mesh.uv[source],
    )
    return split, source
