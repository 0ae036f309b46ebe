"""Concatenation of the clusters of many meshes into the arrays that the CUDA code reads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.render.scene import RenderScene
from h3data.render.shade.shading_simd import MIRROR_SIDES
from h3data_gpu.layout import BOX
from h3data_gpu.meshlets import Meshlets

_BOX_MARGIN_M = 1e-6
_CUT_OUT = np.int32(-(2**31))
"""Bit in a cluster's counts that marks triangles with holes."""


class Pool:
    """Clusters of many meshes, concatenated."""

    def __init__(self, *, glossy: bool = False) -> None:
        """Create an empty pool; with ``glossy``, it also stores the reflections of vertices."""
        self.glossy = glossy
        self.vertex_count = self.cluster_count = 0
        self.parts: dict[str, list[NDArray[Any]]] = {}

    def keep(self, **arrays: NDArray[Any]) -> None:
        """Append arrays to the stored parts of the same names."""
        for name, array in arrays.items():
            self.parts.setdefault(name, []).append(array)

    def joined(self, name: str, empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Return all parts of one name, concatenated, or zeros of shape ``empty`` if there are none."""
        return np.concatenate([np.zeros(empty, dtype), *self.parts.get(name, [])])

    def add(
        self,
        cut: Meshlets,
        vertices: NDArray,
        normals: NDArray,
        colors: NDArray,
        uv: NDArray,
        mirrors: NDArray,
        face_ids: NDArray,
        face_textures: NDArray,
        face_instances: NDArray,
    ) -> NDArray[Any]:
        """Append the clusters of a mesh and return its groups as boxes [G]; ``face_...`` have a row per triangle."""
        clusters = boxes(cut.low, cut.high)
        counts = np.diff(cut.first_vertex)
        clusters["first"] = counts | cut.triangle_count << 16 | np.where(cut.cut_out, _CUT_OUT, np.int32(0))
        clusters["second"] = cut.first_vertex[:-1] + self.vertex_count
        starts, count = cut.group_first[:-1], len(cut.low)
        low = np.minimum.reduceat(cut.low, starts) if count else cut.low
        high = np.maximum.reduceat(cut.high, starts) if count else cut.high
        groups = boxes(low, high)
        groups["first"], groups["second"] = starts[: len(groups)] + self.cluster_count, np.diff(cut.group_first)
        flat = uv[cut.vertices] if len(uv) else np.zeros((len(cut.vertices), 2), np.float32)

        def per_triangle(values: NDArray) -> NDArray[np.int32]:
            padded = np.append(values, -1).astype(np.int32)  # face -1 selects the last entry
            return padded[cut.faces].reshape(-1)

        self.keep(
            vertices=vertices[cut.vertices],
            normals=normals[cut.vertices],
            colors=colors[cut.vertices],
            uv=flat,
            triangles=cut.triangles.reshape(-1),
            clusters=clusters,
            triangle_faces=per_triangle(face_ids),
            triangle_textures=per_triangle(face_textures),
            triangle_instances=per_triangle(face_instances),
        )
        if self.glossy:
            self.keep(mirrors=mirrors[cut.vertices])
        self.vertex_count += len(cut.vertices)
        self.cluster_count += count
        return groups


def boxes(low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[Any]:
    """Return boxes [N] between opposite corners [N, 3] [m], slightly enlarged as a margin for rounding."""
    out = np.zeros(len(low), BOX)
    center = (low.astype(np.float64) + high) / 2
    half = (high.astype(np.float64) - low) / 2
    out["center"] = center
    out["half"] = half * (1 + 1e-5) + _BOX_MARGIN_M + 1e-7 * np.abs(center)
    return out


def mesh_arrays(scene: RenderScene, mesh: int, first_texture: int, *, instance: int = -1) -> dict[str, NDArray[Any]]:
    """Return the arguments of `Pool.add` for a mesh, and its ``faces`` and ``cut_out``."""
    surface = scene.surface
    v, f = slice(*scene.first_vertex[mesh : mesh + 2]), slice(*scene.first_face[mesh : mesh + 2])
    textures = surface.face_textures[f]
    colors = np.zeros((v.stop - v.start, 4), np.uint8)
    colors[:, :3] = surface.colors[v]
    count = f.stop - f.start
    return {
        "vertices": scene.meshes[mesh].vertices,
        "faces": scene.meshes[mesh].faces,
        "cut_out": scene.cut_out_faces[f],
        "normals": surface.normals[v],
        "colors": colors,
        "uv": surface.uv[v] if len(surface.uv) else np.zeros((len(colors), 2), np.float32),
        "mirrors": surface.mirrors[v] if len(surface.mirrors) else np.zeros((len(colors), MIRROR_SIDES), np.float32),
        "face_ids": np.arange(count, dtype=np.int32),
        "face_textures": np.where(textures >= 0, textures + first_texture, -1).astype(np.int32),
        "face_instances": np.full(count, instance, np.int32),
    }
