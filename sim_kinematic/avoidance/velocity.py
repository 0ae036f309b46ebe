"""Velocity of a robot's base that keeps clear of people and other robots.

Short trials of the next command, in the manner of the dynamic window (Fox, Burgard and Thrun, 1997), against where the others
will be if they keep their velocity.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.step import are_clear, integrate_along, wrap_angle

# standing still comes first: of equal commands the first one wins
_CANDIDATES = np.array([(0.0, 0.0), *itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=2)])


@kernel(error_model="numpy")
def least_gap(x, z, heading, other_x, other_z, hull, reach):
    """Return the least distance [m] between the discs of a hull and a floor point, less ``reach``, the sum of both radii."""
    return gap_along(x, z, math.cos(heading), math.sin(heading), other_x, other_z, hull, reach)


@kernel(error_model="numpy", inline="always")
def gap_along(x, z, c, s, other_x, other_z, hull, reach):
    """Return the same as `least_gap` of a heading whose cosine ``c`` and sine ``s`` are known."""
    least = math.inf
    for offset in hull:
        dx = x + c * offset - other_x
        dz = z - s * offset - other_z
        least = min(least, math.hypot(dx, dz) - reach)
    return least


@kernel(error_model="numpy")
def try_command(sdf, origin, cell, pose, speed, turn, length, arc, others, base, hull, rules, enough, gaps):
    """Roll out a command that is kept for ``length`` [m] and ``arc`` [rad] at most: ``(x, z, heading, most lacking)``.

    The base stays where it would touch an obstacle. The least gap to each other agent goes to ``gaps`` [N]; later gaps count
    as wider by a doubt [m/s]. The trial ends early where an agent lacks ``enough`` of its margin already.
    """
    (x, z, heading), (offsets, disc_radius), (steps, stride, doubt, dt) = pose, base, rules
    gaps[:] = math.inf
    lacks, c, s = -math.inf, math.cos(heading), math.sin(heading)
    for step in range(1, steps + 1):
        if abs(speed) * step * dt > length:
            speed = 0.0
        # rounded to the nearest step, so that a turn neither stops short nor overshoots by a whole one
        if abs(turn) * (step - 0.5) * dt > arc:
            turn = 0.0
        nx, nz, nh = integrate_along(x, z, heading, c, s, speed, 0.0, turn, dt)
        nc, ns = (math.cos(nh), math.sin(nh)) if turn != 0.0 else (c, s)
        if are_clear(sdf, origin, cell, nx, nz, nc, ns, offsets, disc_radius):
            x, z, heading, c, s = nx, nz, nh, nc, ns
        if step % stride == 0:
            t = step * dt
            for n in range(len(others)):
                to_x, to_z = others[n, 0] + others[n, 2] * t, others[n, 1] + others[n, 3] * t
                now = gap_along(x, z, c, s, to_x, to_z, hull, others[n, 4])
                gaps[n] = min(gaps[n], now + doubt * t)
                lacks = max(lacks, others[n, 5] - gaps[n])
            if lacks > enough:
                break
    return x, z, heading, lacks


@kernel(error_model="numpy")
def choose_command(
    sdf, origin, cell, pose, goal, wanted, length, arc, others, base, hull, limits, rules, costs, before, levels, gaps
):
    """Return the number of the command in ``levels`` [C, 2] that `keep_clear` chooses, -1: the one that is ``wanted``.

    Others [N, 7] are ``(x, z, velocity x, velocity z, sum of both radii, margin, settled)``; ``before`` is NaN where it does
    not count. ``gaps`` [N] is room to work in.
    """
    (max_speed, max_turn), (still_margin, gap_weight, heading_weight, turn_weight, change_weight) = limits, costs
    # a robot that stands too near to somebody already could not leave if it had to keep more than it has
    if others[:, 6].any():
        forward, turn = levels[0, 0] * max_speed, levels[0, 1] * max_turn  # of standing still
        try_command(
            sdf, origin, cell, pose, forward, turn, math.inf, math.inf, others, base, hull, rules, math.inf, gaps
        )
        for n in range(len(others)):
            if others[n, 6] != 0.0:
                others[n, 5] = min(still_margin, gaps[n])
    forward, turn = wanted[0] * max_speed, wanted[1] * max_turn
    _, _, _, lacks = try_command(
        sdf, origin, cell, pose, forward, turn, length, arc, others, base, hull, rules, 0.0, gaps
    )
    if lacks <= 0.0:
        return -1
    best, least, counts = -1, math.inf, not math.isnan(before[0])
    for c in range(len(levels)):
        forward, turn = levels[c]
        # only the worst gap counts: more room on one side must not make up for less on the other
        x, z, heading, lacks = try_command(
            sdf,
            origin,
            cell,
            pose,
            forward * max_speed,
            turn * max_turn,
            math.inf,
            math.inf,
            others,
            base,
            hull,
            rules,
            least / gap_weight,  # no cost is less than this part of it
            gaps,
        )
        left = math.hypot(x - goal[0], z - goal[1])
        off = abs(wrap_angle(math.atan2(z - goal[1], goal[0] - x) - heading)) if left > 0.1 else 0.0
        cost = gap_weight * max(lacks, 0.0) + left + heading_weight * off
        cost += turn_weight * abs(turn)
        if counts:
            cost += change_weight * (abs(turn - before[1]) + abs(forward - before[0]))
        if cost < least:
            best, least = c, cost
    return best


class ObstacleDisc(NamedTuple):
    """A disc of another agent that a robot keeps clear of."""

    xz: Sequence[float] | NDArray[np.floating]
    """Position of the disc [2] [m]."""
    velocity: Sequence[float] | NDArray[np.floating]
    """Velocity of the disc [2] [m/s]."""
    settled: bool = False
    """True if the agent has stood for long and is passed at ``still_margin_m``."""
    radius_m: float = AVOIDANCE.person_radius_m
    margin_m: float = AVOIDANCE.margin_m
    """Gap to be kept between robot and disc."""


def keep_clear(
    free: FreeSpace,
    base: BaseSpec,
    xz: NDArray,
    heading: float,
    wanted: tuple[float, float],
    towards: NDArray,
    others: Sequence[ObstacleDisc],
    before: tuple[float, float] | None = None,
) -> tuple[float, float]:
    """Return the command (forward, turn: -1..1 of the limits) that replaces ``wanted`` so that there is no collision.

    That is ``wanted`` itself where it leaves every agent its margin, else the best of 25: first the margin of whoever lacks
    most, then the path to ``towards`` [2], then what differs little from the command ``before``, if that counts.
    """
    spec, here, goal = AVOIDANCE, tuple(xz.tolist()), tuple(towards.tolist())
    rows = []
    for (x, z), velocity, settled, radius_m, margin_m in others:
        # an agent that is far away cannot matter within the horizon, and most steps end here
        if math.hypot(x - here[0], z - here[1]) <= spec.range_m:
            rows.append((x, z, *velocity, base.disc_radius_m + radius_m, margin_m, settled))
    if not rows:
        return wanted
    dx, dz = goal[0] - here[0], goal[1] - here[1]
    length = math.hypot(dx, dz)
    # close to the goal its bearing turns around with every centimetre
    arc = abs(wrap_angle.py_func(math.atan2(-dz, dx) - heading)) if length > 0.1 else math.inf
    levels = _CANDIDATES if before is None else np.concatenate([_CANDIDATES, [before]])
    offsets, hull = _discs(base)
    chosen = free.entries(
        choose_command,
        free.sdf,
        free.origin,
        free.cell_m,
        (*here, heading),
        goal,
        (float(wanted[0]), float(wanted[1])),
        length,
        arc,
        np.array(rows, np.float64),
        (offsets, base.disc_radius_m - spec.wall_tolerance_m),
        hull,
        (float(base.max_speed_mps), float(base.max_turn_rad_s)),
        (spec.horizon_steps, spec.stride_steps, spec.doubt_mps, STEP_S),
        (spec.still_margin_m, spec.gap_weight, spec.heading_weight_m, spec.turn_weight_m, spec.change_weight_m),
        # NaN rather than None: the kernel is compiled for one type
        (math.nan, math.nan) if before is None else before,
        levels,
        np.empty(len(rows)),
    )
    if chosen < 0:
        return wanted
    forward, turn = levels[chosen].tolist()
    return forward, turn


def eased(base: BaseSpec, wanted: tuple[float, float], before: tuple[float, float]) -> tuple[float, float]:
    """Return the command (forward, turn: -1..1 of the limits) one step further from ``before`` towards ``wanted``.

    It stops turning at once, to end where it wants to.
    """
    spec, speed = AVOIDANCE, STEP_S / base.max_speed_mps
    forward = _within(wanted[0], before[0], spec.accel_mps2 * speed, spec.brake_mps2 * speed)
    return forward, _within(wanted[1], before[1], spec.turn_accel_rad_s2 * STEP_S / base.max_turn_rad_s, 1.0)


def _within(wanted: float, before: float, up: float, down: float) -> float:
    """Return the value nearest to ``wanted`` if the size of ``before`` may grow by ``up`` and shrink by ``down``."""
    # mirrored, because to brake is to make a number smaller in size, whatever its sign
    if before < 0.0:
        return -_within(-wanted, -before, up, down)
    return min(max(wanted, before - down, -up), before + up)


def braking_speed(accel: float, left: float, last: float = 0.0) -> float:
    """Return the speed from which braking at a rate ends with speed ``last`` where a path or a turn ends."""
    return math.sqrt(2.0 * accel * max(left, 0.0) + last * last)


@lru_cache(maxsize=64)
def _discs(base: BaseSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the offsets of a base's discs and of those of its hull along its x axis [m]."""
    return np.array(base.disc_offsets_m, np.float64), np.array(hull_of(base), np.float64)


def is_crowded(base: BaseSpec, stands: NDArray, other: ObstacleDisc, margin_m: float) -> NDArray[np.bool_]:
    """Return whether a robot at stands ``(x, z, heading)`` [N, 3] would be within a margin [m] of another agent now, [N]."""
    reach, (_, hull) = base.disc_radius_m + other.radius_m, _discs(base)
    other_x, other_z = other.xz
    gaps = [least_gap(x, z, heading, other_x, other_z, hull, reach) for x, z, heading in stands.tolist()]
    return np.array(gaps) < margin_m
