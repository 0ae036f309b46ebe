"""Direct light at a point from windows, lamps and the sun; positions are in voxels."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel_part
from h3data_light.voxels import march

EMITTER_WORDS = 17
"""Number of values of an emitter: kind, centre, two half sides, normal into the room, power, linear colour.

For a window, power is its area and the colour is that of the sky. For a lamp, the half sides are its radius. For a sun,
the centre is the direction towards it and the half sides are its size.
"""
WINDOW, LAMP, SUN = 0, 1, 2
LAMP_RADIUS = 2.0
SUN_SPREAD = 0.045
"""Tangent of the sun's angular radius; it is larger than in reality because the spacing of vertices blurs shadow edges."""
MARKED = 128
"""Number of bits in `Probes.reach`: one for each of the first light sources, windows and lamps before suns."""
SKY = (2.2, 2.6, 3.0)
HORIZON = (2.6, 2.6, 2.6)
GROUND = (0.9, 0.85, 0.75)
"""Radiance of the outdoors: the sky above, the horizon, and the ground."""


@kernel_part()
def sky_radiance(up):
    """Return the outdoor radiance in a direction with upward component ``up``."""
    if up < 0:
        w = min(-up * 4.0, 1.0)
        return (
            HORIZON[0] + (GROUND[0] - HORIZON[0]) * w,
            HORIZON[1] + (GROUND[1] - HORIZON[1]) * w,
            HORIZON[2] + (GROUND[2] - HORIZON[2]) * w,
        )
    return (
        HORIZON[0] + (SKY[0] - HORIZON[0]) * up,
        HORIZON[1] + (SKY[1] - HORIZON[1]) * up,
        HORIZON[2] + (SKY[2] - HORIZON[2]) * up,
    )


@kernel_part()
def direct_light(distance, x, y, z, nx, ny, nz, emitters, low_bits, high_bits, side):
    """Return the irradiance (r, g, b) of a surface point.

    The bits select the emitters that can reach the point. ``side`` is the largest number of rays along each side of a
    window. All kinds of light share one call of `march`, because each call takes a second to compile.
    """
    red, green, blue = 0.0, 0.0, 0.0
    for e in range(len(emitters)):
        row = emitters[e]
        kind = row[0]
        if kind != SUN and e < MARKED:
            bits = low_bits if e < 64 else high_bits
            if not (bits >> np.uint64(e & 63)) & np.uint64(1):
                continue
        rays = 2
        if kind == SUN:
            if row[1] * nx + row[2] * ny + row[3] * nz <= 0:
                continue
        elif kind == WINDOW:
            cx, cy, cz = row[1] - x, row[2] - y, row[3] - z
            if cx * row[10] + cy * row[11] + cz * row[12] > -1.7:
                continue  # outside the room or in the plane of the points on the pane
            angle = row[13] / (cx * cx + cy * cy + cz * cz)
            rays = side if angle > 0.12 else min(side, 3) if angle > 0.03 else 2
        r, g, b, lit, whole = 0.0, 0.0, 0.0, 0, rays * rays
        k = 0
        while k < whole:
            p, q = (2 * (k // rays) + 1) / rays - 1, (2 * (k % rays) + 1) / rays - 1
            dx = row[1] + p * row[4] + q * row[7] + 1.6 * row[10]
            dy = row[2] + p * row[5] + q * row[8] + 1.6 * row[11]
            dz = row[3] + p * row[6] + q * row[9] + 1.6 * row[12]
            closest = 9.0 if kind == WINDOW else 16.0
            if kind != SUN:
                dx, dy, dz = dx - x, dy - y, dz - z
            d2 = dx * dx + dy * dy + dz * dz
            length = np.sqrt(d2)
            share = (dx * nx + dy * ny + dz * nz) / (length * whole)
            if kind == WINDOW:
                share *= -(dx * row[10] + dy * row[11] + dz * row[12]) / length
            share *= row[13] / (1.0 if kind == SUN else max(d2, closest))
            if share > 0:
                largest = max(abs(dx), abs(dy), abs(dz))
                reach = 1e6 if kind == SUN else largest
                kept, _, _, _, _, _, _ = march(
                    distance,
                    x,
                    y,
                    z,
                    np.float32(dx / largest),
                    np.float32(dy / largest),
                    np.float32(dz / largest),
                    np.float32(reach),
                    kind == SUN,
                )
                if kept == 0:
                    lit += 1
                    tint = (row[14], row[15], row[16])
                    if kind == WINDOW:
                        tint = sky_radiance(dy / length)
                    r, g, b = r + share * tint[0], g + share * tint[1], b + share * tint[2]
            k += 1
            if k == whole and rays == 2 and kind != WINDOW and 0 < lit < 4:  # at the edge of a shadow: more rays
                rays, k, lit, whole = 4, 0, 0, 16
                r, g, b = 0.0, 0.0, 0.0
        red, green, blue = red + r, green + g, blue + b
    return red, green, blue
