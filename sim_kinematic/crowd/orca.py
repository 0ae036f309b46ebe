"""Reciprocal collision avoidance by half-planes of velocities (ORCA; van den Berg, Guy, Lin and Manocha 2011)."""

from __future__ import annotations

import math

import numpy as np

from h3data.kernels import kernel

DIRECTIONS, SPEEDS = 24, 3
"""Numbers of directions and speeds that are compared where no velocity satisfies all half-planes."""


@kernel(error_model="numpy")
def half_plane(px, pz, vx, vz, radius, horizon, dt, share):
    """Return the half-plane of velocity changes that avoid one neighbour.

    The relative velocity must leave the velocity obstacle: the cone of velocities that lead into the disc ``radius``
    around the neighbour within ``horizon``. The nearest way out is shared between both.

    Args:
        px: Position of the neighbour relative to the agent along x [m].
        pz: Position of the neighbour relative to the agent along z [m].
        vx: Velocity of the agent relative to the neighbour along x [m/s].
        vz: Velocity of the agent relative to the neighbour along z [m/s].
        radius: Sum of both radii [m].
        horizon: Time within which they must not touch [s].
        dt: Time in which discs that overlap must come apart [s].
        share: Part of the change that the agent makes itself, 0..1.

    Returns:
        ``(nx, nz, offset)``: changes ``c`` of the velocity with ``n . c >= offset`` avoid the neighbour.
    """
    distance2 = px * px + pz * pz
    overlaps = distance2 <= radius * radius
    # discs that overlap must come apart soon, whatever the horizon
    time = dt if overlaps else horizon
    # from the centre of the disc that cuts off the tip of the cone
    wx, wz = vx - px / time, vz - pz / time
    w = math.hypot(wx, wz)
    along = wx * px + wz * pz
    if overlaps or (along < 0.0 and along * along > radius * radius * w * w):
        if w < 1e-9:
            wx, wz, w = -px, -pz, max(math.hypot(px, pz), 1e-9)
            return wx / w, wz / w, share * radius / time
        return wx / w, wz / w, share * (radius / time - w)
    # the nearer one of both legs of the cone, whose normal points out of it
    leg = math.sqrt(distance2 - radius * radius)
    if px * wz - pz * wx > 0.0:
        dx, dz = (px * leg - pz * radius) / distance2, (px * radius + pz * leg) / distance2
        nx, nz = -dz, dx
    else:
        dx, dz = (px * leg + pz * radius) / distance2, (pz * leg - px * radius) / distance2
        nx, nz = dz, -dx
    return nx, nz, -share * (vx * nx + vz * nz)


@kernel(error_model="numpy")
def nearest_velocity(planes, count, wanted_x, wanted_z, most):
    """Return the velocity nearest to the wanted one that satisfies all half-planes, by an incremental linear program.

    If no velocity satisfies all of them, it is the one of a few candidates that violates them least.

    Args:
        planes: Half-planes ``(nx, nz, offset)`` with ``n . v >= offset``, [N, 3].
        count: Number of rows in use.
        wanted_x: Wanted velocity along x [m/s].
        wanted_z: Wanted velocity along z [m/s].
        most: Greatest speed [m/s].
    """
    speed = math.hypot(wanted_x, wanted_z)
    share = most / speed if speed > most else 1.0
    vx, vz = wanted_x * share, wanted_z * share
    for k in range(count):
        nx, nz, offset = planes[k, 0], planes[k, 1], planes[k, 2]
        if nx * vx + nz * vz >= offset - 1e-9:
            continue
        # on the border of this half-plane: the part that the speed and the earlier half-planes allow
        left = most * most - offset * offset
        if left < 0.0:
            return _least_violation(planes, count, wanted_x, wanted_z, most)
        tx, tz = -nz, nx
        low, high = -math.sqrt(left), math.sqrt(left)
        for j in range(k):
            across = planes[j, 0] * tx + planes[j, 1] * tz
            missing = planes[j, 2] - offset * (planes[j, 0] * nx + planes[j, 1] * nz)
            # parallel borders: the other half-plane holds everywhere on this one or nowhere
            if abs(across) < 1e-9:
                if missing > 0.0:
                    low, high = 1.0, 0.0
            elif across > 0.0:
                low = max(low, missing / across)
            else:
                high = min(high, missing / across)
        if low > high:
            return _least_violation(planes, count, wanted_x, wanted_z, most)
        at = min(max(tx * wanted_x + tz * wanted_z, low), high)
        vx, vz = offset * nx + at * tx, offset * nz + at * tz
    return vx, vz


@kernel(error_model="numpy")
def _least_violation(planes, count, wanted_x, wanted_z, most):
    best, best_x, best_z = np.inf, 0.0, 0.0
    for k in range(DIRECTIONS * SPEEDS + 1):
        speed = most * ((k + DIRECTIONS - 1) // DIRECTIONS) / SPEEDS
        angle = 2.0 * math.pi * (k % DIRECTIONS) / DIRECTIONS
        vx, vz = speed * math.cos(angle), speed * math.sin(angle)
        worst = 0.0
        for j in range(count):
            worst = max(worst, planes[j, 2] - planes[j, 0] * vx - planes[j, 1] * vz)
        # a little of the wanted velocity decides between velocities that violate the half-planes alike
        cost = worst + 0.01 * math.hypot(vx - wanted_x, vz - wanted_z)
        if cost < best:
            best, best_x, best_z = cost, vx, vz
    return best_x, best_z
