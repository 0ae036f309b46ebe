"""Clusters of many meshes one after another, as the CUDA code reads them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.render.gpu.layout import BOX
from h3data.render.gpu.meshlets import Meshlets
from h3data.render.scene import RenderScene

_BOX_MARGIN_M = 1e-6
_CUT_OUT = np.int32(-(2**31))
"""Bit of a cluster's counts."""


class Pool:
    """Clusters of many meshes one after another."""

    def __init__(self) -> None:
        self.vertex_count = self.cluster_count = 0
        self.parts: dict[str, list[NDArray[Any]]] = {}

    def keep(self, **arrays: NDArray[Any]) -> None:
        for name, array in arrays.items():
            self.parts.setdefault(name, []).append(array)

    def joined(self, name: str, empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        return np.concatenate([np.zeros(empty, dtype), *self.parts.get(name, [])])

    def add(
        self, cut: Meshlets, vertices: NDArray, normals: NDArray, colors: NDArray, uv: NDArray, face_ids: NDArray,
        face_textures: NDArray, face_instances: NDArray,
    ) -> NDArray[Any]:  # fmt: skip
        """Append the clusters of a mesh and return its groups as boxes [G]; ``face_...`` per triangle of what was cut."""
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
            padded = np.append(values, -1).astype(np.int32)  # face -1 picks the last
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
        self.vertex_count += len(cut.vertices)
        self.cluster_count += count
        return groups


def boxes(low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[Any]:
    """Boxes [N] of two corners [N, 3], a hair larger."""
    out = np.zeros(len(low), BOX)
    center = (low.astype(np.float64) + high) / 2
    half = (high.astype(np.float64) - low) / 2
    out["center"] = center
    out["half"] = half * (1 + 1e-5) + _BOX_MARGIN_M + 1e-7 * np.abs(center)
    return out


def mesh_arrays(scene: RenderScene, mesh: int, first_texture: int, *, instance: int = -1) -> dict[str, NDArray[Any]]:
    """A mesh as `Pool.add` takes it, with its faces and which of them are cut out."""
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
        "face_ids": np.arange(count, dtype=np.int32),
        "face_textures": np.where(textures >= 0, textures + first_texture, -1).astype(np.int32),
        "face_instances": np.full(count, instance, np.int32),
    }
