"""Scene to render: meshes divided into clusters, and their instances, built once for any number of renderers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.mesh_operations import face_texture_indices
from h3data.render.raster.clusters import (
    Clusters,
    build_clusters,
    cluster_vertices,
    enclosing_box,
    normal_groups,
)
from h3data.render.raster.raster import Geometry
from h3data.render.shade.cutouts import cut_out_faces, pack_cutouts
from h3data.render.shade.patches import smooth_patches
from h3data.render.shade.shading_simd import MIRROR_SIDES
from h3data.render.shade.surface import Surface
from h3data.render.shade.textures import pack_textures


@dataclass(frozen=True, eq=False)
class RenderInstance:
    """Instance of a mesh with its pose in the world."""

    mesh: int
    """Index into the scene's meshes."""
    matrix: NDArray[np.float64]
    """Matrix from mesh to world, 4x4, with any scale; NaN if it is absent."""
    semantic_id: int = 0
    layer: str = ""
    """Layer, which cameras can hide (`Camera.hidden_layers`)."""
    name: str = ""
    id: int = -1
    """Id in instance images; -1 = its index in the scene."""


class RenderScene:
    """Meshes and instances in a form for rendering.

    The scene is immutable; a `Renderer` holds all states that change over time.

    A texture shared by several meshes (the same object) is packed once. Where a texture is less than half opaque, the
    surface has a hole (`cutouts`).
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        instances: Sequence[RenderInstance],
        *,
        deformable: Sequence[int] = (),
        mirrors: Mapping[int, NDArray[np.float32]] | None = None,
    ) -> None:
        """Cut the meshes into clusters.

        Args:
            meshes: the meshes.
            instances: their instances.
            deformable: meshes whose vertices will be replaced, such as skinned bodies.
            mirrors: glossy meshes, and the light that their vertices mirror from -x, +x, +y, -z and +z, each [V, 5]
                (`h3data_light.bake.LitScene.mirrors`).
        """
        self.meshes = tuple(meshes)
        self.instances = tuple(instances)
        self.deformable = tuple(sorted({int(m) for m in deformable}))
        self.mirrors = dict(mirrors or {})
        _check(self.meshes, self.instances, self.deformable, self.mirrors)
        count = len(self.instances)
        self.instance_mesh = np.array([i.mesh for i in self.instances], np.int32).reshape(count)
        self.instance_matrix = np.zeros((count, 3, 4))
        for k, instance in enumerate(self.instances):
            self.instance_matrix[k] = np.asarray(instance.matrix, np.float64)[:3]
        self.ids = np.array([k if i.id < 0 else i.id for k, i in enumerate(self.instances)], np.int32).reshape(count)
        self.semantic_ids = np.array([i.semantic_id for i in self.instances], np.int32).reshape(count)
        self.layers = np.array([i.layer for i in self.instances], dtype=np.str_).reshape(count)

        cut_out = [_cut_out(mesh) for mesh in self.meshes]
        self.cut_out_faces = np.concatenate([np.zeros(0, np.bool_), *cut_out])
        """True for each triangle that may have holes (`cutouts`), for all meshes in sequence, shape [F]."""
        parts = [build_clusters(mesh.vertices, mesh.faces, cut) for mesh, cut in zip(self.meshes, cut_out, strict=True)]
        self.geometry, self.packet_triangles = _join(parts, self.deformable)
        mesh_first = self.geometry.mesh_first
        # every cluster of every instance has a draw of its own, also while it is out of view
        self.draw_limit = int(np.sum(np.diff(mesh_first)[self.instance_mesh])) if count else 0
        self.first_vertex = _starts(len(mesh.vertices) for mesh in self.meshes)
        self.first_face = _starts(len(mesh.faces) for mesh in self.meshes)
        textures = list(dict.fromkeys(texture for mesh in self.meshes for texture in mesh.textures))
        self.surface = self._build_surface(textures)
        self.cutouts = pack_cutouts(self.cut_out_faces, self.surface, self.geometry.cluster_packets, textures)
        self.parts = {m: parts[m] for m in self.deformable}
        self.members = {m: cluster_vertices(parts[m]) for m in self.deformable}
        """Vertices of each cluster of deformable meshes."""
        self.groups = {
            m: normal_groups(mesh.vertices, mesh.normals)
            for m, mesh in enumerate(self.meshes)
            if m in self.deformable and mesh.normals is not None
        }

    def _build_surface(self, textures: list[Texture]) -> Surface:
        vertices, faces = int(self.first_vertex[-1]), int(self.first_face[-1])
        number = {texture: k for k, texture in enumerate(textures)}
        surface = Surface(
            faces=np.zeros((faces, 3), np.int32),
            colors=np.zeros((vertices, 3), np.uint8),
            normals=np.zeros((vertices, 3), np.float32),
            packet_faces=self.packet_triangles.copy(),
            uv=np.zeros((vertices if textures else 0, 2), np.float32),
            face_textures=np.full(faces, -1, np.int32),
            mirrors=np.zeros((vertices if self.mirrors else 0, MIRROR_SIDES), np.float32),
            textures=pack_textures(textures),
        )
        geometry = self.geometry
        for m, mesh in enumerate(self.meshes):
            v, f = int(self.first_vertex[m]), int(self.first_face[m])
            surface.faces[f : f + len(mesh.faces)] = mesh.faces + v
            surface.colors[v : v + len(mesh.vertices)] = mesh.colors
            if m in self.mirrors:
                surface.mirrors[v : v + len(mesh.vertices)] = self.mirrors[m]
            if mesh.normals is not None:
                surface.normals[v : v + len(mesh.vertices)] = mesh.normals
            if mesh.textures and mesh.uv is not None:
                # one vertex without coordinates would make NaN of each pixel of its triangles
                surface.uv[v : v + len(mesh.vertices)] = np.nan_to_num(mesh.uv)
                numbers = np.array([*(number[texture] for texture in mesh.textures), -1], np.int32)  # -1 picks the last
                surface.face_textures[f : f + len(mesh.faces)] = numbers[face_texture_indices(mesh)]
        # a packet numbers the triangles of its mesh, the surface those of all meshes
        for m in range(len(self.meshes)):
            packets = surface.packet_faces[_packet_range(geometry, m)]
            packets[packets >= 0] += int(self.first_face[m])
        return surface

    def own_packet_range(self, mesh: int) -> slice:
        """Return the range of a deformable mesh's packets within the packets of which every renderer has a copy."""
        packets = _packet_range(self.geometry, mesh)
        # own packets are numbered after all shared ones (`_join`)
        shared = len(self.geometry.shared_packets)
        return slice(packets.start - shared, packets.stop - shared)

    def cluster_range(self, mesh: int) -> slice:
        """Return the range of a mesh's clusters."""
        return slice(int(self.geometry.mesh_first[mesh]), int(self.geometry.mesh_first[mesh + 1]))

    @cached_property
    def patches(self) -> NDArray[np.int32]:
        """Index of each triangle's smooth patch (`smooth_patches`), for all meshes in sequence, shape [F]."""
        return smooth_patches(self.surface, [mesh.vertices for mesh in self.meshes], self.first_face)

    @property
    def triangle_count(self) -> int:
        """Number of triangles of all instances together."""
        return int(np.diff(self.first_face)[self.instance_mesh].sum()) if len(self.instances) else 0

    def __repr__(self) -> str:
        return (
            f"RenderScene({len(self.meshes)} meshes, {len(self.instances)} instances, {self.triangle_count} triangles, "
            f"{len(self.deformable)} deformable)"
        )


def _cut_out(mesh: Mesh) -> NDArray[np.bool_]:
    """Return whether each triangle may have holes, shape [F]."""
    out = np.zeros(len(mesh.faces), np.bool_)
    if mesh.uv is not None:
        numbers = face_texture_indices(mesh)
        for number, texture in enumerate(mesh.textures):
            chosen = np.flatnonzero(numbers == number)
            out[chosen] = cut_out_faces(np.nan_to_num(mesh.uv)[mesh.faces[chosen]], texture.pixels)
    return out


def _starts(lengths: Iterable[int]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(list(lengths), dtype=np.int64)]).astype(np.int64)


def _packet_range(geometry: Geometry, mesh: int) -> slice:
    """Return the range of a mesh's packets, counted through shared and own packets."""
    clusters = geometry.cluster_packets[geometry.mesh_first[mesh] : geometry.mesh_first[mesh + 1]]
    return slice(int(clusters[0, 0]), int(clusters[-1, 1])) if len(clusters) else slice(0, 0)


def _join(parts: list[Clusters], deformable: tuple[int, ...]) -> tuple[Geometry, NDArray[np.int32]]:
    """Return one `Geometry` of all meshes, and the mesh triangle in every lane [P, 8].

    Clusters are numbered mesh by mesh; the packets of deformable meshes come after all others.
    """
    # the packets that change come last, in an array that each world copies; the others are one array for all worlds
    storage = [m for m in range(len(parts)) if m not in deformable] + list(deformable)
    start = dict(zip(storage, _starts(len(parts[m].packets) for m in storage), strict=False))
    ranges = [np.stack([p.first[:-1], p.first[1:]], axis=1) + start[m] for m, p in enumerate(parts)]
    boxes = np.array([enclosing_box(p.center, p.half) for p in parts]).reshape(len(parts), 2, 3)
    no_packets = np.zeros((0, 9, 8), np.float32)
    shared = [parts[m].packets for m in storage if m not in deformable]
    geometry = Geometry(
        shared_packets=np.concatenate([no_packets, *shared]),
        own_packets=np.concatenate([no_packets, *(parts[m].packets for m in deformable)]),
        cluster_packets=np.concatenate([np.zeros((0, 2)), *ranges]).astype(np.int32),
        center=np.concatenate([np.zeros((0, 3)), *(p.center for p in parts)]),
        half=np.concatenate([np.zeros((0, 3)), *(p.half for p in parts)]),
        mesh_first=_starts(len(p.center) for p in parts).astype(np.int32),
        mesh_center=boxes[:, 0].copy(),  # contiguous: kernels are compiled anew for every layout of their arguments
        mesh_half=boxes[:, 1].copy(),
    )
    lanes = [parts[m].triangles for m in storage]
    return geometry, np.concatenate([np.zeros((0, 8), np.int32), *lanes])


def _check(
    meshes: tuple[Mesh, ...],
    instances: tuple[RenderInstance, ...],
    deformable: tuple[int, ...],
    mirrors: Mapping[int, NDArray[np.float32]],
) -> None:
    # kernels check no bounds, so whatever they use as an index or a shape is checked before
    faults = []
    for m, mirrored in mirrors.items():
        expected = (len(meshes[m].vertices), MIRROR_SIDES) if 0 <= m < len(meshes) else None
        if np.shape(mirrored) != expected or not np.isfinite(mirrored).all():
            faults.append(f"mirrors of mesh {m} must be finite {list(expected or ())}, got {list(np.shape(mirrored))}")
    for m, mesh in enumerate(meshes):
        if not np.isfinite(mesh.vertices).all():
            faults.append(f"mesh {m} has vertices that are not finite")
    for k, instance in enumerate(instances):
        label = f"instance {k}" + (f" ({instance.name})" if instance.name else "")
        if not 0 <= instance.mesh < len(meshes):
            faults.append(f"{label} refers to mesh {instance.mesh}, but there are {len(meshes)}")
        if np.shape(instance.matrix) not in ((4, 4), (3, 4)):
            faults.append(f"{label} needs a 4x4 matrix, got shape {list(np.shape(instance.matrix))}")
    faults += [
        f"deformable lists mesh {m}, but there are {len(meshes)}" for m in deformable if not 0 <= m < len(meshes)
    ]
    if faults:
        more = f" and {len(faults) - 5} more faults" if len(faults) > 5 else ""
        raise InputError("The scene cannot be rendered: " + "; ".join(faults[:5]) + more + ".", code="H3-RENDER-067")
