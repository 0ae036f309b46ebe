"""Scenes as the arrays that the CUDA code reads. Everything here is NumPy and runs without a GPU.

What never moves is baked into the world and cut into clusters layer by layer, whatever instance it belongs to; a mesh that
moves or deforms is cut on its own, once per scene. An *item* is a group of clusters with a place: the rasteriser's unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.gpu.layout import BOX, GROUP, PLACE, SCENE
from h3data.render.gpu.meshlets import Meshlets, build_meshlets
from h3data.render.scene import RenderScene

MAX_LAYERS, MAX_ITEMS, MAX_JOINTS = 32, 65535, 256
_BOX_MARGIN_M = 1e-6


class SkinWeights(Protocol):
    """What drives a skinned mesh; `h3data.bodies.humanoid.SkinnedMesh` is one."""

    joints: NDArray[np.integer]
    """Joints of the four weights, shape [V, 4]."""
    weights: NDArray[np.float32]
    """Shape [V, 4]."""


@dataclass(frozen=True, eq=False)
class GpuScene:
    """A scene, and what of it moves: everything else is baked where it stands."""

    scene: RenderScene
    moving: Sequence[int] = ()
    """Instances with a pose of their own in every world; those of deformable meshes need not be named."""
    skins: Mapping[int, tuple[SkinWeights, NDArray[Any]]] = field(default_factory=dict)
    """Of deformable meshes that follow joints: the weights, and the inverse bind matrices [J, 4, 4]. The other deformable
    meshes are given their vertices."""

    @property
    def slots(self) -> tuple[int, ...]:
        """The instances that have poses, in the order of `GpuRenderer.update_poses`."""
        deformable = set(self.scene.deformable)
        others = [k for k, m in enumerate(self.scene.instance_mesh) if int(m) in deformable and k not in self.moving]
        return (*(int(k) for k in self.moving), *others)


@dataclass(frozen=True, eq=False)
class Packed:
    """The arrays; names and meanings as in the CUDA structs."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    clusters: NDArray[Any]
    items: NDArray[Any]
    places: NDArray[Any]
    scenes: NDArray[Any]
    groups: NDArray[Any]
    triangle_instances: NDArray[np.int32]
    triangle_faces: NDArray[np.int32]
    triangle_textures: NDArray[np.int32]
    semantic_ids: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    uv: NDArray[np.float32]
    levels: NDArray[np.int32]
    first_level: NDArray[np.int32]
    texels: NDArray[np.uint32]
    normal_groups: NDArray[np.int32]
    group_first: NDArray[np.int32]
    group_faces: NDArray[np.int32]
    skin_joints: NDArray[np.uint8]
    skin_weights: NDArray[np.float32]
    source_vertex: NDArray[np.int32]
    inverse_bind: NDArray[np.float32]
    """Per scene, body and joint, shape [S, B, J, 4, 4]."""
    sources: tuple[NDArray[np.float32], ...]
    """Of each scene: the given vertices of its deformable meshes without skin, [N, 3]."""
    source_first: tuple[dict[int, int], ...]
    """Of each scene: mesh to its first row in `sources`."""
    layers: tuple[str, ...]
    """Bit k of a place's layer; the empty layer has none."""
    textured: bool
    deformed_vertices: int
    """Most that any scene has; likewise below."""
    deformed_clusters: int
    deformed_groups: int
    bodies: int
    slots: int

    @property
    def nbytes(self) -> int:
        """What they take on the device [bytes]."""
        return sum(a.nbytes for a in vars(self).values() if isinstance(a, np.ndarray))


class _Pool:
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
        clusters["first"] = counts | cut.triangle_count << 16
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


@lru_cache(maxsize=1)
def pack_scenes(scenes: tuple[GpuScene, ...]) -> Packed:
    """The arrays of some scenes; those of the last ones are kept, for renderers of other sizes.

    Raises:
        InputError: something named is not there, or a scene is beyond what the kernels' words can count.
    """
    for number, stage in enumerate(scenes):
        _check(stage, number)
    pool, deformed = _Pool(), _Deformables(scenes)
    for number in range(len(scenes)):
        deformed.pack(pool, number)
    layers = tuple(sorted({str(layer) for stage in scenes for layer in stage.scene.layers} - {""}))
    if len(layers) > MAX_LAYERS:
        raise InputError(
            f"At most {MAX_LAYERS} layers can be told apart, got {len(layers)}: {', '.join(layers[:5])}, ..."
        )
    bits = {layer: 1 << k for k, layer in enumerate(layers)} | {"": 0}

    table = np.zeros(len(scenes), SCENE)
    first_texture = 0
    for number, stage in enumerate(scenes):
        surface, row = stage.scene.surface, table[number]
        items, places = _scene_items(pool, stage, deformed, number, bits, first_texture)
        row["first_item"], row["items"] = sum(map(len, pool.parts.get("items", []))), len(items)
        row["first_instance"] = sum(map(len, pool.parts.get("semantic_ids", [])))
        for name in ("first_group", "groups", "first_vertex", "first_cluster"):
            row[name] = deformed.rows[number][name]
        if len(items) > MAX_ITEMS:
            raise InputError(f"Scene {number} has {len(items)} groups of triangles, at most {MAX_ITEMS} can be drawn.")
        words = sum(map(len, pool.parts.get("texels", [])))
        level_rows = sum(map(len, pool.parts.get("levels", [])))
        levels = surface.textures.levels.copy()
        levels[:, 0] += words
        pool.keep(
            items=items,
            places=places,
            semantic_ids=stage.scene.semantic_ids,
            texels=surface.textures.words,
            levels=levels,
            first_level=surface.textures.first_level + np.int32(level_rows),
        )
        first_texture += len(surface.textures.first_level)
    colors = pool.joined("colors", (0, 4), np.uint8)
    return Packed(
        vertices=pool.joined("vertices", (0, 3), np.float32),
        triangles=pool.joined("triangles", (0,), np.uint32),
        clusters=pool.joined("clusters", (0,), BOX),
        items=pool.joined("items", (0,), BOX),
        places=pool.joined("places", (0,), PLACE),
        scenes=table,
        triangle_instances=pool.joined("triangle_instances", (0,), np.int32),
        triangle_faces=pool.joined("triangle_faces", (0,), np.int32),
        triangle_textures=pool.joined("triangle_textures", (0,), np.int32),
        semantic_ids=pool.joined("semantic_ids", (0,), np.int32),
        normals=pool.joined("normals", (0, 3), np.float32),
        colors=colors,
        uv=pool.joined("uv", (0, 2), np.float32),
        levels=pool.joined("levels", (0, 4), np.int32),
        first_level=pool.joined("first_level", (0,), np.int32),
        texels=pool.joined("texels", (0,), np.uint32),
        layers=layers,
        textured=first_texture > 0,
        slots=1 + max((len(stage.slots) for stage in scenes), default=0),
        **deformed.arrays(pool),
    )


def _check(stage: GpuScene, number: int) -> None:
    scene, faults = stage.scene, []
    faults += [f"moving names instance {k}, there are {len(scene.instances)}" for k in stage.moving
               if not 0 <= k < len(scene.instances)]  # fmt: skip
    if len(set(stage.moving)) < len(stage.moving):
        faults.append("moving names an instance twice")
    for mesh, (skin, inverse_bind) in stage.skins.items():
        if mesh not in scene.deformable:
            faults.append(f"skins names mesh {mesh}, which is not deformable (these are: {list(scene.deformable)})")
            continue
        expected = (len(scene.meshes[mesh].vertices), 4)
        if skin.joints.shape != expected or skin.weights.shape != expected:
            faults.append(f"the skin of mesh {mesh} needs joints and weights {list(expected)}")
        elif inverse_bind.ndim != 3 or not int(skin.joints.max(initial=0)) < len(inverse_bind) <= MAX_JOINTS:
            faults.append(f"the skin of mesh {mesh} needs a matrix [4, 4] for each of at most {MAX_JOINTS} joints")
    if faults:
        raise InputError(f"Scene {number} cannot be packed: {'; '.join(faults[:5])}.")


def _scene_items(
    pool: _Pool, stage: GpuScene, deformed: _Deformables, number: int, bits: Mapping[str, int], first_texture: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Items [N] and places [N] of a scene: first what stands still, layer by layer, then what moves."""
    scene, slots = stage.scene, stage.slots
    items: list[NDArray[Any]] = []
    places: list[NDArray[Any]] = []

    def keep(groups: NDArray[Any], *, slot: int, layer: str, group: NDArray[Any] | int, instance: int) -> None:
        place = np.zeros(len(groups), PLACE)
        place["slot"], place["layer"], place["group"], place["instance"] = slot, bits[layer], group, instance
        items.append(groups)
        places.append(place)

    still = [
        k for k in range(len(scene.instances)) if k not in set(slots) and np.isfinite(scene.instance_matrix[k]).all()
    ]
    for layer in sorted({str(scene.layers[k]) for k in still}):
        baked = _baked(scene, [k for k in still if scene.layers[k] == layer], first_texture)
        cut = build_meshlets(baked["vertices"], baked.pop("faces"))
        keep(pool.add(cut, **baked), slot=0, layer=layer, group=-1, instance=-1)
    rigid: dict[int, NDArray[Any]] = {}
    for slot, k in enumerate(slots, start=1):
        mesh, layer = int(scene.instance_mesh[k]), str(scene.layers[k])
        if mesh in scene.deformable:
            groups, first = deformed.boxes[number][mesh]
            keep(groups, slot=slot, layer=layer, group=first + np.arange(len(groups)), instance=k)
            continue
        if mesh not in rigid:
            own = mesh_arrays(scene, mesh, first_texture)
            rigid[mesh] = pool.add(build_meshlets(own["vertices"], own.pop("faces")), **own)
        keep(rigid[mesh], slot=slot, layer=layer, group=-1, instance=k)
    return np.concatenate([np.zeros(0, BOX), *items]), np.concatenate([np.zeros(0, PLACE), *places])


def mesh_arrays(scene: RenderScene, mesh: int, first_texture: int, *, instance: int = -1) -> dict[str, NDArray[Any]]:
    """A mesh as `_Pool.add` takes it, with its faces."""
    surface = scene.surface
    v, f = slice(*scene.first_vertex[mesh : mesh + 2]), slice(*scene.first_face[mesh : mesh + 2])
    textures = surface.face_textures[f]
    colors = np.zeros((v.stop - v.start, 4), np.uint8)
    colors[:, :3] = surface.colors[v]
    count = f.stop - f.start
    return {
        "vertices": scene.meshes[mesh].vertices,
        "faces": scene.meshes[mesh].faces,
        "normals": surface.normals[v],
        "colors": colors,
        "uv": surface.uv[v] if len(surface.uv) else np.zeros((len(colors), 2), np.float32),
        "face_ids": np.arange(count, dtype=np.int32),
        "face_textures": np.where(textures >= 0, textures + first_texture, -1).astype(np.int32),
        "face_instances": np.full(count, instance, np.int32),
    }


def _baked(scene: RenderScene, instances: Sequence[int], first_texture: int) -> dict[str, NDArray[Any]]:
    """Some instances as one mesh in the world."""
    parts: list[dict[str, NDArray[Any]]] = []
    start = 0
    for k in instances:
        part = mesh_arrays(scene, int(scene.instance_mesh[k]), first_texture, instance=k)
        matrix = scene.instance_matrix[k]
        linear = matrix[:, :3]
        cofactors = np.stack([np.cross(linear[(r + 1) % 3], linear[(r + 2) % 3]) for r in range(3)])
        normals = part["normals"] @ cofactors.T
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        part["normals"] = (normals / np.where(length > 0, length, 1)).astype(np.float32)
        part["vertices"] = (part["vertices"] @ linear.T + matrix[:, 3]).astype(np.float32)
        part["faces"] = part["faces"] + np.int32(start)
        start += len(part["vertices"])
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class _Deformables:
    """The deformable meshes of all scenes. They go into the pool first, so that tables per vertex of theirs stay short."""

    def __init__(self, scenes: Sequence[GpuScene]) -> None:
        self.scenes = scenes
        self.rows: list[dict[str, int]] = []
        self.boxes: list[dict[int, tuple[NDArray[Any], int]]] = []
        """Of each scene, by mesh: its groups, and the number of the first among the scene's."""
        self.sources: list[NDArray[np.float32]] = []
        self.source_first: list[dict[int, int]] = []
        self.counts = np.zeros(3, np.int64)
        """Most vertices, clusters and groups of a scene."""
        self.group_count = self.normal_group_count = 0
        self.joint_count = max((len(bind) for s in scenes for _, bind in s.skins.values()), default=1)
        self.bodies = max((len(s.scene.deformable) for s in scenes), default=0)
        self.inverse_bind = np.tile(
            np.eye(4, dtype=np.float32), (len(scenes), max(self.bodies, 1), self.joint_count, 1, 1)
        )

    def pack(self, pool: _Pool, number: int) -> None:
        """Append one scene's."""
        stage = self.scenes[number]
        scene, before = stage.scene, (pool.vertex_count, pool.cluster_count, self.group_count)
        self.rows.append(dict(first_group=before[2], first_vertex=before[0], first_cluster=before[1]))
        self.boxes.append({})
        self.source_first.append({})
        sources = [np.zeros((0, 3), np.float32)]
        first_texture = sum(len(s.scene.surface.textures.first_level) for s in self.scenes[:number])
        for body, mesh in enumerate(scene.deformable):
            own = mesh_arrays(scene, mesh, first_texture)
            own["colors"][:, 3] = mesh in scene.groups
            faces = own.pop("faces")
            cut = build_meshlets(own["vertices"], faces)
            first_vertex = pool.vertex_count
            groups = pool.add(cut, **own)
            first_source = -1
            if mesh in stage.skins:
                skin, bind = stage.skins[mesh]
                joints, weights = skin.joints.astype(np.uint8), skin.weights.astype(np.float32)
                self.inverse_bind[number, body, : len(bind)] = bind
            else:
                joints, weights = np.zeros((len(own["vertices"]), 4), np.uint8), np.zeros((len(own["vertices"]), 4))
                first_source = sum(map(len, sources))
                self.source_first[number][mesh] = first_source
                sources.append(own["vertices"])
            rows = np.zeros(len(groups), GROUP)
            rows["first_cluster"], rows["clusters"] = groups["first"], groups["second"]
            rows["body"], rows["first_source"] = body, first_source
            self.boxes[number][mesh] = groups, self.group_count - before[2]
            pool.keep(
                groups=rows,
                skin_joints=joints[cut.vertices],
                skin_weights=weights[cut.vertices].astype(np.float32),
                source_vertex=cut.vertices,
            )
            self._pack_normals(pool, scene, mesh, cut, faces, first_vertex)
            self.group_count += len(groups)
        self.sources.append(np.concatenate(sources))
        after = (pool.vertex_count, pool.cluster_count, self.group_count)
        self.rows[-1]["groups"] = after[2] - before[2]
        self.counts = np.maximum(self.counts, np.subtract(after, before))

    def _pack_normals(
        self, pool: _Pool, scene: RenderScene, mesh: int, cut: Meshlets, faces: NDArray[np.int32], first_vertex: int
    ) -> None:
        """The faces around every vertex, by groups of vertices that share a normal."""
        if mesh not in scene.groups:
            pool.keep(normal_groups=np.zeros(len(cut.vertices), np.int32))
            return
        group_of = scene.groups[mesh]
        place = np.zeros(len(scene.meshes[mesh].vertices), np.int32)  # one of a vertex' places in the pool
        place[cut.vertices] = np.arange(len(cut.vertices), dtype=np.int32) + first_vertex
        around = group_of[faces].reshape(-1)
        order = np.argsort(around, kind="stable")
        count = int(group_of.max(initial=-1)) + 1
        first_face = sum(map(len, pool.parts.get("group_faces", [])))
        starts = np.concatenate([[0], np.cumsum(np.bincount(around, minlength=count))])
        pool.keep(
            normal_groups=(group_of[cut.vertices] + self.normal_group_count).astype(np.int32),
            group_first=(starts[:-1] + first_face).astype(np.int32),
            group_faces=place[faces][order // 3],
        )
        self.normal_group_count += count

    def arrays(self, pool: _Pool) -> dict[str, Any]:
        """Their part of `Packed`."""
        faces = pool.joined("group_faces", (0, 3), np.int32)
        return dict(
            groups=pool.joined("groups", (0,), GROUP),
            normal_groups=pool.joined("normal_groups", (0,), np.int32),
            group_first=np.append(pool.joined("group_first", (0,), np.int32), len(faces)).astype(np.int32),
            group_faces=faces,
            skin_joints=pool.joined("skin_joints", (0, 4), np.uint8),
            skin_weights=pool.joined("skin_weights", (0, 4), np.float32),
            source_vertex=pool.joined("source_vertex", (0,), np.int32),
            inverse_bind=self.inverse_bind,
            sources=tuple(self.sources),
            source_first=tuple(self.source_first),
            deformed_vertices=int(self.counts[0]),
            deformed_clusters=int(self.counts[1]),
            deformed_groups=int(self.counts[2]),
            bodies=self.bodies,
        )
