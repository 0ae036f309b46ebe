"""Baking of the light of windows, sun and lamps into the vertex colours of meshes.

Every rendering back end supports vertex colours and multiplies them with textures, so that no kernel needs to compute
light. (An atlas of light maps would need a second texture on floors, furniture and scanned homes.) Moving objects still
use the one `Light` of the scene. A static vertex therefore stores the ratio of its own light to that light. All colours
are divided by `HEADROOM` and the light is multiplied by it, so that bright places can be stored.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized, transform_points
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import face_texture_indices
from h3data.progress import is_quiet
from h3data.render.light.sources import LightSources
from h3data.render.scene import RenderInstance
from h3data.render.shade.shading import Light
from h3data.srgb import bytes_to_linear, linear_to_bytes
from h3data_light import probes as pr
from h3data_light.direct import EMITTER_WORDS, LAMP, LAMP_RADIUS, SUN, SUN_SPREAD, WINDOW
from h3data_light.exposure import flat_light, shown_light
from h3data_light.field import FACE_NORMALS, LightField, light_field, mirrored
from h3data_light.outdoors import with_view
from h3data_light.refine import Heap, hashes, heap_of, refine
from h3data_light.store import Baked, cached
from h3data_light.voxels import PROBE_VOXELS, Voxels, voxelise

log = logging.getLogger(__name__)

HEADROOM = 2.4
"""Greatest brightness of a white surface, relative to its brightness under the flat light."""
_SUN = (9.0, 8.2, 6.8)
"""Irradiance of the sun, in the units of `direct.SKY`."""
_GLASS, _GLOW = 1.5, 1.8
"""Brightness of window panes and lamps, in units of the flat light."""
_VIEW = 1.5
"""Brightness of the view through panes, in units of the flat light."""
_DARK = 1e-4
"""Median irradiance below which a scene has no light."""


@dataclass(frozen=True)
class LitScene:
    """Meshes and instances with baked light for a `RenderScene`, and the light for its renderer."""

    meshes: list[Mesh]
    instances: list[RenderInstance]
    light: Light
    mirrors: dict[int, NDArray[np.float32]]
    """Light that glossy meshes reflect, by mesh index, for `RenderScene`."""
    field: LightField | None
    """Light field for moving objects and their shadows (`Renderer.set_blockers`); None if there is no light to bake."""

    @property
    def baked(self) -> bool:
        """Return whether the meshes carry baked light; otherwise they are the unchanged input."""
        return self.field is not None


def lit_scene(
    meshes: Sequence[Mesh],
    instances: Sequence[RenderInstance],
    static: Sequence[int],
    sources: LightSources,
    *,
    light: Light | None = None,
    name: str = "scene",
) -> LitScene:
    """Bake the light of a scene into its static instances, each of which gets its own mesh.

    New meshes follow the given ones. The light of a home is computed once and cached (`store`). Triangle ids refer to
    the refined meshes.

    Args:
        meshes: Meshes of the scene.
        instances: Instances of the meshes.
        static: Indices of the instances that never move and whose meshes are not deformable.
        sources: Light sources (`sources_of`).
        light: Flat light of moving objects (default `Light()`).
        name: Name of the scene in messages.
    """
    light = light or Light()
    chosen = [k for k in static if len(meshes[instances[k].mesh].faces) and np.isfinite(instances[k].matrix).all()]
    own = [meshes[instances[k].mesh] for k in chosen]
    matrices = [np.asarray(instances[k].matrix, np.float64) for k in chosen]
    names = [instances[k].name for k in chosen]
    baked = cached(own, matrices, names, sources, light, lambda: _announced(name, own, matrices, names, sources, light))
    if baked is None:
        log.warning("No light reaches %s, neither from outdoors nor from lamps: it is shown in flat light.", name)
        return LitScene(list(meshes), list(instances), light, {}, None)
    out_meshes, out_instances = list(meshes), list(instances)
    floor_y = min(float(transform_points(m, mesh.bounds)[:, 1].min()) for m, mesh in zip(matrices, own, strict=True))
    mirrors: dict[int, NDArray[np.float32]] = {}
    for k, mesh, matrix, seen in zip(chosen, baked.meshes, matrices, baked.mirrors, strict=True):
        if instances[k].name in sources.glass:
            mesh = with_view(mesh, matrix, floor_y=floor_y, shown=_VIEW / HEADROOM)
        if seen is not None:
            mirrors[len(out_meshes)] = seen
        out_instances[k] = replace(instances[k], mesh=len(out_meshes))
        out_meshes.append(mesh)
    used = {instance.mesh for instance in out_instances}
    for m in range(len(meshes)):
        out_meshes[m] = _dimmed(meshes[m]) if m in used else _EMPTY
    return LitScene(out_meshes, out_instances, _brighter(light), mirrors, baked.field)


_EMPTY = Mesh(
    vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
)


def _dimmed(mesh: Mesh) -> Mesh:
    return replace(mesh, colors=linear_to_bytes(bytes_to_linear(mesh.colors) / HEADROOM))


def _brighter(light: Light) -> Light:
    names = ("sky", "ground", "sun", "fill", "headlight")
    return replace(light, **{name: tuple(HEADROOM * c for c in getattr(light, name)) for name in names})


def _announced(
    name: str,
    meshes: Sequence[Mesh],
    matrices: Sequence[NDArray[np.float64]],
    names: Sequence[str],
    sources: LightSources,
    light: Light,
) -> Baked | None:
    triangles = sum(len(mesh.faces) for mesh in meshes)
    if triangles > 100_000 and not is_quiet():
        log.warning("Computing the light of %s, once: about %d s.", name, 2 + triangles // 30_000)
    return bake(meshes, matrices, names, sources, light)


def bake(
    meshes: Sequence[Mesh],
    matrices: Sequence[NDArray[np.float64]],
    names: Sequence[str],
    sources: LightSources,
    light: Light,
) -> Baked | None:
    """Return the meshes of static instances with baked light, and the light field between them; None without light."""
    heap = heap_of(meshes, matrices) if meshes else None
    if heap is None or not len(heap.faces):
        return None
    glass = np.array([n in sources.glass for n in names])
    glow, glossy = (np.array([n in group for n in names]) for group in (sources.glowing, sources.glossy))
    voxels = _voxels(heap, meshes, glass, glow, sources)
    emitters = _emitters(voxels, sources, light)
    measured = _indirect(voxels, emitters)
    if measured is None:
        return None
    probes, face_light, mean = measured

    def light_at(points: NDArray, normals: NDArray, inward: NDArray) -> NDArray[np.float32]:
        keys = np.column_stack([np.rint(points * 500), np.rint(normals * 20)]).astype(np.int64)
        _, first, back = np.unique(hashes(keys), return_index=True, return_inverse=True)
        place = ((points[first] - voxels.origin) / voxels.cell_m).astype(np.float32)
        out = np.empty((len(first), 3), np.float32)
        pr.light_points(
            voxels.distance,
            place,
            normals[first].astype(np.float32),
            inward[first].astype(np.float32),
            emitters,
            4,
            probes.reach,
            probes.place,
            probes.usable,
            probes.light,
            out,
        )
        return out[back]

    limit = 120_000 + 2 * len(heap.faces)
    refine(heap, light_at, mean=mean, lit=~glass & ~glow, max_faces=limit)
    field = light_field(voxels, face_light, probes, emitters, mean, flat_light(light, FACE_NORMALS).mean(0))
    return Baked(*_meshes(heap, meshes, glass, glow, glossy, light, field), field)


def _voxels(
    heap: Heap, meshes: Sequence[Mesh], glass: NDArray[np.bool_], glow: NDArray[np.bool_], sources: LightSources
) -> Voxels:
    colors = heap.vertices[:, 6:9][heap.faces].mean(1)
    for number, mesh in enumerate(meshes):
        if mesh.textures:
            tints = np.array(
                [bytes_to_linear(t.pixels[::4, ::4, :3]).mean((0, 1)) for t in mesh.textures] + [np.ones(3)]
            )
            mine = slice(*np.searchsorted(heap.mesh, (number, number + 1)))
            colors[mine] *= tints[face_texture_indices(mesh)]
    solid = ~glow[heap.mesh]
    triangles = heap.world[heap.faces, :3][solid]
    lamps = np.array([lamp.position for lamp in sources.lamps], np.float64).reshape(-1, 3)
    return voxelise(triangles, colors[solid].astype(np.float32), glass[heap.mesh][solid], lamps)


def _emitters(voxels: Voxels, sources: LightSources, light: Light) -> NDArray[np.float32]:
    """Return the windows, lamps and suns as the kernels take them (`direct.EMITTER_WORDS`), in voxels."""
    cell, nothing = voxels.cell_m, np.zeros(3)
    rows = []
    for window in sources.windows:
        inside = _indoor_side(voxels, window.center, window.across)
        if inside is None:
            continue
        center = (window.center - voxels.origin) / cell
        area = 4 * np.linalg.norm(window.half_u) * np.linalg.norm(window.half_v) / cell**2
        sides = window.half_u / cell, window.half_v / cell, inside * window.across
        rows.append([[WINDOW], center, *sides, [area], nothing])
    wide = LAMP_RADIUS * np.array([1.0, 0, 0]), LAMP_RADIUS * np.array([0, 0, 1.0])
    rows += [
        [[LAMP], (lamp.position - voxels.origin) / cell, *wide, nothing, [1 / cell**2], lamp.power]
        for lamp in sources.lamps
    ]
    for direction, power in ((normalized(np.array(light.sun_direction)), np.array(_SUN)), *sources.suns):
        u = normalized(np.cross(direction, [0.0, 1, 0] if abs(direction[1]) < 0.9 else [1.0, 0, 0]))
        size = SUN_SPREAD * u, SUN_SPREAD * np.cross(direction, u)
        rows.append([[SUN], direction, *size, nothing, [1.0], power])
    return np.array([np.concatenate(row) for row in rows], np.float32).reshape(-1, EMITTER_WORDS)


def _indoor_side(voxels: Voxels, center: NDArray[np.float64], across: NDArray[np.float64]) -> int | None:
    """Return +1 or -1 for the side of a window that has something above it, None if both or none have."""
    covered = []
    for sign in (1, -1):
        x, y, z = ((center + sign * 0.6 * across - voxels.origin) / voxels.cell_m).astype(int)
        inside = 0 <= x < voxels.distance.shape[0] and 0 <= z < voxels.distance.shape[2]
        covered.append(inside and bool((voxels.distance[x, max(y, 0) :, z] == 0).any()))
    return None if covered[0] == covered[1] else 1 if covered[0] else -1


def _indirect(voxels: Voxels, emitters: NDArray[np.float32]) -> tuple[pr.Probes, NDArray[np.float32], float] | None:
    """Return probes with all reflected light, the direct light of the faces of blocks, and the mean light of surfaces.

    The direct light is [X', Y', Z', 6, 3]. Returns None if there is no light.
    """
    shape = tuple(n // PROBE_VOXELS for n in voxels.distance.shape)
    place, usable = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.bool_)
    pr.place_probes(voxels.distance, place, usable)
    reach = _reach(voxels, place, usable, emitters)
    count, direct, covered = _direct(voxels, reach, emitters)
    field = np.zeros((*shape, 6, 3), np.float32)
    for rays in pr.RAYS:
        after = np.zeros_like(field)
        pr.gather(voxels.distance, voxels.albedo, direct, field, place, usable, pr.ray_directions(rays), after)
        for axis in range(3):
            pr.blur(voxels.distance, place, usable, after, field, axis)
            after, field = field.copy(), field
    total = (direct + field).mean(-1)
    seen = (count > 0) & usable[..., None]
    inside = seen & covered
    if inside.sum() > 0.2 * seen.sum():
        seen = inside
    if not seen.any() or np.median(total[seen]) < _DARK:
        return None
    weight = count[seen]
    mean = float(np.exp(np.sum(weight * np.log(np.maximum(total[seen], _DARK))) / weight.sum()))
    return pr.Probes(reach, place, usable, field), direct, mean


def _reach(
    voxels: Voxels,
    place: NDArray[np.float32],
    usable: NDArray[np.bool_],
    emitters: NDArray[np.float32],
) -> NDArray[np.uint64]:
    """Return the bits of the windows and lamps that each block or a neighbour of it sees, shape [X', Y', Z', 2]."""
    reach = np.zeros((*usable.shape, 2), np.uint64)
    pr.find_reach(voxels.distance, place, usable, emitters, reach)
    for axis in range(3):
        wide, one = reach.copy(), np.moveaxis(reach, axis, 0)
        moved = np.moveaxis(wide, axis, 0)
        moved[1:] |= one[:-1]
        moved[:-1] |= one[1:]
        reach = wide
    return reach


def _direct(
    voxels: Voxels, reach: NDArray[np.uint64], emitters: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return faces in each block and direction [X', Y', Z', 6], their direct light, and whether they are covered."""
    shape = reach.shape[:3]
    count = np.zeros((*shape, 6), np.int32)
    most = 4 * int((voxels.distance == 0).sum()) // 3 + 64
    points, normals, covered = (np.zeros((most, *n), kind) for n, kind in (((3,), "f4"), ((3,), "f4"), ((), np.bool_)))
    number = pr.find_faces(voxels.distance, count, points, normals, covered)
    points, normals, covered = points[:number], normals[:number], covered[:number]
    out = np.zeros((number, 3), np.float32)
    none = np.zeros((0, 0, 0), np.bool_), np.zeros((0, 0, 0, 6, 3), np.float32)
    pr.light_points(
        voxels.distance,
        points - 1.25 * normals,
        normals,
        np.zeros_like(points),
        emitters,
        2,
        reach,
        np.zeros((0, 0, 0, 3), np.float32),
        *none,
        out,
    )
    per_block = np.minimum(count.ravel(), 2)
    block = np.repeat(np.arange(per_block.size), per_block)
    light = np.column_stack([np.bincount(block, np.nan_to_num(out[:, a]), per_block.size) for a in range(3)])
    light /= np.maximum(per_block, 1)[:, None]
    inside = np.bincount(block, covered, per_block.size) > 0
    return count, light.reshape(*shape, 6, 3).astype(np.float32), inside.reshape(*shape, 6)


def _meshes(
    heap: Heap,
    meshes: Sequence[Mesh],
    glass: NDArray[np.bool_],
    glow: NDArray[np.bool_],
    glossy: NDArray[np.bool_],
    light: Light,
    field: LightField,
) -> tuple[list[Mesh], list[NDArray[np.float32] | None]]:
    """Return the meshes of a lit heap, and what they mirror."""
    mean = field.mean
    flat = flat_light(light, heap.world[:, 3:])
    irradiance = np.nan_to_num(heap.light, nan=0.3 * mean)
    ratio = shown_light(irradiance, mean) / flat
    order = np.argsort(heap.mesh, kind="stable")
    starts = np.searchsorted(heap.mesh[order], np.arange(len(meshes) + 1))
    out: list[Mesh] = []
    mirrors: list[NDArray[np.float32] | None] = []
    for number, mesh in enumerate(meshes):
        chosen = order[starts[number] : starts[number + 1]]
        used, faces = np.unique(heap.faces[chosen], return_inverse=True)
        rows = heap.vertices[used]
        mirrors.append(mirrored(field, heap.world[used], irradiance[used]) if glossy[number] else None)
        shown = _GLASS if glass[number] else _GLOW if glow[number] else ratio[used]
        out.append(
            Mesh(
                vertices=rows[:, :3].astype(np.float32),
                faces=faces.reshape(-1, 3).astype(np.int32),
                colors=linear_to_bytes(rows[:, 6:9] * shown / HEADROOM),
                normals=rows[:, 3:6].astype(np.float32),
                uv=rows[:, 9:].astype(np.float32) if mesh.uv is not None else None,
                textures=mesh.textures,
                face_textures=heap.textures[chosen] if mesh.textures else None,
            )
        )
    return out, mirrors
