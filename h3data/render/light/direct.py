"""Light that reaches a point directly: through windows, from the sun and from lamps. Positions are in voxels."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel_part
from h3data.render.light.voxels import march, sees

WINDOW_WORDS = 13
"""Of a window: centre, two half sides, normal into the room, area."""
LAMP_WORDS = 6
"""Of a lamp: position, linear colour (irradiance at one voxel's distance)."""
SUN_WORDS = 6
"""Of a sun: direction towards it, irradiance."""
SKY = (2.2, 2.6, 3.0)
HORIZON = (2.6, 2.6, 2.6)
GROUND = (0.9, 0.85, 0.75)
"""Radiance of the sky above, at the horizon, and of the ground outdoors."""
_LAMP_RADIUS = 2.0
_SUN_SPREAD = 0.035
"""Tangent of the sun's angular radius, larger than in reality: panes and the vertices' spacing blur its edge."""


@kernel_part()
def sky_radiance(up):
    """Radiance from outdoors in a direction with this y."""
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
def direct_light(distance, x, y, z, nx, ny, nz, windows, suns, lamps, seen_windows, seen_lamps, side):
    """Irradiance (r, g, b) of a surface point.

    ``seen_windows`` and ``seen_lamps`` are bits of those that can matter here; ``side`` is the largest number of rays along
    each side of a window.
    """
    red, green, blue = 0.0, 0.0, 0.0
    for w in range(len(windows)):
        if w < 64 and not (seen_windows >> np.uint64(w)) & np.uint64(1):
            continue
        cx, cy, cz = windows[w, 0] - x, windows[w, 1] - y, windows[w, 2] - z
        if cx * windows[w, 9] + cy * windows[w, 10] + cz * windows[w, 11] > -0.5:
            continue  # outside the room or in the pane's plane
        far2 = cx * cx + cy * cy + cz * cz
        angle = windows[w, 12] / far2
        rays = side if angle > 0.12 else min(side, 3) if angle > 0.03 else 2
        for i in range(rays):
            a = (2 * i + 1) / rays - 1
            for j in range(rays):
                b = (2 * j + 1) / rays - 1
                tx = windows[w, 0] + a * windows[w, 3] + b * windows[w, 6] + 1.6 * windows[w, 9]
                ty = windows[w, 1] + a * windows[w, 4] + b * windows[w, 7] + 1.6 * windows[w, 10]
                tz = windows[w, 2] + a * windows[w, 5] + b * windows[w, 8] + 1.6 * windows[w, 11]
                dx, dy, dz = tx - x, ty - y, tz - z
                d2 = max(dx * dx + dy * dy + dz * dz, 9.0)
                length = np.sqrt(d2)
                here = (dx * nx + dy * ny + dz * nz) / length
                there = -(dx * windows[w, 9] + dy * windows[w, 10] + dz * windows[w, 11]) / length
                if here <= 0 or there <= 0 or not sees(distance, x, y, z, tx, ty, tz):
                    continue
                share = here * there * windows[w, 12] / (rays * rays * d2)
                r, g, b_ = sky_radiance(dy / length)
                red, green, blue = red + share * r, green + share * g, blue + share * b_
    for s in range(len(suns)):
        facing = nx * suns[s, 0] + ny * suns[s, 1] + nz * suns[s, 2]
        if facing <= 0:
            continue
        lit = 0
        for k in range(13):
            angle, radius = k * 2.39996, np.sqrt((k + 0.5) / 13) * _SUN_SPREAD  # a sunflower's pattern
            dx = suns[s, 0] + radius * np.cos(angle)
            dy = suns[s, 1]
            dz = suns[s, 2] + radius * np.sin(angle)
            largest = max(abs(dx), abs(dy), abs(dz))
            kind, _, _, _, _, _, _ = march(
                distance, x, y, z, dx / largest, dy / largest, dz / largest, np.float32(1e6), True
            )
            lit += kind == 0
            if k == 4 and lit in (0, 5):  # rarely at an edge: the other rays would agree
                lit = 13 if lit else 0
                break
        share = facing * lit / 13
        red, green, blue = red + share * suns[s, 3], green + share * suns[s, 4], blue + share * suns[s, 5]
    for m in range(len(lamps)):
        if m < 64 and not (seen_lamps >> np.uint64(m)) & np.uint64(1):
            continue
        cx, cy, cz = lamps[m, 0] - x, lamps[m, 1] - y, lamps[m, 2] - z
        d2 = max(cx * cx + cy * cy + cz * cz, 16.0)
        facing = max((cx * nx + cy * ny + cz * nz) / np.sqrt(d2), 0.0)
        if facing <= 0:
            continue
        lit = 0
        for k in range(5):
            angle, radius = k * 2.39996, np.sqrt((k + 0.5) / 5) * _LAMP_RADIUS
            tx, tz = lamps[m, 0] + radius * np.cos(angle), lamps[m, 2] + radius * np.sin(angle)
            lit += sees(distance, x, y, z, tx, lamps[m, 1], tz)
        share = facing * lit / (5 * d2)
        red, green, blue = red + share * lamps[m, 3], green + share * lamps[m, 4], blue + share * lamps[m, 5]
    return red, green, blue
