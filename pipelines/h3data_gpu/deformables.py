"""Deformable meshes of scenes, with their clusters, skins, and the faces around each vertex for normals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.render.scene import RenderScene
from h3data_gpu.gpu_scene import GpuScene
from h3data_gpu.layout import GROUP
from h3data_gpu.meshlets import Meshlets, build_meshlets
from h3data_gpu.pool import Pool, mesh_arrays


class Deformables:
    """Deformable meshes of all scenes, which precede other meshes in the pool to keep per-vertex tables short."""

    def __init__(self, scenes: Sequence[GpuScene]) -> None:
        self.scenes = scenes
        self.rows: list[dict[str, int]] = []
        self.boxes: list[dict[int, tuple[NDArray[Any], int]]] = []
        """For each scene, by mesh: its groups, and the index of the first one within the scene."""
        self.sources: list[NDArray[np.float32]] = []
        self.source_first: list[dict[int, int]] = []
        self.counts = np.zeros(3, np.int64)
        """Largest number of vertices, clusters and groups of any scene."""
        self.group_count = self.normal_group_count = 0
        self.joint_count = max((len(bind) for s in scenes for _, bind in s.skins.values()), default=1)
        self.bodies = max((len(s.scene.deformable) for s in scenes), default=0)
        self.inverse_bind = np.tile(
            np.eye(4, dtype=np.float32), (len(scenes), max(self.bodies, 1), self.joint_count, 1, 1)
        )

    def pack(self, pool: Pool, number: int) -> None:
        """Append the deformable meshes of one scene."""
        stage = self.scenes[number]
        scene, before = stage.scene, (pool.vertex_count, pool.cluster_count, self.group_count)
        self.rows.append({"first_group": before[2], "first_vertex": before[0], "first_cluster": before[1]})
        self.boxes.append({})
        self.source_first.append({})
        sources = [np.zeros((0, 3), np.float32)]
        first_texture = sum(len(s.scene.surface.textures.first_level) for s in self.scenes[:number])
        for body, mesh in enumerate(scene.deformable):
            arrays = mesh_arrays(scene, mesh, first_texture)
            arrays["colors"][:, 3] = mesh in scene.groups
            faces = arrays.pop("faces")
            meshlets = build_meshlets(arrays["vertices"], faces, arrays.pop("cut_out"))
            first_vertex = pool.vertex_count
            groups = pool.add(meshlets, **arrays)
            first_source = -1
            if mesh in stage.skins:
                skin, bind = stage.skins[mesh]
                joints, weights = skin.joints.astype(np.uint8), skin.weights.astype(np.float32)
                self.inverse_bind[number, body, : len(bind)] = bind
            else:
                count = len(arrays["vertices"])
                joints, weights = np.zeros((count, 4), np.uint8), np.zeros((count, 4))
                first_source = sum(map(len, sources))
                self.source_first[number][mesh] = first_source
                sources.append(arrays["vertices"])
            rows = np.zeros(len(groups), GROUP)
            rows["first_cluster"], rows["clusters"] = groups["first"], groups["second"]
            rows["body"], rows["first_source"] = body, first_source
            self.boxes[number][mesh] = groups, self.group_count - before[2]
            pool.keep(
                groups=rows,
                skin_joints=joints[meshlets.vertices],
                skin_weights=weights[meshlets.vertices].astype(np.float32),
                source_vertex=meshlets.vertices,
            )
            self._pack_normals(pool, scene, mesh, meshlets, faces, first_vertex)
            self.group_count += len(groups)
        self.sources.append(np.concatenate(sources))
        after = (pool.vertex_count, pool.cluster_count, self.group_count)
        self.rows[-1]["groups"] = after[2] - before[2]
        self.counts = np.maximum(self.counts, np.subtract(after, before))

    def _pack_normals(
        self, pool: Pool, scene: RenderScene, mesh: int, meshlets: Meshlets, faces: NDArray[np.int32], first_vertex: int
    ) -> None:
        """Append the faces around every group of vertices that share a normal."""
        if mesh not in scene.groups:
            pool.keep(normal_groups=np.zeros(len(meshlets.vertices), np.int32))
            return
        group_of = scene.groups[mesh]
        place = np.zeros(len(scene.meshes[mesh].vertices), np.int32)  # one of each vertex's copies in the pool
        place[meshlets.vertices] = np.arange(len(meshlets.vertices), dtype=np.int32) + first_vertex
        around = group_of[faces].reshape(-1)
        order = np.argsort(around, kind="stable")
        count = int(group_of.max(initial=-1)) + 1
        first_face = sum(map(len, pool.parts.get("group_faces", [])))
        starts = np.concatenate([[0], np.cumsum(np.bincount(around, minlength=count))])
        pool.keep(
            normal_groups=(group_of[meshlets.vertices] + self.normal_group_count).astype(np.int32),
            group_first=(starts[:-1] + first_face).astype(np.int32),
            group_faces=place[faces][order // 3],
        )
        self.normal_group_count += count

    def arrays(self, pool: Pool) -> dict[str, Any]:
        """Return the fields of `Packed` that concern deformable meshes."""
        faces = pool.joined("group_faces", (0, 3), np.int32)
        return {
            "groups": pool.joined("groups", (0,), GROUP),
            "normal_groups": pool.joined("normal_groups", (0,), np.int32),
            "group_first": np.append(pool.joined("group_first", (0,), np.int32), len(faces)).astype(np.int32),
            "group_faces": faces,
            "skin_joints": pool.joined("skin_joints", (0, 4), np.uint8),
            "skin_weights": pool.joined("skin_weights", (0, 4), np.float32),
            "source_vertex": pool.joined("source_vertex", (0,), np.int32),
            "inverse_bind": self.inverse_bind,
            "sources": tuple(self.sources),
            "source_first": tuple(self.source_first),
            "deformed_vertices": int(self.counts[0]),
            "deformed_clusters": int(self.counts[1]),
            "deformed_groups": int(self.counts[2]),
            "bodies": self.bodies,
        }
