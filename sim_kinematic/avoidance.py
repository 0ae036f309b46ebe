"""A robot's base that keeps clear of a person: short trials of what it could do next, in the manner of the dynamic window
(Fox, Burgard and Thrun 1997), against where she will be if she goes on as she does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.spec import STEP_S, BaseSpec
from sim_kinematic.step import integrate, least_clearance

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
    """Free way that is kept between both."""
    person_radius_m: float = 0.35
    discs_m: tuple[float, ...] = (-0.3, 0.0, 0.4)
    """Discs of the base's radius that stand for the whole robot, hind legs to hand, along its x axis."""
    weight: float = 8.0
    """Metres of way that a metre of lacking room is worth."""


AVOIDANCE = AvoidanceSpec()


@kernel(error_model="numpy")
def _least_gap(x, z, heading, person_x, person_z, discs, radius):
    least = math.inf
    for offset in discs:
        dx = x + math.cos(heading) * offset - person_x
        dz = z - math.sin(heading) * offset - person_z
        least = min(least, math.hypot(dx, dz) - radius)
    return least


@kernel(error_model="numpy")
def try_command(
    sdf, origin, cell, x, z, heading, speed, turn, person, velocity, offsets, base_radius, discs, radius, steps, stride, dt
):
    """Least gap [m] to the person while the base keeps a command for a while, and where it is in the end: ``(gap, x, z)``.

    It stays where it would touch an obstacle; the first moments count most: there her motion is known best.
    """
    gap = math.inf
    for step in range(1, steps + 1):
        nx, nz, nh = integrate(x, z, heading, speed, 0.0, turn, dt)
        if least_clearance(sdf, origin, cell, nx, nz, nh, offsets) >= base_radius - 2e-3:
            x, z, heading = nx, nz, nh
        if step % stride == 0:
            t = step * dt
            now = _least_gap(x, z, heading, person[0] + velocity[0] * t, person[1] + velocity[1] * t, discs, radius)
            gap = min(gap, now + 0.25 * t)
    return gap, x, z


def keep_clear(
    free: FreeSpace, base: BaseSpec, xz: NDArray, heading: float, wanted: tuple[float, float], towards: NDArray,
    person_xz: NDArray, person_velocity: NDArray, spec: AvoidanceSpec = AVOIDANCE,
) -> tuple[float, float]:  # fmt: skip
    """The command (forward, turn: -1..1 of the limits) to give instead of ``wanted`` so that a person is not run into.

    ``wanted`` itself where it leaves her enough room, else the best of 25: room first, then way to ``towards`` [2].
    """
    if np.hypot(*(person_xz - xz)) > spec.range_m:
        return wanted

    def trial(command: tuple[float, float]) -> tuple[float, float, float]:
        return try_command(
            free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, command[0] * base.max_speed_mps,
            command[1] * base.max_turn_rad_s, person_xz, person_velocity, np.array(base.disc_offsets_m),
            base.disc_radius_m, np.array(spec.discs_m), base.disc_radius_m + spec.person_radius_m,
            spec.horizon_steps, spec.stride, STEP_S,
        )  # fmt: skip

    if trial(wanted)[0] >= spec.margin_m:
        return wanted
    best, least = wanted, math.inf
    for forward, turn in ((0.0, 0.0), *_CANDIDATES.tolist()):
        gap, x, z = trial((forward, turn))
        cost = spec.weight * max(spec.margin_m - gap, 0.0) + math.hypot(x - towards[0], z - towards[1])
        cost += 0.02 * abs(turn)  # of equals the calmest
        if cost < least:
            best, least = (forward, turn), cost
    return best
