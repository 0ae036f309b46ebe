"""Packing of scenes into the arrays that the CUDA code reads.

Everything here is NumPy and runs without a GPU. Static instances are baked into world coordinates and cut into clusters
layer by layer, across instances. A mesh that moves or deforms is cut separately, once per scene. An *item* is a group
of clusters with a transform, and is the rasteriser's unit of work.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.scene import RenderScene
from h3data.render.shade.shading_simd import MIRROR_SIDES
from h3data_gpu.deformables import Deformables
from h3data_gpu.gpu_scene import GpuScene
from h3data_gpu.layout import BOX, PLACE, SCENE
from h3data_gpu.meshlets import build_meshlets
from h3data_gpu.pool import Pool, mesh_arrays

MAX_LAYERS, MAX_ITEMS, MAX_JOINTS = 32, 65535, 256


@dataclass(frozen=True, eq=False)
class Packed:
    """Arrays of several scenes, with names and meanings as in the CUDA structs."""

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
    instance_ids: NDArray[np.int32]
    semantic_ids: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    uv: NDArray[np.float32]
    mirrors: NDArray[np.float32]
    levels: NDArray[np.int32]
    first_level: NDArray[np.int32]
    texels: NDArray[np.uint32]
    opacity_maps: NDArray[np.int32]
    opacity: NDArray[np.uint8]
    normal_groups: NDArray[np.int32]
    group_first: NDArray[np.int32]
    group_faces: NDArray[np.int32]
    skin_joints: NDArray[np.uint8]
    skin_weights: NDArray[np.float32]
    source_vertex: NDArray[np.int32]
    inverse_bind: NDArray[np.float32]
    """Inverse bind matrices by scene, body and joint, shape [S, B, J, 4, 4]."""
    sources: tuple[NDArray[np.float32], ...]
    """Vertices of each scene's deformable meshes without a skin, in the frame of the mesh, shape [N, 3] [m]."""
    source_first: tuple[dict[int, int], ...]
    """First row of each scene in `sources`, by mesh."""
    layers: tuple[str, ...]
    """Named layers; layer k is bit k of the layer word of an instance. The empty layer has no bit."""
    textured: bool
    deformed_vertices: int
    """Number of deformed vertices in the scene with the most; the following fields are maxima over scenes too."""
    deformed_clusters: int
    deformed_groups: int
    bodies: int
    slots: int

    @property
    def nbytes(self) -> int:
        """Size of the arrays on the device [bytes]."""
        return sum(a.nbytes for a in vars(self).values() if isinstance(a, np.ndarray))


@lru_cache(maxsize=1)
def pack_scenes(scenes: tuple[GpuScene, ...]) -> Packed:
    """Return the packed arrays of several scenes.

    The last result is cached, so that renderers of other image sizes can use it again.

    Raises:
        InputError: a `GpuScene` refers to something that does not exist, or a scene exceeds the limits of the kernels.
    """
    for number, stage in enumerate(scenes):
        _check(stage, number)
    pool, deformed = Pool(glossy=any(stage.scene.mirrors for stage in scenes)), Deformables(scenes)
    for number in range(len(scenes)):
        deformed.pack(pool, number)
    layers = tuple(sorted({str(layer) for stage in scenes for layer in stage.scene.layers} - {""}))
    if len(layers) > MAX_LAYERS:
        raise InputError(
            f"At most {MAX_LAYERS} layers are supported, got {len(layers)}: {', '.join(layers[:5])}, ...",
            code="H3-RENDER-020",
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
            raise InputError(
                f"Scene {number} has {len(items)} groups of triangles; at most {MAX_ITEMS} are supported.",
                code="H3-RENDER-022",
            )
        words = sum(map(len, pool.parts.get("texels", [])))
        level_rows = sum(map(len, pool.parts.get("levels", [])))
        levels = surface.textures.levels.copy()
        levels[:, 0] += words
        maps = np.full((len(surface.textures.first_level), 3), -1, np.int32)
        if len(stage.scene.cutouts.maps):
            maps[:] = stage.scene.cutouts.maps
            maps[:, 0] += sum(map(len, pool.parts.get("opacity", [])))
        pool.keep(
            items=items,
            places=places,
            instance_ids=stage.scene.ids,
            semantic_ids=stage.scene.semantic_ids,
            texels=surface.textures.words,
            opacity_maps=maps,
            opacity=stage.scene.cutouts.opacity,
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
        instance_ids=pool.joined("instance_ids", (0,), np.int32),
        semantic_ids=pool.joined("semantic_ids", (0,), np.int32),
        normals=pool.joined("normals", (0, 3), np.float32),
        colors=colors,
        uv=pool.joined("uv", (0, 2), np.float32),
        mirrors=pool.joined("mirrors", (0, MIRROR_SIDES), np.float32),
        levels=pool.joined("levels", (0, 4), np.int32),
        first_level=pool.joined("first_level", (0,), np.int32),
        texels=pool.joined("texels", (0,), np.uint32),
        opacity_maps=pool.joined("opacity_maps", (0, 3), np.int32),
        opacity=pool.joined("opacity", (0,), np.uint8),
        layers=layers,
        textured=first_texture > 0,
        slots=1 + max((len(stage.slots) for stage in scenes), default=0),
        **deformed.arrays(pool),
    )


def _check(stage: GpuScene, number: int) -> None:
    scene, faults = stage.scene, []
    count = len(scene.instances)
    faults += [f"moving lists instance {k}, but there are {count}" for k in stage.moving if not 0 <= k < count]
    if len(set(stage.moving)) < len(stage.moving):
        faults.append("moving lists an instance twice")
    for mesh, (skin, inverse_bind) in stage.skins.items():
        if mesh not in scene.deformable:
            faults.append(f"skins lists mesh {mesh}, which is not deformable (these are: {list(scene.deformable)})")
            continue
        expected = (len(scene.meshes[mesh].vertices), 4)
        if skin.joints.shape != expected or skin.weights.shape != expected:
            faults.append(f"the skin of mesh {mesh} needs joints and weights {list(expected)}")
        elif inverse_bind.ndim != 3 or not int(skin.joints.max(initial=0)) < len(inverse_bind) <= MAX_JOINTS:
            faults.append(f"the skin of mesh {mesh} needs a matrix [4, 4] for each of at most {MAX_JOINTS} joints")
    if faults:
        raise InputError(f"Scene {number} cannot be packed: {'; '.join(faults[:5])}.", code="H3-RENDER-021")


def _scene_items(
    pool: Pool, stage: GpuScene, deformed: Deformables, number: int, bits: Mapping[str, int], first_texture: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the items [N] and places [N] of a scene: static instances first, layer by layer, then moving ones."""
    scene, slots = stage.scene, stage.slots
    items: list[NDArray[Any]] = []
    places: list[NDArray[Any]] = []

    def keep(groups: NDArray[Any], *, slot: int, layer: str, group: NDArray[Any] | int, instance: int) -> None:
        place = np.zeros(len(groups), PLACE)
        place["slot"], place["layer"], place["group"], place["instance"] = slot, bits[layer], group, instance
        items.append(groups)
        places.append(place)

    static = [
        k for k in range(len(scene.instances)) if k not in set(slots) and np.isfinite(scene.instance_matrix[k]).all()
    ]
    for layer in sorted({str(scene.layers[k]) for k in static}):
        baked = _baked(scene, [k for k in static if scene.layers[k] == layer], first_texture)
        meshlets = build_meshlets(baked["vertices"], baked.pop("faces"), baked.pop("cut_out"))
        keep(pool.add(meshlets, **baked), slot=0, layer=layer, group=-1, instance=-1)
    rigid: dict[int, NDArray[Any]] = {}
    for slot, k in enumerate(slots, start=1):
        mesh, layer = int(scene.instance_mesh[k]), str(scene.layers[k])
        if mesh in scene.deformable:
            groups, first = deformed.boxes[number][mesh]
            keep(groups, slot=slot, layer=layer, group=first + np.arange(len(groups)), instance=k)
            continue
        if mesh not in rigid:
            arrays = mesh_arrays(scene, mesh, first_texture)
            meshlets = build_meshlets(arrays["vertices"], arrays.pop("faces"), arrays.pop("cut_out"))
            rigid[mesh] = pool.add(meshlets, **arrays)
        keep(rigid[mesh], slot=slot, layer=layer, group=-1, instance=k)
    return np.concatenate([np.zeros(0, BOX), *items]), np.concatenate([np.zeros(0, PLACE), *places])


def _baked(scene: RenderScene, instances: Sequence[int], first_texture: int) -> dict[str, NDArray[Any]]:
    """Return several instances as one mesh in world coordinates."""
    parts: list[dict[str, NDArray[Any]]] = []
    start = 0
    matrices = scene.instance_matrix[list(instances)]
    rows = matrices[..., :3].transpose(1, 0, 2)
    all_cofactors = np.stack([np.cross(rows[(r + 1) % 3], rows[(r + 2) % 3]) for r in range(3)], axis=1)
    for k, matrix, cofactors in zip(instances, matrices, all_cofactors, strict=True):
        part = mesh_arrays(scene, int(scene.instance_mesh[k]), first_texture, instance=k)
        linear = matrix[:, :3]
        normals = part["normals"] @ cofactors.T
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        part["normals"] = (normals / np.where(length > 0, length, 1)).astype(np.float32)
        part["vertices"] = (part["vertices"] @ linear.T + matrix[:, 3]).astype(np.float32)
        part["faces"] = part["faces"] + np.int32(start)
        start += len(part["vertices"])
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
