"""Light field of a home: the direction and amount of light at any point, for moving objects and their shadows.

It stores irradiance along six directions (an ambient cube) on a grid of half a metre, with interpolation between grid
points. The difference of opposite sides is the light vector (Gershun 1936), the integral of radiance times direction.
It points to where most light comes from, and its length divided by the sum of all light is the share of directed light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.kernels import kernel
from h3data.render.shade.blockers import Blockers, blocker_rows
from h3data.render.shade.blockers_simd import SPREAD
from h3data_light import probes as pr
from h3data_light.exposure import shown_light
from h3data_light.voxels import GLASS, Voxels

SPACING_VOXELS = 10
"""Number of voxels between two points of the light field's grid."""
_RAYS = 64
_FARTHEST_M = 4.0
"""Greatest distance that shadows reach [m]."""
MOST = 0.85
"""Largest share of the light that comes from one direction; the rest comes from sky and walls."""
FROM_DISC = float(0.5 * (1 + 1 / np.sqrt(1 + SPREAD**2)))
"""Ratio of the light vector of a disc of light to its light: (1 + cos a) / 2 for its angular radius a."""
_UPWARD, _ABOVE_M = 0.9, 0.4
"""Least upward component of the normals of floors, and height above them of the light that they mirror."""
_INDOORS = 0.2
"""Share of points under cover above which those in the open do not count."""
FACE_NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], np.float64)


@dataclass(frozen=True, eq=False)
class LightAt:
    """Light at N points of a light field."""

    direction: NDArray[np.float64]
    """Unit vector towards where most light comes from, shape [N, 3]; up where there is no light."""
    share: NDArray[np.float64]
    """Share of the light that comes from ``direction``, 0..1, shape [N]."""
    reach_m: NDArray[np.float64]
    """Distance to the first wall or floor in the opposite direction, shape [N] [m]."""
    irradiance: NDArray[np.float64]
    """Linear RGB irradiance, the mean over all directions, shape [N, 3]."""


@dataclass(frozen=True, eq=False)
class LightField:
    """Light field as a grid of arrays, which is stored with the baked light (`store`)."""

    origin: NDArray[np.float64]
    """World position of the grid's corner, shape [3] [m]."""
    spacing_m: float
    cube: NDArray[np.float32]
    """Irradiance on surfaces that face -x, +x, -y, +y, -z, +z, shape [X, Y, Z, 6, 3]; NaN within walls."""
    reach_m: NDArray[np.float32]
    """Value of `LightAt.reach_m` at the grid points, shape [X, Y, Z] [m]."""
    mean: float
    """Mean irradiance of the home's surfaces."""
    flat: NDArray[np.float64]
    """Mean of the flat light over all directions, linear RGB, shape [3]."""

    def cubes(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the irradiance [N, 6, 3] at world points [N, 3] [m] on surfaces that face -x, +x, -y, +y, -z, +z."""
        return self._interpolated(np.asarray(points, np.float64))[0]

    def at(self, points: NDArray[np.floating]) -> LightAt:
        """Return the light at world points [N, 3] [m]."""
        cube, reach = self._interpolated(np.asarray(points, np.float64).reshape(-1, 3))
        bright = cube.mean(-1)
        vector = bright[:, 1::2] - bright[:, 0::2]
        length = np.linalg.norm(vector, axis=1)
        everywhere = bright.sum(1) / 1.5  # |x| + |y| + |z| is 1.5 on the mean over all directions
        lit = (length > 1e-6) & (everywhere > 1e-6)
        direction = np.where(lit[:, None], vector / np.maximum(length, 1e-9)[:, None], [0.0, 1.0, 0.0])
        share = np.where(lit, length / np.maximum(everywhere, 1e-9) / FROM_DISC, 0.0)
        return LightAt(direction, np.minimum(share, MOST), reach, cube.mean(1))

    def _interpolated(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return cubes [N, 6, 3] and reaches [N], from the grid points around each point that are in the open."""
        cube, reach = np.empty((len(points), 6, 3)), np.empty(len(points))
        _interpolate(
            np.nan_to_num(points), self.origin, self.spacing_m, self.cube, self.reach_m, self.mean, cube, reach
        )
        return cube, reach

    def blockers(
        self,
        capsules: NDArray[np.floating],
        groups: NDArray[np.integer],
        *,
        members: NDArray[np.integer],
    ) -> Blockers:
        """Return the light that capsules [N, 7] (both ends and radius) block, and the light on their groups.

        Args:
            capsules: Capsules of all moving objects in the world [m]; rows with NaN are ignored.
            groups: Group index of each capsule, from 0 [N]; a person, robot or object is one group with one light
                direction.
            members: Group index of every instance of the scene, or -1 for static ones, shape [I].
        """
        c = np.asarray(capsules, np.float64).reshape(-1, 7)
        groups = np.asarray(groups, np.int64).reshape(-1)
        known = np.isfinite(c).all(1)
        c, groups = c[known], groups[known]
        middle = (c[:, :3] + c[:, 3:6]) / 2
        which, index = np.unique(groups, return_inverse=True)
        centers = group_means(middle, index, len(which))
        light = self.at(np.concatenate([centers, middle]))
        reach = light.reach_m[len(which) :]
        rows = blocker_rows(c, groups, light.direction[index], light.share[index], reach)
        tints = np.ones((len(members), 4), np.float32)
        tints[:, 3] = members
        own_tint = np.ones((max(int(members.max(initial=-1)), int(which.max(initial=-1))) + 1, 3))
        own_tint[which] = shown_light(light.irradiance[: len(which)], self.mean) / self.flat
        tints[members >= 0, :3] = own_tint[members[members >= 0]]
        return Blockers(rows, tints)


@kernel(error_model="numpy", boundscheck=False)
def _interpolate(points, origin, spacing_m, cube, reach_m, mean, cube_at, reach_at):
    """Fill ``cube_at`` [N, 6, 3] and ``reach_at`` [N] at points [N, 3], as `LightField._interpolated` returns them.

    A kernel, as a renderer asks at every step for some tens of points, for which arrays cost more than the arithmetic.
    """
    corners, low, part = np.empty((8, 4), np.int64), np.empty(3, np.int64), np.empty(3)
    weight, shape = np.empty(8), reach_m.shape
    for n in range(len(points)):
        for a in range(3):
            place = (points[n, a] - origin[a]) / spacing_m - 0.5
            place = min(max(place, 0.0), float(max(shape[a] - 1, 0)))
            low[a] = min(int(place), max(shape[a] - 2, 0))
            part[a] = place - low[a]
        total = 0.0
        for c in range(8):
            share = 1.0
            for a in range(3):
                far = c >> (2 - a) & 1
                corners[c, a] = min(low[a] + far, shape[a] - 1)
                share *= part[a] if far else 1 - part[a]
            corners[c, 3] = np.isfinite(cube[corners[c, 0], corners[c, 1], corners[c, 2], 0, 0])
            weight[c] = (share + 1e-4) * corners[c, 3]
            total += weight[c]
        cube_at[n], reach_at[n] = (0.0, 0.0) if total > 0 else (mean, 1.0)
        for c in range(8 if total > 0 else 0):
            x, y, z, free = corners[c]
            reach_at[n] += weight[c] / total * reach_m[x, y, z]
            for face in range(6 if free else 0):
                for k in range(3):
                    cube_at[n, face, k] += weight[c] / total * cube[x, y, z, face, k]


def group_means(values: NDArray[np.float64], index: NDArray[np.integer], count: int) -> NDArray[np.float64]:
    """Return the mean of the rows [N, K] of each group, shape [count, K]; 0 for groups without rows."""
    number = np.maximum(np.bincount(index, minlength=count), 1)
    return np.column_stack([np.bincount(index, column, count) / number for column in values.T])


def light_field(
    voxels: Voxels,
    face_light: NDArray[np.float32],
    probes: pr.Probes,
    emitters: NDArray[np.float32],
    mean: float,
    flat: NDArray[np.float64],
) -> LightField:
    """Return the light field of a home from the reflected light of its surfaces, ``face_light``, and from ``probes``."""
    distance, n = voxels.distance, SPACING_VOXELS
    place, usable = _places(distance)
    cube = np.zeros((*usable.shape, 6, 3), np.float32)
    pr.gather(distance, voxels.albedo, face_light, probes.light, place, usable, pr.ray_directions(_RAYS), cube)
    points = np.repeat(place[usable], 6, axis=0)
    normals = np.tile(FACE_NORMALS, (int(usable.sum()), 1)).astype(np.float32)
    direct = np.zeros((len(points), 3), np.float32)
    none = np.zeros((0, 0, 0), np.bool_), np.zeros((0, 0, 0, 6, 3), np.float32)
    pr.light_points(
        distance,
        points - 1.25 * normals,
        normals,
        np.zeros_like(points),
        emitters,
        3,
        probes.reach,
        np.zeros((0, 0, 0, 3), np.float32),
        *none,
        direct,
    )
    cube[usable] += np.nan_to_num(direct).reshape(-1, 6, 3)
    cube[~usable] = np.nan
    bright = cube[usable].mean(-1)
    away = -normalized(bright[:, 1::2] - bright[:, 0::2] + np.array([0, 1e-9, 0]))
    reach = np.zeros(usable.shape, np.float32)
    reach[usable] = voxels.cell_m * free_path(
        distance, place[usable].astype(np.float64), away.astype(np.float64), _FARTHEST_M / voxels.cell_m
    )
    return LightField(voxels.origin, n * voxels.cell_m, cube, reach, mean, flat)


def mirrored(field: LightField, world: NDArray[np.floating], irradiance: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the light that vertices of a glossy floor reflect from -x, +x, +y, -z and +z, shape [V, 5].

    The values are 0 on the sides of the floor.

    Args:
        field: Light field around the floor.
        world: Positions and unit normals, shape [V, 6].
        irradiance: Irradiance of the vertices [V, 3]; where it is low, such as under a table, less light is reflected.
    """
    out = np.zeros((len(world), 5), np.float32)
    up = np.flatnonzero(world[:, 4] > _UPWARD)
    cubes = field.cubes(world[up, :3] + [0, _ABOVE_M, 0])
    own, open_floor = (shown_light(light, field.mean).mean(1) for light in (irradiance[up], cubes[:, 3]))
    open_share = np.clip(own / np.maximum(open_floor, 1e-6), 0, 1)
    for column, side in enumerate((0, 1, 3, 4, 5)):
        out[up, column] = open_share * shown_light(cubes[:, side], field.mean).mean(1)
    return out


def _places(distance: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return a point of each block of the grid in voxels, its middle or where it is widest, [X, Y, Z, 3].

    The second array says whether the point is free.
    """
    n = SPACING_VOXELS
    blocks = [-(-s // n) for s in distance.shape]
    free = np.where(distance == GLASS, 0, distance)
    free = np.pad(free, [(0, b * n - s) for b, s in zip(blocks, distance.shape, strict=True)])
    split = free.reshape(blocks[0], n, blocks[1], n, blocks[2], n).transpose(0, 2, 4, 1, 3, 5).reshape(*blocks, n**3)
    widest, middle = split.argmax(-1), (n // 2) * (n * n + n + 1)
    chosen = np.where(split[..., middle] >= 2, middle, widest)
    within = np.stack([chosen // n**2, chosen // n % n, chosen % n], axis=-1)
    corner = np.stack(np.meshgrid(*(np.arange(b) * n for b in blocks), indexing="ij"), axis=-1)
    usable = np.take_along_axis(split, chosen[..., None], -1)[..., 0] > 0
    at = corner + within
    x, y, z = np.minimum(at, np.array(distance.shape) - 1).reshape(-1, 3).T
    below = np.maximum.accumulate((distance == 0)[:, ::-1], axis=1)[:, ::-1]
    covered = usable & below[x, y, z].reshape(usable.shape)
    if covered.sum() > _INDOORS * usable.sum():  # the light outdoors would come through the walls
        usable = covered
    return (at + 0.5).astype(np.float32), usable


def free_path(
    distance: NDArray[np.uint8], start: NDArray[np.float64], direction: NDArray[np.float64], longest: float
) -> NDArray[np.float64]:
    """Return the length of rays [N, 3] through free voxels, up to ``longest``, shape [N] [voxels]."""
    t = np.zeros(len(start))
    going = np.ones(len(start), np.bool_)
    size = np.array(distance.shape)
    for _ in range(int(4 * longest)):
        k = np.flatnonzero(going)
        if not len(k):
            break
        at = start[k] + t[k, None] * direction[k]
        inside = ((at >= 0) & (at < size)).all(1)
        x, y, z = np.clip(at, 0, size - 1).astype(int).T
        room = distance[x, y, z].astype(np.float64)
        room[room == GLASS] = 0
        going[k] = inside & (room > 0) & (t[k] < longest)
        t[k] += np.where(going[k], np.maximum(room - 1, 0.5), 0)
    return np.minimum(t, longest)
