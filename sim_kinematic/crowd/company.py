"""Groups of people who walk abreast (Moussaid et al. 2010), or who stand and talk in F-formations (Kendon 1990)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.crowd.reactions import sees
from sim_kinematic.motion.step import wrap_angle
from sim_kinematic.motion.stride import point_along

GAZE, COHESION, REPULSION = 4.0, 3.0, 1.0
"""Weights of Moussaid et al. 2010: for turning the head to the others [1/(s rad)], for the group's centre and for members who
are too near [m/s2]."""
TOO_NEAR_M, CLOSED_M2 = 0.8, 0.2
"""Distance below which members of a group repel each other [m]; area of floor that a conversation may cut off from the
rest [m2]."""
AHEAD_M, ASIDE_M, ROOM_M = 1.0, 1.2, 0.45
"""Place towards which members of a group walk: its distance ahead, its largest distance beside the path, and its least
distance from obstacles [m]."""
VIEW_RAD = math.pi / 2
"""Angle to the others of a group beyond which a member turns the head and walks slower [rad]."""
TOGETHER_M, SLOW, SLOWEST = 1.5, 0.5, 0.1
"""Distance from the group [m] within which a member slows down at most to the first share of the speed, and beyond
which at most to the second. So no member stands still in a passage, where the group walks in single file."""
ONWARD = 0.3
"""Least share of the speed at which a member of a group keeps walking, whatever the group does."""
APART_M, NEAR_M = 1.0, 0.6
"""Least distance between neighbours in a conversation, and of everyone from its centre [m]."""
BETWEEN_M = 0.3
"""Detour below which a person counts as standing between two members of a group [m]: the extra length of the path from
one member to the other through that person."""
BEHIND_M = 0.3
"""Free space behind people who stand and talk [m]."""
CANDIDATES = 300
"""Number of places for a conversation that are compared."""
PASSING_M, EDGE_M = 0.95, 0.25
"""Distances at which people pass others who stand and talk, and at which they pass walls [m]: both bodies with the
reach of their feet."""


@kernel(error_model="numpy")
def walk_beside(sdf, origin, cell, x, z, path, cumulative, along, wx, wz):
    """Return the wanted velocity (x, z) [m/s] of a member of a group, parallel to the group's path if there is room."""
    ax, az = point_along(path, cumulative, along)
    tx, tz = point_along(path, cumulative, min(along + AHEAD_M, cumulative[-1]))
    aside = min(math.hypot(x - ax, z - az), ASIDE_M) / max(math.hypot(x - ax, z - az), 1e-6)
    wanted = math.hypot(wx, wz)
    # beside the path as far as now, else half as far; where there is no room for that either, on the path
    for share in (1.0, 0.5):
        gx, gz = tx + share * aside * (x - ax), tz + share * aside * (z - az)
        if sample_sdf(sdf, origin, cell, gx, gz) > ROOM_M:
            length = max(math.hypot(gx - x, gz - z), 1e-6)
            return (gx - x) / length * wanted, (gz - z) / length * wanted
    return wx, wz


@kernel(error_model="numpy")
def keep_company(sdf, origin, cell, m, company, places, wx, wz, tau, in_sight, unparted):
    """Return the wanted velocity (x, z) [m/s] of person ``m``, who wants ``(wx, wz)``, with the forces of their group.

    The gaze slows down a member who is ahead of the others. Cohesion pulls to the group's centre from a distance of (N
    - 1) / 2 m on, growing over 0.3 m. Members nearer than 0.8 m repel each other. A force counts as the change of
    velocity within ``tau`` [s].

    Args:
        sdf: Signed distances of the floor's grid [m].
        origin: Position of the grid.
        cell: Size of its cells [m].
        m: Number of the person.
        company: Number of the walking group of each person of the crowd [M], -1: none.
        places: Positions (x, z) [N, 2] [m].
        wx: Wanted velocity along x [m/s].
        wz: Wanted velocity along z [m/s].
        tau: Time constant of the desired velocity [s].
        in_sight: True if only visible members count, as others would pull people against a wall, and if members walk
            on at least slowly. False repeats recordings of earlier versions.
        unparted: True if members count only if nobody else is in between. False repeats earlier recordings.
    """
    x, z = places[m, 0], places[m, 1]
    others, cx, cz, rx, rz = 0, 0.0, 0.0, 0.0, 0.0
    for j in range(len(company)):
        if j == m or company[j] != company[m]:
            continue
        if in_sight and not sees(sdf, origin, cell, x, z, places[j, 0], places[j, 1]):
            continue
        px, pz = places[j, 0] - x, places[j, 1] - z
        distance = max(math.hypot(px, pz), 1e-6)
        parted = False
        for k in range(len(places) if unparted else 0):
            there = math.hypot(places[k, 0] - x, places[k, 1] - z)
            there += math.hypot(places[k, 0] - places[j, 0], places[k, 1] - places[j, 1])
            parted |= there < distance + BETWEEN_M and (k >= len(company) or company[k] != company[m])
        if parted:
            continue
        others += 1
        cx, cz = cx + px, cz + pz
        if distance < TOO_NEAR_M:
            rx, rz = rx - px / distance, rz - pz / distance
    if others == 0:
        return wx, wz
    cx, cz = cx / others, cz / others
    away = max(math.hypot(cx, cz), 1e-6)
    wanted, ox, oz = math.hypot(wx, wz), wx, wz
    if wanted > 0.05:
        turned = max(abs(wrap_angle(math.atan2(cz, cx) - math.atan2(wz, wx))) - VIEW_RAD, 0.0)
        share = max(1.0 - tau * GAZE * turned, SLOW if away < TOGETHER_M else SLOWEST)
        wx, wz = wx * share, wz * share
    # the centre of all members, the person included, is nearer than that of the others
    centre = away * others / (others + 1.0)
    pull = tau * COHESION * min(max((centre - others / 2.0) / 0.3, 0.0), 1.0)
    wx, wz = wx + pull * cx / away + tau * REPULSION * rx, wz + pull * cz / away + tau * REPULSION * rz
    if in_sight and wanted > 0.05:
        # one behind the other in a passage, the first would go back to the second, who cannot come nearer
        missing = max(ONWARD - (wx * ox + wz * oz) / (wanted * wanted), 0.0)
        wx, wz = wx + missing * ox, wz + missing * oz
    return wx, wz


def circle_radius(people: int) -> float:
    """Return the radius [m] of the circle on which people stand in a conversation."""
    return max(NEAR_M, APART_M / 2 / math.sin(math.pi / people))


def closed_area(free: FreeSpace, xz: Array) -> float:
    """Return the area [m2] of floor that people at places [N, 2] cut off from the largest remaining part."""
    from scipy import ndimage

    label: Any = ndimage.label  # its types do not say that it returns two values

    x, z = (
        origin + free.cell_m * (np.arange(count) + 0.5)
        for origin, count in zip(free.origin, free.sdf.shape, strict=True)
    )
    open_floor = free.sdf >= EDGE_M
    left = open_floor.copy()
    # nobody goes into the circle either, so its inside is not cut off
    centre = xz.mean(0)
    discs = [(*place, PASSING_M) for place in xz] + [(*centre, float(np.hypot(*(xz - centre).T).max()))]
    for px, pz, radius in discs:
        left &= (x[:, None] - px) ** 2 + (z[None] - pz) ** 2 >= radius**2
    islands, _ = label(open_floor)
    pieces, count = label(left)
    if not count:
        return float(open_floor.sum()) * free.cell_m**2
    # parts that nobody could reach before are not cut off by these people
    areas = np.bincount(pieces[left], minlength=count + 1)
    home = islands[pieces == np.argmax(areas)][0]
    return float((left & (islands == home)).sum() - areas.max()) * free.cell_m**2


def standing_circle(
    free: FreeSpace, xz: Array, rng: np.random.Generator, *, leaves_way: bool = True
) -> tuple[Array, Array]:
    """Return the places [N, 2] of people who talk, and the centre [2] that they face: an F-formation (Kendon 1990).

    The circle is as near to the people as possible, at a place where it fits and others can pass, and each person takes
    the nearest place on it. In a home without enough room, the roomiest place is used, and people who cannot stand on
    the circle stand inside it.

    Args:
        free: The floor.
        xz: Positions of the people now [N, 2] [m].
        rng: Random number generator for the places that are compared.
        leaves_way: False for conversations of earlier versions, which may close a passage.
    """
    radius, centres = circle_radius(len(xz)), free.sample(rng, CANDIDATES)
    room = free.signed_distance(centres)
    far = sum(free.geodesic(np.broadcast_to(own, centres.shape), centres) for own in xz)
    far = np.where(np.isfinite(far), far, 1e6)
    # a metre of missing room costs as much as a path of 1 km: room comes first wherever there is some
    order = np.argsort(far + 1e3 * np.maximum(radius + BEHIND_M - room, 0.0), kind="stable")
    # most places that are near and roomy leave a way, so the first that does is found soon; else the one that closes least
    least, chosen = np.inf, (xz, xz[0])
    for k in order.tolist():
        places = _circle_at(free, xz, centres[k])
        closed = closed_area(free, places) if leaves_way else 0.0
        if closed < least:
            least, chosen = closed, (places, np.asarray(centres[k]))
        if closed < CLOSED_M2:
            break
    return chosen


def _circle_at(free: FreeSpace, xz: Array, centre: Array) -> Array:
    """Return the places [N, 2] on the circle around a centre, or inside it, for people who come from places [N, 2]."""
    radius, angles = circle_radius(len(xz)), 2 * np.pi * np.arange(len(xz)) / len(xz)
    begin = math.atan2(*(xz[0] - centre)[::-1]) if np.hypot(*(xz[0] - centre)) > 1e-6 else 0.0
    ring = centre + radius * np.stack([np.cos(begin + angles), np.sin(begin + angles)], 1)
    places, left = np.zeros_like(xz), list(range(len(ring)))
    for k, own in enumerate(xz):
        best = min(left, key=lambda n: float(np.hypot(*(ring[n] - own))))
        left.remove(best)
        at, share = ring[best], 1.0
        while free.signed_distance(at) < BEHIND_M and share > 0.4:
            share -= 0.1
            at = centre + share * (ring[best] - centre)
        places[k] = at
    return places
