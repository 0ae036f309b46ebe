"""Groups of people who walk abreast (Moussaid et al. 2010), or stand and talk in F-formations (Kendon 1990)."""

from __future__ import annotations

import math

import numpy as np

from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.motion.step import wrap_angle
from sim_kinematic.motion.stride import point_along

GAZE, COHESION, REPULSION = 4.0, 3.0, 1.0
"""Weights of Moussaid et al. 2010: for turning the head to the others [1/(s rad)], for the group's centre and for members who
are too near [m/s2]."""
AHEAD_M, ASIDE_M, ROOM_M = 1.0, 1.2, 0.45
"""Place towards which members walk: its distance ahead, its largest distance beside the path, and its least room [m]."""
TOO_NEAR_M = 0.8
"""Members nearer than this repel each other."""
VIEW_RAD = math.pi / 2
"""Angle to the others of a group beyond which a member turns the head and walks slower [rad]."""
TOGETHER_M, SLOW, SLOWEST = 1.5, 0.5, 0.1
"""A member slows down to the first share of the speed at most while the company is within this distance, else to the second. So
nobody stands still in a passage, where the members walk one behind the other."""
APART_M, NEAR_M = 1.0, 0.6
"""Least distance of neighbours in a conversation from each other, and of everybody from its centre [m]."""
BEHIND_M = 0.3
"""Room behind people who stand and talk [m]."""
CANDIDATES = 300
"""Number of places for a conversation that are compared."""


@kernel(error_model="numpy")
def walk_beside(sdf, origin, cell, x, z, path, cumulative, along, wx, wz):
    """Wanted velocity (x, z) [m/s] of a member of a group: parallel to the path of all where there is room beside it."""
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
def keep_company(m, company, places, wx, wz, tau):
    """Wanted velocity (x, z) [m/s] of person ``m``, who wants ``(wx, wz)`` for themselves, with the forces of their group.

    The gaze slows down who is ahead of the others, cohesion pulls to the group's centre from (N - 1) / 2 m on, growing over
    0.3 m, and members nearer than 0.8 m repel each other. A force counts as the change of velocity within ``tau`` [s].

    Args:
        m: Number of the person.
        company: Number of the walking group of each person of the crowd [M], -1: none.
        places: Positions (x, z) [N, 2] [m].
        wx: Wanted velocity [m/s].
        wz: The same along z.
        tau: Time constant of the desired velocity [s].
    """
    x, z = places[m, 0], places[m, 1]
    others, cx, cz, rx, rz = 0, 0.0, 0.0, 0.0, 0.0
    for j in range(len(company)):
        if j == m or company[j] != company[m]:
            continue
        px, pz = places[j, 0] - x, places[j, 1] - z
        distance = max(math.hypot(px, pz), 1e-6)
        others += 1
        cx, cz = cx + px, cz + pz
        if distance < TOO_NEAR_M:
            rx, rz = rx - px / distance, rz - pz / distance
    if others == 0:
        return wx, wz
    cx, cz = cx / others, cz / others
    away = max(math.hypot(cx, cz), 1e-6)
    wanted = math.hypot(wx, wz)
    if wanted > 0.05:
        turned = max(abs(wrap_angle(math.atan2(cz, cx) - math.atan2(wz, wx))) - VIEW_RAD, 0.0)
        share = max(1.0 - tau * GAZE * turned, SLOW if away < TOGETHER_M else SLOWEST)
        wx, wz = wx * share, wz * share
    # the centre of all members, the person included, is nearer than that of the others
    centre = away * others / (others + 1.0)
    pull = tau * COHESION * min(max((centre - others / 2.0) / 0.3, 0.0), 1.0)
    return wx + pull * cx / away + tau * REPULSION * rx, wz + pull * cz / away + tau * REPULSION * rz


def circle_radius(people: int) -> float:
    """Return the radius [m] of the circle on which people stand who talk with each other."""
    return max(NEAR_M, APART_M / 2 / math.sin(math.pi / people))


def standing_circle(free: FreeSpace, xz: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the places [N, 2] of people who talk, and the centre [2] that they face: an F-formation (Kendon 1990).

    The circle is where it has room, as near to the people as possible, and each takes the nearest place on it. In a home
    without such room the roomiest place is taken, and people who cannot stand on the circle stand inside it.

    Args:
        free: The floor.
        xz: Positions of the people now [N, 2] [m].
        rng: Source of the places that are compared.
    """
    radius = circle_radius(len(xz))
    centres = free.sample(rng, CANDIDATES)
    room = free.signed_distance(centres)
    far = sum(free.geodesic(np.broadcast_to(own, centres.shape), centres) for own in xz)
    far = np.where(np.isfinite(far), far, 1e6)
    # a metre of missing room costs as much as a path of 1 km: room comes first wherever there is some
    centre = centres[np.argmin(far + 1e3 * np.maximum(radius + BEHIND_M - room, 0.0))]
    angles = 2 * np.pi * np.arange(len(xz)) / len(xz)
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
    return places, np.asarray(centre)
