"""Ray casting with Embree: distances, lines of sight, lidar, and shadows of the sun (needs the extra ``rays``).

Embree scenes are built in robust mode; otherwise rays slip between triangles at shared edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.geometry import normalized
from h3data.kernels import kernel
from h3data.render.outputs import Poses
from h3data.render.scene import RenderScene
from h3data.render.shade.cutouts import is_solid
from h3data.render.shade.shading import Light

_FAR_M = 1e30
_STEP_PAST_HIT = 1e-6
"""Relative step behind a hole, so that the next ray does not meet the same triangle again."""
_OFFSET_M = 2e-3
"""Distance of shadow rays' starts from their surface, so that it does not shadow itself."""


class Hits(NamedTuple):
    """First surface that each ray [...] meets."""

    distance: NDArray[np.float32]
    """Distance in multiples of the ray's direction (metres for unit directions), shape [...]; 0 for a miss."""
    instance: NDArray[np.int32]
    """Index into the scene's instances, shape [...]; -1 for a miss."""
    triangle: NDArray[np.int32]
    """Index of the triangle in the instance's mesh, shape [...]; -1 for a miss."""
    barycentric: NDArray[np.float32]
    """Weights of the triangle's second and third vertex, shape [..., 2]."""


class Part:
    """A group of instances as Embree scenes: one of whole triangles, one of triangles with holes (`cutouts`)."""

    def __init__(self, scene: RenderScene, poses: Poses, instances: NDArray[np.intp]) -> None:
        self._surface, self._tables = scene.surface, scene.cutouts
        vertices, faces, scene_faces, counts, first = [], [], [], [], 0
        for index in instances:
            slot = int(scene.instance_mesh[index])
            mesh, matrix = scene.meshes[slot], poses.matrix[index]
            local = poses.vertices.get(slot, mesh.vertices)
            placed = (local @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)
            used = mesh.faces if np.isfinite(placed).all() else mesh.faces[:0]
            vertices.append(placed)
            faces.append((used + first).astype(np.int32))
            scene_faces.append(np.arange(len(used)) + scene.first_face[slot])
            counts.append(len(used))
            first += len(placed)
        self._vertices = np.concatenate([np.zeros((0, 3), np.float32), *vertices])
        self._faces: NDArray[np.int32] = np.concatenate([np.zeros((0, 3), np.int32), *faces])
        self._scene_face = np.concatenate([np.zeros(0, np.int64), *scene_faces])
        self.instance = np.repeat(instances.astype(np.int32), counts)
        cut_out = scene.cut_out_faces[self._scene_face]
        self._whole = int((~cut_out).sum())
        """Number of triangles without holes, which come first."""
        if self._whole < len(cut_out):
            order = np.argsort(cut_out, kind="stable")
            self._faces = self._faces[order]
            self._scene_face, self.instance = self._scene_face[order], self.instance[order]
        self.triangle = (self._scene_face - scene.first_face[scene.instance_mesh[self.instance]]).astype(np.int32)
        self._scene = _embree_scene(self._vertices, self._faces[: self._whole])
        self._cut_scene = _embree_scene(self._vertices, self._faces[self._whole :])

    def cast(self, origins: NDArray, directions: NDArray, limits: NDArray) -> dict[str, NDArray]:
        """Return Embree's result for rays [N, 3] up to ``limits`` [N]; rays pass through holes."""
        hits = _run(self._scene, origins, directions, limits)
        if self._whole == len(self._faces):
            return hits
        rays = np.arange(len(limits))
        start, ahead = origins, np.zeros(len(limits), np.float32)
        while len(rays):
            limit = np.minimum(hits["tfar"][rays], limits[rays])
            behind = _run(self._cut_scene, start, directions[rays], np.maximum(limit - ahead, 0))
            hit = behind["primID"] >= 0
            rays, behind = rays[hit], {name: values[hit] for name, values in behind.items()}
            behind["tfar"] += ahead[hit]
            behind["primID"] += self._whole
            solid = self._solid(behind["primID"], origins[rays], directions[rays])
            for name, values in behind.items():
                hits[name][rays[solid]] = values[solid]
            rays, passed = rays[~solid], behind["tfar"][~solid]
            # scaled with the coordinates, because float32 resolves large ones less finely
            reach = np.abs(origins[rays]).max(1, initial=0) + np.abs(directions[rays]).max(1, initial=0) * passed
            step = _STEP_PAST_HIT * (1 + reach) / np.linalg.norm(directions[rays], axis=1)
            ahead = passed + step.astype(np.float32)
            start = origins[rays] + directions[rays] * ahead[:, None]
        return hits

    def _solid(self, triangles: NDArray[np.int32], origins: NDArray, directions: NDArray) -> NDArray[np.bool_]:
        """Return whether rays meet their triangles outside any hole."""
        # Recomputed in double (Moeller & Trumbore 1997): Embree's float32 barycentrics are too coarse on slivers.
        a, b, c = self._vertices[self._faces[triangles]].astype(np.float64).swapaxes(0, 1)
        ray, start = directions.astype(np.float64), origins - a
        p, q = np.cross(ray, c - a), np.cross(start, b - a)
        area = ((b - a) * p).sum(1, keepdims=True)
        scale = np.divide(1, area, out=np.zeros_like(area), where=area != 0)
        u, v = (start * p).sum(1, keepdims=True) * scale, (ray * q).sum(1, keepdims=True) * scale
        face = self._scene_face[triangles]
        corners = self._surface.uv[self._surface.faces[face]].astype(np.float64)
        corners -= np.floor(corners[:, :1])
        uv = corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])
        return solid_points(self._tables.maps, self._tables.opacity, self._surface.face_textures[face], uv)

    def occluded(self, origins: NDArray, directions: NDArray, limits: NDArray) -> NDArray[np.bool_]:
        """Return whether rays [N, 3] meet any surface up to ``limits`` [N]."""
        return self.cast(origins, directions, limits)["primID"] >= 0


class RayCaster:
    """Ray caster for the triangles of a scene at one moment.

    ``poses`` (from `Renderer.poses`) has transforms and visibility (default: those with which the scene was built);
    ``shown`` [I] overrides the visibility. Building takes about a second per million triangles.
    """

    def __init__(
        self,
        scene: RenderScene,
        poses: Poses | None = None,
        *,
        shown: ArrayLike | None = None,
        parts: Sequence[Part] | None = None,
    ) -> None:
        self.scene = scene
        self.poses = poses or Poses(scene.instance_matrix, {}, np.ones(len(scene.instances), np.bool_))
        mask = self.poses.visible if shown is None else np.asarray(shown, np.bool_)
        self.parts = [Part(scene, self.poses, np.flatnonzero(mask))] if parts is None else list(parts)

    def cast(self, origins: ArrayLike, directions: ArrayLike, *, max_m: ArrayLike = np.inf) -> Hits:
        """Return the first surface that each ray [..., 3] meets, with broadcast arguments; NaN rays always miss.

        ``max_m`` limits the distance, in multiples of the direction's length.
        """
        origins, directions, limits, shape = _rays(origins, directions, max_m)
        nearest = limits.copy()
        instance, triangle = np.full(len(limits), -1, np.int32), np.full(len(limits), -1, np.int32)
        weights = np.zeros((len(limits), 2), np.float32)
        for part in self.parts:
            hits = part.cast(origins, directions, nearest)
            hit = hits["primID"] >= 0
            nearest[hit] = hits["tfar"][hit]
            instance[hit], triangle[hit] = part.instance[hits["primID"][hit]], part.triangle[hits["primID"][hit]]
            weights[hit, 0], weights[hit, 1] = hits["u"][hit], hits["v"][hit]
        distance = np.where(instance >= 0, nearest, np.float32(0))
        return Hits(
            distance.reshape(shape), instance.reshape(shape), triangle.reshape(shape), weights.reshape(*shape, 2)
        )

    def blocked(self, origins: ArrayLike, directions: ArrayLike, *, max_m: ArrayLike = np.inf) -> NDArray[np.bool_]:
        """Return whether rays [..., 3] meet any surface, shape [...]."""
        origins, directions, limits, shape = _rays(origins, directions, max_m)
        hit = np.zeros(len(limits), np.bool_)
        for part in self.parts:
            hit |= part.occluded(origins, directions, limits)
        return hit.reshape(shape)

    def line_of_sight(self, start: ArrayLike, end: ArrayLike, *, margin_m: float = 0.01) -> NDArray[np.bool_]:
        """Return whether segments between points [..., 3] [m] are clear, ignoring surfaces within ``margin_m`` of an end.

        Exclude the bodies at both ends with ``shown`` when building the caster.
        """
        a, b = np.broadcast_arrays(np.asarray(start, np.float64), np.asarray(end, np.float64))
        length = np.linalg.norm(b - a, axis=-1)
        direction = (b - a) / np.maximum(length, 1e-9)[..., None]
        distance = length - 2 * margin_m
        blocked = self.blocked(a + margin_m * direction, direction, max_m=np.maximum(distance, 0.0))
        return ~(blocked & (distance > 0))

    def normals(self, hits: Hits, toward: ArrayLike) -> NDArray[np.float32]:
        """Return unit world normals [..., 3] at hits; 0 for misses.

        They are smooth if the mesh has vertex normals, and are on the side of the surface that faces the direction
        ``toward`` [..., 3].
        """
        out = np.zeros((*hits.instance.shape, 3), np.float32)
        mask = hits.instance >= 0
        view = np.broadcast_to(np.asarray(toward, np.float64), out.shape)[mask]
        index, triangle, bary = hits.instance[mask], hits.triangle[mask], hits.barycentric[mask].astype(np.float64)
        normals = np.zeros((len(index), 3))
        for instance in np.unique(index):
            at = index == instance
            slot, matrix = int(self.scene.instance_mesh[instance]), self.poses.matrix[instance, :, :3]
            mesh = self.scene.meshes[slot]
            corners = mesh.faces[triangle[at]]
            vertices = self.poses.vertices.get(slot, mesh.vertices).astype(np.float64) @ matrix.T
            a, b, c = (vertices[corners[:, k]] for k in range(3))
            flat = np.cross(b - a, c - a)
            flat *= np.where((flat * view[at]).sum(1, keepdims=True) < 0, -1.0, 1.0)
            normals[at] = flat
            if mesh.normals is not None and slot not in self.poses.vertices:
                u, v = bary[at, :1], bary[at, 1:]
                turned = mesh.normals.astype(np.float64) @ np.linalg.pinv(matrix)
                turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
                p, q, r = (turned[corners[:, k]] for k in range(3))
                side = ((p + q + r) * flat).sum(1, keepdims=True)
                smooth = (p + u * (q - p) + v * (r - p)) * np.sign(side)
                normals[at] = np.where(side != 0, smooth, flat)
        out[mask] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        return out

    def sunlight(self, points: NDArray, normals: NDArray, light: Light) -> NDArray[np.float32]:
        """Return the share of the sun's disc, shape [H, W], visible from points [H, W, 3] with unit normals [H, W, 3].

        Casts ``light.shadow_rays`` rays per pixel, spread over the disc (Vogel's spiral) and rotated from pixel to pixel.
        """
        sun = normalized(np.array(light.sun_direction, np.float64))
        side = normalized(np.cross(sun, (0.0, 0.0, 1.0) if abs(sun[2]) < 0.9 else (1.0, 0.0, 0.0)))
        across = np.stack([side, np.cross(sun, side)])
        radius = np.tan(np.radians(light.sun_size_deg) / 2)
        y, x = np.mgrid[0 : points.shape[0], 0 : points.shape[1]]
        turn = 2 * np.pi * np.modf(52.9829189 * np.modf(0.06711056 * x + 0.00583715 * y)[0])[0]  # noise of Jimenez 2014
        start = points + (normals + sun) * _OFFSET_M
        facing = normals @ sun > 0
        unblocked = np.zeros(points.shape[:2], np.float32)
        for k in range(light.shadow_rays):
            angle, length = turn + k * np.pi * (3 - np.sqrt(5)), radius * np.sqrt((k + 0.5) / light.shadow_rays)
            offset = np.stack([np.cos(angle), np.sin(angle)], -1) * length
            unblocked += ~self.blocked(np.where(facing[..., None], start, np.nan), sun + offset @ across)
        return unblocked / np.float32(light.shadow_rays)


class LidarScan(NamedTuple):
    """Result of one revolution of a lidar."""

    distance: NDArray[np.float32]
    """Distance [m], shape [L, C]; 0 if no surface is within range."""
    instance: NDArray[np.int32]
    """Index into the scene's instances, shape [L, C]; -1 for a miss."""
    points: NDArray[np.float64]
    """Hit points in the world [m], shape [L, C, 3]; NaN for a miss."""


def lidar(
    caster: RayCaster, pose: ArrayLike, *, elevations_deg: ArrayLike = (0.0,), columns: int = 360, max_m: float = 30.0
) -> LidarScan:
    """Measure one revolution of a lidar with L lasers.

    Args:
        caster: Ray caster of the scene.
        pose: 4x4 matrix from the sensor frame (x forward, y up, z right) to the world.
        elevations_deg: Elevation of each laser above the horizon, shape [L].
        columns: Number of directions per laser; column 0 looks forward, the others follow to the left.
        max_m: Range [m].
    """
    matrix, elevation = np.asarray(pose, np.float64), np.radians(np.atleast_1d(np.asarray(elevations_deg, np.float64)))
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or columns < 1:
        raise InputError(
            f"A lidar needs a finite 4x4 pose and at least one column, got {matrix.tolist()}, {columns}.",
            code="H3-RENDER-051",
        )
    angle = np.arange(columns) * (2 * np.pi / columns)
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), columns))
    directions = np.stack([flat * np.cos(angle), up, -flat * np.sin(angle)], -1) @ matrix[:3, :3].T
    hits = caster.cast(matrix[:3, 3], directions, max_m=max_m)
    points = matrix[:3, 3] + directions * np.where(hits.instance >= 0, hits.distance, np.nan)[..., None]
    return LidarScan(hits.distance, hits.instance, points)


class LidarScanner:
    """Lidar scanner for a scene in which most instances never move."""

    def __init__(self, scene: RenderScene, poses: Poses, still: NDArray[np.bool_]) -> None:
        """Prepare the static instances, marked in ``still`` [I], once for all scans."""
        self._scene, self._still = scene, Part(scene, poses, np.flatnonzero(still))

    def scan(
        self, poses: Poses, shown: NDArray[np.bool_], pose: ArrayLike, *, max_m: float, **options: Any
    ) -> NDArray[np.float32]:
        """Return distances [L, C] [m]; they equal the scanner's range if nothing is nearer.

        Static instances are always included, and others if they are ``shown``.

        Args:
            poses: Poses of all instances.
            shown: Mask of the moving instances that are visible, shape [I].
            pose: Pose of the lidar as for `lidar`.
            max_m: Range [m].
            options: Other options of `lidar`.
        """
        parts = [self._still, Part(self._scene, poses, np.flatnonzero(shown))]
        found = lidar(RayCaster(self._scene, poses, parts=parts), pose, max_m=max_m, **options)
        return np.where(found.instance >= 0, found.distance, np.float32(max_m))


def _rays(
    origins: ArrayLike, directions: ArrayLike, max_m: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], tuple[int, ...]]:
    """Return origins [N, 3], directions [N, 3] and limits [N] for Embree, and the shape; NaN rays have limit 0."""
    o, d = np.broadcast_arrays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))
    if o.ndim == 0 or o.shape[-1] != 3:
        raise InputError(
            f"Expected rays [..., 3], got origins {list(np.shape(origins))}, directions {list(np.shape(directions))}.",
            code="H3-RENDER-052",
        )
    shape = o.shape[:-1]
    limit = np.broadcast_to(np.asarray(max_m, np.float64), shape).reshape(-1)
    o, d = o.reshape(-1, 3), d.reshape(-1, 3)
    valid = np.isfinite(o).all(1) & np.isfinite(d).all(1) & d.any(1) & (limit > 0)
    o, d = np.where(valid[:, None], o, 0.0), np.where(valid[:, None], d, (0.0, 0.0, 1.0))
    limits = np.where(valid, np.minimum(limit, _FAR_M), 0.0)
    return np.ascontiguousarray(o, np.float32), np.ascontiguousarray(d, np.float32), limits.astype(np.float32), shape


def _embree_scene(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> Any:
    embree = _embree()
    scene = embree.rtcore_scene.EmbreeScene(robust=True)
    if len(faces):
        embree.mesh_construction.TriangleMesh(scene, vertices, faces)
    return scene


def _run(scene: Any, origins: NDArray, directions: NDArray, limits: NDArray) -> dict[str, NDArray]:
    # Embree overwrites the limits
    return scene.run(origins, directions, dists=limits.copy(), query="INTERSECT", output=1)


def _embree() -> Any:
    try:
        import embreex
        import embreex.mesh_construction
        import embreex.rtcore_scene
    except ImportError as error:
        raise MissingExtraError(
            "Fisheye and equirectangular depth, lidar, line of sight and shadows need Embree. "
            "Hint: pip install 'h3data[rays]'",
            code="H3-RENDER-053",
        ) from error
    return embreex


@kernel()
def solid_points(maps, opacity, textures, uv):
    """Return whether textures [N] are at least half opaque (`is_solid`) at points ``uv`` [N, 2], shape [N]."""
    out = np.ones(len(textures), np.bool_)
    for k in range(len(textures)):
        out[k] = is_solid(maps, opacity, textures[k], uv[k, 0], uv[k, 1])
    return out
