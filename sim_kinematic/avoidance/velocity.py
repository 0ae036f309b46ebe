"""Velocity of a robot's base that keeps clear of people and other robots.

Short trials of the next command, in the manner of the dynamic window (Fox, Burgard and Thrun, 1997), against where the others
will be if they keep their velocity.
"""

from __future__ import annotations

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
from sim_kinematic.motion.step import integrate, is_clear, wrap_angle

_LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
# standing still comes first: of equal commands the first one wins
_CANDIDATES = np.array([(0.0, 0.0), *((forward, turn) for forward in _LEVELS for turn in _LEVELS)])


@kernel(error_model="numpy")
def least_gap(x, z, heading, other_x, other_z, hull, reach):
    """Returns the least distance [m] between the discs of a hull and a floor point, less ``reach``, the sum of both radii."""
    least = math.inf
    for offset in hull:
        dx = x + math.cos(heading) * offset - other_x
        dz = z - math.sin(heading) * offset - other_z
        least = min(least, math.hypot(dx, dz) - reach)
    return least


@kernel(error_model="numpy")
def try_command(
    sdf,
    origin,
    cell,
    x,
    z,
    heading,
    speed,
    turn,
    length,
    arc,
    other,
    velocity,
    offsets,
    disc_radius,
    hull,
    reach,
    steps,
    stride,
    doubt,
    dt,
):
    """Rolls out a command that is kept for ``length`` [m] and ``arc`` [rad] at most: ``(least gap [m], x, z, heading)``.

    The base stays where it would touch an obstacle. Later gaps count as wider by ``doubt`` [m/s].
    """
    gap = math.inf
    for step in range(1, steps + 1):
        if abs(speed) * step * dt > length:
            speed = 0.0
        # rounded to the nearest step, so that a turn neither stops short nor overshoots by a whole one
        if abs(turn) * (step - 0.5) * dt > arc:
            turn = 0.0
        nx, nz, nh = integrate(x, z, heading, speed, 0.0, turn, dt)
        if is_clear(sdf, origin, cell, nx, nz, nh, offsets, disc_radius):
            x, z, heading = nx, nz, nh
        if step % stride == 0:
            t = step * dt
            now = least_gap(x, z, heading, other[0] + velocity[0] * t, other[1] + velocity[1] * t, hull, reach)
            gap = min(gap, now + doubt * t)
    return gap, x, z, heading


@kernel(error_model="numpy")
def try_commands(
    sdf,
    origin,
    cell,
    x,
    z,
    heading,
    speeds,
    turns,
    length,
    arc,
    others,
    velocities,
    reaches,
    offsets,
    disc_radius,
    hull,
    steps,
    stride,
    doubt,
    dt,
    out,
):
    """`try_command` for each of C commands against each of N discs, into ``out`` [C, N, 4]."""
    for c in range(len(speeds)):
        for n in range(len(reaches)):
            out[c, n, 0], out[c, n, 1], out[c, n, 2], out[c, n, 3] = try_command(
                sdf,
                origin,
                cell,
                x,
                z,
                heading,
                speeds[c],
                turns[c],
                length,
                arc,
                others[n],
                velocities[n],
                offsets,
                disc_radius,
                hull,
                reaches[n],
                steps,
                stride,
                doubt,
                dt,
            )


class ObstacleDisc(NamedTuple):
    """A disc of another agent that a robot keeps clear of."""

    xz: NDArray
    velocity: NDArray
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
    """Returns the command (forward, turn: -1..1 of the limits) that replaces ``wanted`` so that nobody is run into.

    That is ``wanted`` itself where it leaves every agent its margin, else the best of 25: first the margin of whoever lacks
    most, then the path to ``towards`` [2], then what differs little from the command ``before``, if that counts.
    """
    spec, (here_x, here_z), (goal_x, goal_z) = AVOIDANCE, xz.tolist(), towards.tolist()
    places = [other.xz.tolist() for other in others]
    # who is far away cannot matter within the horizon, and most steps end here
    others = [o for o, (x, z) in zip(others, places, strict=True) if np.hypot(x - here_x, z - here_z) <= spec.range_m]
    if not others:
        return wanted
    discs = (
        np.array([other.xz for other in others]),
        np.array([other.velocity for other in others]),
        np.array([base.disc_radius_m + other.radius_m for other in others]),
    )
    offsets, hull = _discs(base)

    def trials(
        commands: NDArray[np.float64], length: float = math.inf, arc: float = math.inf
    ) -> list[list[list[float]]]:
        """``(least gap, x, z, heading)`` of commands [C, 2] beside each other agent, [C, N, 4]."""
        out = np.empty((len(commands), len(others), 4))
        speeds, turns = commands[:, 0] * base.max_speed_mps, commands[:, 1] * base.max_turn_rad_s
        try_commands(
            free.sdf,
            free.origin,
            free.cell_m,
            here_x,
            here_z,
            heading,
            speeds,
            turns,
            length,
            arc,
            *discs,
            offsets,
            base.disc_radius_m - spec.wall_tolerance_m,
            hull,
            spec.horizon_steps,
            spec.stride_steps,
            spec.doubt_mps,
            STEP_S,
            out,
        )
        return out.tolist()

    margins = [other.margin_m for other in others]
    # a robot that stands too near to somebody already could not leave if it had to keep more than it has
    if any(other.settled for other in others):
        for k, (gap, *_) in enumerate(trials(_CANDIDATES[:1])[0]):  # of standing still
            margins[k] = min(spec.still_margin_m, gap) if others[k].settled else margins[k]
    dx, dz = goal_x - here_x, goal_z - here_z
    length = math.hypot(dx, dz)
    # close to the goal its bearing turns around with every centimetre
    arc = abs(wrap_angle(math.atan2(-dz, dx) - heading)) if length > 0.1 else math.inf
    gaps = trials(np.array([wanted], np.float64), length, arc)[0]
    if all(gap >= margin for (gap, *_), margin in zip(gaps, margins, strict=True)):
        return wanted
    best, least = wanted, math.inf
    candidates = _CANDIDATES if before is None else np.vstack([_CANDIDATES, before])
    for (forward, turn), tried in zip(candidates.tolist(), trials(candidates), strict=True):
        # only the worst gap counts: more room on one side must not make up for less on the other
        lacks = max(margin - gap for margin, (gap, *_) in zip(margins, tried, strict=True))
        # where the base gets does not depend on who is near, so any trial tells
        _, x, z, new_heading = tried[0]
        left = math.hypot(x - goal_x, z - goal_z)
        off = abs(wrap_angle(math.atan2(z - goal_z, goal_x - x) - new_heading)) if left > 0.1 else 0.0
        cost = spec.gap_weight * max(lacks, 0.0) + left + spec.heading_weight_m * off
        cost += spec.turn_weight_m * abs(turn)
        if before is not None:
            cost += spec.change_weight_m * (abs(turn - before[1]) + abs(forward - before[0]))
        if cost < least:
            best, least = (forward, turn), cost
    return best


def eased(base: BaseSpec, wanted: tuple[float, float], before: tuple[float, float]) -> tuple[float, float]:
    """Return the command (forward, turn: -1..1 of the limits) one step further from ``before`` towards ``wanted``.

    It stops turning at once, to end where it wants to.
    """
    spec, speed = AVOIDANCE, STEP_S / base.max_speed_mps
    forward = _within(wanted[0], before[0], spec.accel_mps2 * speed, spec.brake_mps2 * speed)
    return forward, _within(wanted[1], before[1], spec.turn_accel_rad_s2 * STEP_S / base.max_turn_rad_s, 1.0)


def _within(wanted: float, before: float, up: float, down: float) -> float:
    """``wanted``, or what is nearest to it if a size may grow by ``up`` and shrink by ``down``."""
    # mirrored, because to brake is to make a number smaller in size, whatever its sign
    if before < 0.0:
        return -_within(-wanted, -before, up, down)
    return min(max(wanted, before - down, -up), before + up)


def braking_speed(accel: float, left: float, last: float = 0.0) -> float:
    """Returns the speed from which braking at a rate ends with speed ``last`` after what is left of a way or a turn."""
    return math.sqrt(2.0 * accel * max(left, 0.0) + last * last)


@lru_cache(maxsize=64)
def _discs(base: BaseSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offsets of a base's discs and of those of its hull [m]."""
    return np.array(base.disc_offsets_m), np.array(hull_of(base))


def is_crowded(base: BaseSpec, stands: NDArray, other: ObstacleDisc, margin_m: float) -> NDArray[np.bool_]:
    """Returns whether a robot at stands ``(x, z, heading)`` [N, 3] would be within a margin [m] of another agent now, [N]."""
    reach, (_, hull) = base.disc_radius_m + other.radius_m, _discs(base)
    other_x, other_z = other.xz.tolist()
    gaps = [least_gap(x, z, heading, other_x, other_z, hull, reach) for x, z, heading in stands.tolist()]
    return np.array(gaps) < margin_m
