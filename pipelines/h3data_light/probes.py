"""Indirect light: probes on a grid collect the light that surfaces reflect, along six directions (ambient cubes).

The method follows "Dynamic Diffuse Global Illumination with Ray-Traced Irradiance Fields" (Majercik et al. 2019), with
the visibility of each probe from each point: light does not leak through walls. Positions are in voxels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data_light.direct import MARKED, SUN, WINDOW, direct_light, sky_radiance
from h3data_light.voxels import GLASS, PROBE_VOXELS, march, sees

RAYS = (96, 64)
"""Number of rays of a probe for the first bounce of light and for the second."""
_USEFUL = PROBE_VOXELS + 2
"""Distance from all surfaces [voxels] beyond which probes light nothing."""
_FAINT = 0.02
"""Irradiance below which a window or lamp is left out."""
_ROTATIONS = 8
"""Number of rotations of the rays of probes, which differ between neighbours; `_blur` averages them."""


class Probes(NamedTuple):
    """Probes of indirect light, one for each block of voxels."""

    reach: NDArray[np.uint64]
    """Bits of the windows and lamps that can reach a block, shape [X', Y', Z', 2] (`direct.MARKED`)."""
    place: NDArray[np.float32]
    """Position of each probe within its block, away from surfaces, shape [X', Y', Z', 3] [voxels]."""
    usable: NDArray[np.bool_]
    """True if the block contains air and a surface is near, shape [X', Y', Z']."""
    light: NDArray[np.float32]
    """Irradiance on surfaces that face -x, +x, -y, +y, -z, +z, shape [X', Y', Z', 6, 3]."""


def ray_directions(rays: int) -> NDArray[np.float32]:
    """Return spherical Fibonacci directions in several rotations about y, shape [8, rays, 3]."""
    k = np.arange(rays) + 0.5
    y = 1 - 2 * k / rays
    angle = k * np.pi * (3 - np.sqrt(5)) + np.arange(_ROTATIONS)[:, None] * (2 * np.pi * 0.61803399 * 1.37)
    y = y + ((np.arange(_ROTATIONS)[:, None] + 0.5) / _ROTATIONS - 0.5) * 2 / rays
    radius = np.sqrt(np.maximum(1 - y * y, 0))
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=-1).astype(np.float32)


@kernel(error_model="numpy", boundscheck=False)
def find_faces(distance, count, points, normals, indoors):
    """Choose up to two surface points on each face of every block, and return their number.

    They lie on surface voxels of the block whose neighbour in one of six directions is free.

    The function fills ``count`` [X', Y', Z', 6] with the number of points on each face. For each point it fills its
    position in the free voxel [N, 3], its normal [N, 3], and whether something is above it [N]. The points of a block
    are consecutive, in the order of blocks.
    """
    places = 0
    n = PROBE_VOXELS
    for bx in range(count.shape[0]):
        for by in range(count.shape[1]):
            for bz in range(count.shape[2]):
                for face in range(6):
                    side = -1 if face % 2 == 0 else 1
                    sx, sy, sz = side * (face // 2 == 0), side * (face // 2 == 1), side * (face // 2 == 2)
                    total = 0
                    for visit in range(2):  # counts first, then takes those at a quarter and at three quarters
                        seen, used = 0, 0
                        for v in range(n**3):
                            i, j, k = bx * n + v // n**2, by * n + v // n % n, bz * n + v % n
                            if distance[i, j, k] != 0:
                                continue
                            x, y, z = i + sx, j + sy, k + sz
                            if x < 0 or y < 0 or z < 0 or x >= distance.shape[0] or y >= distance.shape[1]:
                                continue
                            if z >= distance.shape[2] or distance[x, y, z] == 0 or distance[x, y, z] == GLASS:
                                continue
                            if visit == 1 and used < 2 and seen == (2 * used + 1) * total // 4:
                                used += 1
                                points[places, 0], points[places, 1], points[places, 2] = x + 0.5, y + 0.5, z + 0.5
                                normals[places, 0], normals[places, 1], normals[places, 2] = sx, sy, sz
                                for h in range(y, distance.shape[1]):
                                    indoors[places] |= distance[x, h, z] == 0
                                places += 1
                            seen += 1
                        total = seen
                        if total == 0 or places + 2 > len(points):
                            break
                    count[bx, by, bz, face] = total
    return places


@kernel(error_model="numpy", boundscheck=False)
def place_probes(distance, place, usable):
    """Place each probe in the middle of its block, or at the block's widest free point if that is obstructed."""
    n = PROBE_VOXELS
    for bx in range(usable.shape[0]):
        for by in range(usable.shape[1]):
            for bz in range(usable.shape[2]):
                i, j, k = bx * n + n // 2, by * n + n // 2, bz * n + n // 2
                best = distance[i, j, k] if distance[i, j, k] != GLASS else 0
                if best < 2:
                    for v in range(n**3):
                        x, y, z = bx * n + v // n**2, by * n + v // n % n, bz * n + v % n
                        d = distance[x, y, z]
                        if d != GLASS and d > best:
                            best, i, j, k = d, x, y, z
                usable[bx, by, bz] = 0 < best <= _USEFUL
                place[bx, by, bz, 0], place[bx, by, bz, 1], place[bx, by, bz, 2] = i + 0.5, j + 0.5, k + 0.5


@kernel(error_model="numpy", boundscheck=False)
def find_reach(distance, place, usable, emitters, reach):
    """Set the bits ``reach`` [X', Y', Z', 2] of the first `direct.MARKED` windows and lamps that each probe sees."""
    for bx in range(usable.shape[0]):
        for by in range(usable.shape[1]):
            for bz in range(usable.shape[2]):
                if not usable[bx, by, bz]:
                    continue
                x, y, z = place[bx, by, bz, 0], place[bx, by, bz, 1], place[bx, by, bz, 2]
                for e in range(min(len(emitters), MARKED)):
                    row = emitters[e]
                    if row[0] == SUN:
                        break
                    brightest = 2.0 if row[0] == WINDOW else max(row[14], row[15], row[16])
                    for p in range(5 if row[0] == WINDOW else 1):
                        a, b = (0.0 if p == 0 else 0.8 * (1 - 2 * (p & 1))), (0.0 if p == 0 else 0.8 * (1 - (p & 2)))
                        tx = row[1] + a * row[4] + b * row[7] + 1.6 * row[10]
                        ty = row[2] + a * row[5] + b * row[8] + 1.6 * row[11]
                        tz = row[3] + a * row[6] + b * row[9] + 1.6 * row[12]
                        far2 = (tx - x) ** 2 + (ty - y) ** 2 + (tz - z) ** 2
                        if row[13] * brightest >= _FAINT * far2 and sees(distance, x, y, z, tx, ty, tz):
                            reach[bx, by, bz, e >> 6] |= np.uint64(1) << np.uint64(e & 63)
                            break


@kernel(error_model="numpy", boundscheck=False)
def gather(distance, albedo, face_light, before, place, usable, directions, after):
    """Fill ``after`` [X', Y', Z', 6, 3] with the light that reaches each probe from surfaces and from outdoors.

    Surfaces reflect ``face_light`` and ``before``, the light of the previous bounce.
    """
    rays = directions.shape[1]
    cube = np.empty((6, 3), np.float32)
    for bx in range(usable.shape[0]):
        for by in range(usable.shape[1]):
            for bz in range(usable.shape[2]):
                if not usable[bx, by, bz]:
                    continue
                for face in range(6):
                    cube[face, 0] = cube[face, 1] = cube[face, 2] = 0.0
                rotation = (bx & 1) * 4 + (by & 1) * 2 + (bz & 1)
                x, y, z = place[bx, by, bz, 0], place[bx, by, bz, 1], place[bx, by, bz, 2]
                for r in range(rays):
                    dx, dy, dz = directions[rotation, r, 0], directions[rotation, r, 1], directions[rotation, r, 2]
                    largest = max(abs(dx), abs(dy), abs(dz))
                    kind, i, j, k, u, v, w = march(
                        distance, x, y, z, dx / largest, dy / largest, dz / largest, np.float32(1e6), False
                    )
                    if kind == 2:
                        continue
                    if kind == 0:
                        red, green, blue = sky_radiance(dy)
                    else:
                        face = _face(i - u, j - v, k - w, dx, dy, dz)
                        c, d, e = u // PROBE_VOXELS, v // PROBE_VOXELS, w // PROBE_VOXELS
                        p, q, s = i // PROBE_VOXELS, j // PROBE_VOXELS, k // PROBE_VOXELS
                        axis = face // 2
                        own, earlier, tint = face_light[c, d, e, face], before[p, q, s, face], albedo[c, d, e, axis]
                        red = tint[0] * (own[0] + earlier[0]) / np.pi
                        green = tint[1] * (own[1] + earlier[1]) / np.pi
                        blue = tint[2] * (own[2] + earlier[2]) / np.pi
                    for axis in range(3):
                        component = dx if axis == 0 else dy if axis == 1 else dz
                        face = 2 * axis + (component > 0)
                        cube[face, 0] += abs(component) * red
                        cube[face, 1] += abs(component) * green
                        cube[face, 2] += abs(component) * blue
                for face in range(6):
                    for a in range(3):
                        after[bx, by, bz, face, a] = cube[face, a] * (4 * np.pi / rays)


@kernel_part()
def _face(ax, ay, az, dx, dy, dz):
    """Return the face of a voxel through which a ray came, from the step to the free voxel before it."""
    wx, wy, wz = abs(dx) * (ax != 0), abs(dy) * (ay != 0), abs(dz) * (az != 0)
    if wx == 0 and wy == 0 and wz == 0:
        wx, wy, wz = abs(dx), abs(dy), abs(dz)
    if wx >= wy and wx >= wz:
        return 0 if dx > 0 else 1
    if wy >= wz:
        return 2 if dy > 0 else 3
    return 4 if dz > 0 else 5


@kernel(error_model="numpy", boundscheck=False)
def blur(distance, place, usable, light, out, axis):
    """Average probes with their visible neighbours along an axis, with the weights 1, 2, 1."""
    shape = usable.shape
    ax, ay, az = int(axis == 0), int(axis == 1), int(axis == 2)
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                weight = 2.0
                for f in range(6):
                    for a in range(3):
                        out[x, y, z, f, a] = 2 * light[x, y, z, f, a]
                if not usable[x, y, z]:
                    continue
                for sign in (-1, 1):
                    u, v, w = x + sign * ax, y + sign * ay, z + sign * az
                    if u < 0 or v < 0 or w < 0 or u >= shape[0] or v >= shape[1] or w >= shape[2]:
                        continue
                    if not usable[u, v, w]:
                        continue
                    if not sees(
                        distance,
                        place[x, y, z, 0],
                        place[x, y, z, 1],
                        place[x, y, z, 2],
                        place[u, v, w, 0],
                        place[u, v, w, 1],
                        place[u, v, w, 2],
                    ):
                        continue
                    weight += 1
                    for f in range(6):
                        for a in range(3):
                            out[x, y, z, f, a] += light[u, v, w, f, a]
                for f in range(6):
                    for a in range(3):
                        out[x, y, z, f, a] /= weight


@kernel(error_model="numpy", boundscheck=False)
def light_points(distance, points, normals, inward, emitters, side, reach, place, usable, light, out):
    """Fill the irradiance ``out`` [N, 3] at surface points [N, 3] with unit normals.

    The irradiance is NaN where a point lies inside other surfaces or sees no probe.

    ``side`` is the number of rays along each side of a window. Without probes (0 blocks), the result is the direct
    light alone. Points are lifted off their surface by more than a voxel. Points at a corner then still lie in the
    other surface, so they are also moved ``inward`` [N, 3], towards the middle of their own faces, by little more than
    a voxel.
    """
    shape = usable.shape
    for n in range(len(points)):
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        found = False
        x, y, z = np.float32(0), np.float32(0), np.float32(0)
        for attempt in range(6):
            up = np.float32(1.25 if attempt < 3 else 2.3)
            along = np.float32(attempt % 3) * np.float32(0.6)
            x = points[n, 0] + up * nx + along * inward[n, 0]
            y = points[n, 1] + up * ny + along * inward[n, 1]
            z = points[n, 2] + up * nz + along * inward[n, 2]
            if x < 0 or y < 0 or z < 0 or x >= distance.shape[0] or y >= distance.shape[1] or z >= distance.shape[2]:
                continue
            if distance[int(x), int(y), int(z)] > 0:
                found = True
                break
        if not found:
            out[n, 0], out[n, 1], out[n, 2] = np.nan, np.nan, np.nan
            continue
        bx, by, bz = int(x) // PROBE_VOXELS, int(y) // PROBE_VOXELS, int(z) // PROBE_VOXELS
        red, green, blue = direct_light(
            distance, x, y, z, nx, ny, nz, emitters, reach[bx, by, bz, 0], reach[bx, by, bz, 1], side
        )
        if usable.size == 0:
            out[n, 0], out[n, 1], out[n, 2] = red, green, blue
            continue
        qx, qy, qz = x / PROBE_VOXELS - 0.5, y / PROBE_VOXELS - 0.5, z / PROBE_VOXELS - 0.5
        qx, qy, qz = qx + 0.25 * nx, qy + 0.25 * ny, qz + 0.25 * nz
        bx, by, bz = int(np.floor(qx)), int(np.floor(qy)), int(np.floor(qz))
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        for corner in range(8):
            ox, oy, oz = corner >> 2, (corner >> 1) & 1, corner & 1
            u, v, w = bx + ox, by + oy, bz + oz
            if u < 0 or v < 0 or w < 0 or u >= shape[0] or v >= shape[1] or w >= shape[2] or not usable[u, v, w]:
                continue
            weight = abs(1 - ox - (qx - bx)) * abs(1 - oy - (qy - by)) * abs(1 - oz - (qz - bz)) + 1e-3
            px, py, pz = place[u, v, w, 0], place[u, v, w, 1], place[u, v, w, 2]
            dx, dy, dz = px - x, py - y, pz - z
            length = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-3)
            front = 0.5 + 0.5 * (dx * nx + dy * ny + dz * nz) / length
            weight *= front * front + 0.05
            if not sees(distance, x, y, z, px, py, pz):
                continue
            total += weight
            fx, fy, fz = 0 + (nx > 0), 2 + (ny > 0), 4 + (nz > 0)
            wx, wy, wz = weight * nx * nx, weight * ny * ny, weight * nz * nz
            r += wx * light[u, v, w, fx, 0] + wy * light[u, v, w, fy, 0] + wz * light[u, v, w, fz, 0]
            g += wx * light[u, v, w, fx, 1] + wy * light[u, v, w, fy, 1] + wz * light[u, v, w, fz, 1]
            b += wx * light[u, v, w, fx, 2] + wy * light[u, v, w, fy, 2] + wz * light[u, v, w, fz, 2]
        if total == 0:
            out[n, 0], out[n, 1], out[n, 2] = np.nan, np.nan, np.nan
            continue
        out[n, 0], out[n, 1], out[n, 2] = red + r / total, green + g / total, blue + b / total
