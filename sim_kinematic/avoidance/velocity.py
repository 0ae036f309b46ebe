"""A robot's base that keeps clear of people and other robots: short trials of what it could do next, in the manner of the
dynamic window (Fox, Burgard and Thrun 1997), against where they will be if they go on as they do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.step import integrate, least_clearance, wrap_angle

_LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_CANDIDATES = np.array([(forward, turn) for forward in _LEVELS for turn in _LEVELS])


@dataclass(frozen=True, kw_only=True)
class AvoidanceSpec:
    """How far ahead, and how much room."""

    range_m: float = 4.0
    """A person farther away is not heeded."""
    horizon_steps: int = 24
    stride: int = 3
    """Steps between the moments that are looked at."""
    margin_m: float = 0.35
    """Free way that is kept between both,"""
    still_margin_m: float = 0.0
    """and when she has long been standing."""
    still_steps: int = 75
    """So long: more than picking or placing takes."""
    person_radius_m: float = 0.35
    discs_m: tuple[float, ...] = (-0.3, 0.0, 0.4)
    """Discs of the base's radius that stand for the whole robot, hind legs to hand, along its x axis."""
    weight: float = 8.0
    """Metres of way that a metre of lacking room is worth,"""
    facing_m: float = 0.1
    """and a radian by which it looks elsewhere."""


AVOIDANCE = AvoidanceSpec()


@kernel(error_model="numpy")
def least_gap(x, z, heading, person_x, person_z, discs, radius):
    least = math.inf
    for offset in discs:
        dx = x + math.cos(heading) * offset - person_x
        dz = z - math.sin(heading) * offset - person_z
        least = min(least, math.hypot(dx, dz) - radius)
    return least


@kernel(error_model="numpy")
def try_command(
    sdf, origin, cell, x, z, heading, speed, turn, way, arc, person, velocity, offsets, base_radius, discs, radius, steps,
    stride, dt,
):  # fmt: skip
    """Least gap [m] to the person while the base keeps a command, for ``way`` [m] and ``arc`` [rad] at most, and its end:
    ``(gap, x, z, heading)``.

    It stays where it would touch an obstacle; the first moments count most: there her motion is known best.
    """
    gap = math.inf
    for step in range(1, steps + 1):
        if abs(speed) * step * dt > way:
            speed = 0.0
        if abs(turn) * (step - 0.5) * dt > arc:
            turn = 0.0
        nx, nz, nh = integrate(x, z, heading, speed, 0.0, turn, dt)
        if least_clearance(sdf, origin, cell, nx, nz, nh, offsets) >= base_radius - 2e-3:
            x, z, heading = nx, nz, nh
        if step % stride == 0:
            t = step * dt
            now = least_gap(x, z, heading, person[0] + velocity[0] * t, person[1] + velocity[1] * t, discs, radius)
            gap = min(gap, now + 0.25 * t)
    return gap, x, z, heading


class Avoided(NamedTuple):
    """Somebody whom a robot keeps clear of."""

    xz: NDArray
    velocity: NDArray
    """[2] [m/s]."""
    settled: bool = False
    """Who has settled somewhere needs less room: one must get past."""
    spec: AvoidanceSpec = AVOIDANCE


def keep_clear(
    free: FreeSpace, base: BaseSpec, xz: NDArray, heading: float, wanted: tuple[float, float], towards: NDArray,
    others: Sequence[Avoided],
) -> tuple[float, float]:  # fmt: skip
    """The command (forward, turn: -1..1 of the limits) to give instead of ``wanted`` so that nobody is run into.

    ``wanted`` itself where it leaves all of them enough room, else the best of 25: room first, for the one who has least,
    then way to ``towards`` [2].
    """
    others = [other for other in others if np.hypot(*(other.xz - xz)) <= other.spec.range_m]
    if not others:
        return wanted

    def trial(
        other: Avoided, command: tuple[float, float], way: float = math.inf, arc: float = math.inf
    ) -> tuple[float, float, float, float]:
        spec = other.spec
        return try_command(
            free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, command[0] * base.max_speed_mps,
            command[1] * base.max_turn_rad_s, way, arc, other.xz, other.velocity, np.array(base.disc_offsets_m),
            base.disc_radius_m, np.array(spec.discs_m), base.disc_radius_m + spec.person_radius_m,
            spec.horizon_steps, spec.stride, STEP_S,
        )  # fmt: skip

    margins = [
        min(o.spec.still_margin_m, trial(o, (0.0, 0.0))[0]) if o.settled else o.spec.margin_m for o in others
    ]  # fmt: skip
    dx, dz = (towards - xz).tolist()
    way = math.hypot(dx, dz)
    arc = abs(wrap_angle(math.atan2(-dz, dx) - heading)) if way > 0.1 else math.inf
    if all(trial(other, wanted, way, arc)[0] >= margin for other, margin in zip(others, margins, strict=True)):
        return wanted
    spec = others[0].spec
    best, least = wanted, math.inf
    for forward, turn in ((0.0, 0.0), *_CANDIDATES.tolist()):
        tried = [trial(other, (forward, turn)) for other in others]
        lacks = max(margin - gap for margin, (gap, *_) in zip(margins, tried, strict=True))
        _, x, z, new_heading = tried[0]
        left = math.hypot(x - towards[0], z - towards[1])
        off = abs(wrap_angle(math.atan2(z - towards[1], towards[0] - x) - new_heading)) if left > 0.1 else 0.0
        cost = spec.weight * max(lacks, 0.0) + left + spec.facing_m * off
        cost += 0.02 * abs(turn)  # of equals the calmest
        if cost < least:
            best, least = (forward, turn), cost
    return best


def is_crowded(
    base: BaseSpec, stands: NDArray, person_xz: NDArray, spec: AvoidanceSpec = AVOIDANCE
) -> NDArray[np.bool_]:
    """At which stands ``(x, z, heading)`` [N, 3] a robot would be too near to where a person is now."""
    radius = base.disc_radius_m + spec.person_radius_m
    discs = np.array(spec.discs_m)
    gaps = [least_gap(x, z, heading, person_xz[0], person_xz[1], discs, radius) for x, z, heading in stands]
    return np.array(gaps) < spec.margin_m
