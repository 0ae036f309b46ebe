"""Choice of a velocity by reciprocal avoidance and social force, as tensors.

`sim_kinematic.crowd.orca` and `sim_kinematic.crowd.social_force` are the reference (tests/training/torch/test_crowds.py).
Here, branches are `torch.where`, and all half-planes of all people of all worlds are looked at together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from h3data_training.torch.step import wrap_angle
from sim_kinematic.crowd.orca import DIRECTIONS, SPEEDS

NEVER = -1e9
"""Offset of a half-plane that every velocity satisfies [m/s]."""


class HalfPlanes(NamedTuple):
    """Half-planes of velocities ``v`` with ``normal . v >= offset``, or of changes of velocity."""

    normal: Tensor
    """Unit normals [..., 2]."""
    offset: Tensor
    """Offsets [...] [m/s]."""


def length(vector: Tensor) -> Tensor:
    """Return the lengths [...] of vectors [..., 2]."""
    return torch.hypot(vector[..., 0], vector[..., 1])


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the scalar products [...] of vectors [..., 2]."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def half_planes(gap: Tensor, relative: Tensor, radius: Tensor, horizon: Tensor, dt: float, share: Tensor) -> HalfPlanes:
    """Return the half-planes of velocity changes that avoid neighbours (`sim_kinematic.crowd.orca.half_plane`).

    Args:
        gap: Positions of neighbours relative to the agents [..., 2] [m].
        relative: Velocities of the agents relative to the neighbours [..., 2] [m/s].
        radius: Sums of both radii [...] [m].
        horizon: Times within which they must not touch [...] [s].
        dt: Time in which discs that overlap must come apart [s].
        share: Parts of the changes that the agents make themselves [...].
    """
    distance2, radius2 = dot(gap, gap), radius * radius
    overlaps = distance2 <= radius2
    time = torch.where(overlaps, dt, horizon)
    cut = relative - gap / time[..., None]
    w, along = length(cut), dot(cut, gap)
    at_tip = overlaps | ((along < 0.0) & (along * along > radius2 * w * w))
    nowhere = (w < 1e-9)[..., None]  # no direction of its own: away from the neighbour
    away = -gap / length(gap).clamp_min(1e-9)[..., None]
    tip = torch.where(nowhere, away, cut / w.clamp_min(1e-12)[..., None])
    tip_offset = share * (radius / time - torch.where(nowhere[..., 0], 0.0, w))
    leg = (distance2 - radius2).clamp_min(0.0).sqrt()
    left = gap[..., 0] * cut[..., 1] - gap[..., 1] * cut[..., 0] > 0.0
    side = torch.where(left, 1.0, -1.0)
    px, pz, square = gap[..., 0], gap[..., 1], distance2.clamp_min(1e-12)
    dx, dz = (px * leg - side * pz * radius) / square, (side * px * radius + pz * leg) / square
    normal = torch.stack([-side * dz, side * dx], -1)
    return HalfPlanes(
        torch.where(at_tip[..., None], tip, normal), torch.where(at_tip, tip_offset, -share * dot(relative, normal))
    )


def nearest_velocities(planes: HalfPlanes, wanted: Tensor, most: Tensor) -> Tensor:
    """Return the velocities [..., 2] [m/s] nearest to the wanted ones that satisfy all half-planes.

    It is the incremental linear program of `sim_kinematic.crowd.orca.nearest_velocity`, with the least violation where no
    velocity satisfies all of them.

    Args:
        planes: Half-planes of all people, [N, ..., 2] and [N, ...]; those with the offset `NEVER` do not count.
        wanted: Wanted velocities [..., 2] [m/s].
        most: Greatest speeds [...] [m/s].
    """
    normal, offset = planes
    speed = length(wanted)
    velocity = wanted * torch.where(speed > most, most / speed.clamp_min(1e-12), 1.0)[..., None]
    fails = torch.zeros_like(speed, dtype=torch.bool)
    for k in range(len(offset)):
        n, own = normal[k], offset[k]
        violates = ~fails & (dot(n, velocity) < own - 1e-9)
        left = most * most - own * own
        tangent = torch.stack([-n[..., 1], n[..., 0]], -1)
        high = left.clamp_min(0.0).sqrt()
        low, none = -high, left < 0.0
        if k:
            across = dot(normal[:k], tangent)
            missing = offset[:k] - own * dot(normal[:k], n)
            parallel = across.abs() < 1e-9
            bound = missing / torch.where(parallel, 1.0, across)
            low = torch.maximum(low, torch.where(~parallel & (across > 0.0), bound, -math.inf).amax(0))
            high = torch.minimum(high, torch.where(~parallel & (across < 0.0), bound, math.inf).amin(0))
            none = none | (parallel & (missing > 0.0)).any(0) | (low > high)
        at = torch.minimum(torch.maximum(dot(tangent, wanted), low), high)
        on_border = own[..., None] * n + at[..., None] * tangent
        velocity = torch.where((violates & ~none)[..., None], on_border, velocity)
        fails = fails | (violates & none)
    return torch.where(fails[..., None], _least_violations(planes, wanted, most), velocity)


def _least_violations(planes: HalfPlanes, wanted: Tensor, most: Tensor) -> Tensor:
    k = torch.arange(DIRECTIONS * SPEEDS + 1, device=wanted.device)
    share = ((k + DIRECTIONS - 1) // DIRECTIONS).to(wanted.dtype) / SPEEDS
    angle = 2.0 * math.pi * (k % DIRECTIONS).to(wanted.dtype) / DIRECTIONS
    unit = torch.stack([share * angle.cos(), share * angle.sin()], -1)
    tried = unit.reshape(-1, *[1] * most.ndim, 2) * most[..., None]
    worst = torch.zeros_like(tried[..., 0])
    for normal, offset in zip(*planes, strict=True):
        worst = torch.maximum(worst, offset - dot(normal, tried))
    best = (worst + 0.01 * length(tried - wanted)).argmin(0)
    return torch.gather(tried, 0, best[None, ..., None].expand(1, *best.shape, 2))[0]


def interactions(gap: Tensor, relative: Tensor, lambda_: float, gamma: float, n: float, n_prime: float) -> Tensor:
    """Return the accelerations [..., 2] caused by neighbours, before they are weighted.

    The arguments are those of `sim_kinematic.crowd.social_force.interaction`, with positions of neighbours ``gap`` [..., 2]
    [m] and velocities relative to them [..., 2] [m/s].
    """
    distance = length(gap).clamp_min(1e-6)
    towards = gap / distance[..., None]
    line = lambda_ * relative + towards
    size = length(line)
    line = line / size.clamp_min(1e-9)[..., None]
    reach = gamma * size.clamp_min(1e-9)
    theta = wrap_angle(torch.atan2(towards[..., 1], towards[..., 0]) - torch.atan2(line[..., 1], line[..., 0]))
    slow = -torch.exp(-distance / reach - (n_prime * reach * theta).square())
    turn = torch.exp(-distance / reach - (n * reach * theta).square())
    turn = torch.where(theta >= 0.0, -turn, turn)
    across = torch.stack([-line[..., 1], line[..., 0]], -1)
    return torch.where((size < 1e-9)[..., None], 0.0, slow[..., None] * line + turn[..., None] * across)
