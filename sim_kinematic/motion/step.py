"""Step of a robot's base: the scalar definition in numba, readable with ``NUMBA_DISABLE_JIT=1``, looped over worlds.

A velocity command moves the base first along its old heading and then turns it, as in Habitat (spec/habitat.md 0). The
base is a row of discs, each of which must keep its radius from every obstacle of the signed distance grid. Sliding is
strict: a move that cannot be made free of penetration is given up part by part (research: navigation-and-stepping 3.2).
The spec can choose the sliding of another package instead (`SLIDES`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, get_args

import numpy as np

from h3data.errors import InputError
from h3data.kernels import kernel, kernel_part
from h3data.plugins import Registry
from h3data.scene import FreeSpace
from h3data.scene.floor_heights import way_to_stairs
from h3data.scene.freespace.free_space import sample_sdf, sdf_gradient
from sim_kinematic.motion.spec import STEP_S, BaseSpec, Slide
from sim_kinematic.motion.state import AgentState, RobotState

STAIRS_SHARE, STAIRS_NEAR_M = 0.4, 0.6
"""Share of their speed, in the plan view, at which robots move on stairs; and distance before stairs from which on they
slow down [m]."""
SLIDES: Registry[Callable[..., None]] = Registry("h3data.slides", {}, what="way to slide along walls")
"""Alternatives to strict sliding along walls, by name: ``habitat`` is `h3data_habitat.navmesh.slide.slide_bases`."""
APART_ITERATIONS, APART_TOLERANCE_M = 4, 1e-6
"""Number of iterations in which discs push each other apart, and overlap below which they count as apart [m]."""


@kernel(error_model="numpy")
def wrap_angle(angle):
    """Return the angle in [-pi, pi) [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@kernel(error_model="numpy", inline="always")  # called, it would count references: `drive_base` is 15% faster
def least_clearance(sdf, origin, cell, x, z, heading, offsets):
    """Return the smallest signed distance [m] from the centres of the base's discs to an obstacle."""
    return clearance_along(sdf, origin, cell, x, z, math.cos(heading), math.sin(heading), offsets)


@kernel(error_model="numpy", inline="always")
def clearance_along(sdf, origin, cell, x, z, c, s, offsets):
    """Return the result of `least_clearance` for a heading whose cosine ``c`` and sine ``s`` are known."""
    least = math.inf
    for offset in offsets:
        least = min(least, sample_sdf(sdf, origin, cell, x + c * offset, z - s * offset))
    return least


@kernel(error_model="numpy", inline="always")
def are_clear(sdf, origin, cell, x, z, c, s, offsets, radius):
    """Return whether all discs of a base keep ``radius`` [m] from every obstacle, faster than `clearance_along`."""
    for offset in offsets:  # noqa: SIM110  (numba compiles no generators)
        if sample_sdf(sdf, origin, cell, x + c * offset, z - s * offset) < radius:
            return False
    return True


@kernel(error_model="numpy", inline="always")
def push_out(sdf, origin, cell, x, z, c, s, offsets, radius, iterations):
    """Move a base until its discs keep their radius from obstacles, as far as possible.

    ``c`` and ``s`` are the cosine and the sine of its heading. Returns ``(x, z, clearance)``: the new position, and the
    `least_clearance` there.
    """
    for _ in range(iterations):
        free, least = True, math.inf
        # one disc after the other, each from where the last one left the base: pushed at once, two would push
        # twice
        for offset in offsets:
            cx, cz = x + c * offset, z - s * offset
            distance = sample_sdf(sdf, origin, cell, cx, cz)
            least = min(least, distance)
            if distance < radius:
                gx, gz = sdf_gradient(sdf, origin, cell, cx, cz)
                length = math.sqrt(gx * gx + gz * gz)
                # on a ridge between two obstacles the gradient gives no direction
                if length > 1e-9:
                    x += gx / length * (radius - distance)
                    z += gz / length * (radius - distance)
                    free = False
        if free:
            return x, z, least
    return x, z, clearance_along(sdf, origin, cell, x, z, c, s, offsets)


@kernel(error_model="numpy")
def integrate(x, z, heading, speed, lateral, turn, dt):
    """Return the pose ``(x, z, heading)`` of a base after a step of free motion.

    The base moves along its old axes, then turns (spec/habitat.md 0). ``speed`` [m/s] is along its x axis, ``lateral``
    [m/s] to its left, and ``turn`` [rad/s] to the left.
    """
    return integrate_along(x, z, heading, math.cos(heading), math.sin(heading), speed, lateral, turn, dt)


@kernel(error_model="numpy", inline="always")
def integrate_along(x, z, heading, c, s, speed, lateral, turn, dt):
    """Return the result of `integrate` for a heading whose cosine ``c`` and sine ``s`` are known."""
    # positive angles turn from x towards -z (docs conventions), hence the minus in z
    return x + (c * speed - s * lateral) * dt, z - (s * speed + c * lateral) * dt, heading + turn * dt


@kernel_part(borrows=True, error_model="numpy")
def drive_base(
    sdf, origin, cell, x, z, heading, speed, lateral, turn, dt, offsets, radius, iterations, tolerance, touch, most
):
    """Return one strict step of a robot base: ``(x, z, heading, touched)``; the velocities are those of `integrate`.

    ``most`` is the farthest that the base may get [m].
    """
    rules, turned = (offsets, radius, iterations, tolerance, touch, most), heading + turn * dt
    old, new = (heading, math.cos(heading), math.sin(heading)), (turned, math.cos(turned), math.sin(turned))
    x, z, (heading, _, _), touched = drive_facing(sdf, origin, cell, x, z, old, new, speed, lateral, turn, dt, rules)
    return x, z, heading, touched


@kernel(error_model="numpy", inline="always")
def drive_facing(sdf, origin, cell, x, z, old, new, speed, lateral, turn, dt, rules):
    """Return the result of `drive_base`, with headings as tuples of angle, cosine and sine: now, and after the turn."""
    offsets, radius, iterations, tolerance, touch, most = rules
    _, c, s = new
    tx, tz, _ = integrate_along(x, z, old[0], old[1], old[2], speed, lateral, turn, dt)
    limit = radius - tolerance
    sx, sz, clearance = push_out(sdf, origin, cell, tx, tz, c, s, offsets, radius, iterations)
    if clearance >= radius and sx == tx and sz == tz:  # to ask before costs bases at walls a tenth of their speed
        return tx, tz, new, False
    # a push-out may not carry the base farther than the command itself could have
    reach = math.hypot(speed, lateral) * dt + 2.0 * radius * abs(turn) * dt + tolerance
    # smaller displacements come from the grid and are no contact
    touched = math.hypot(sx - tx, sz - tz) > touch
    far = math.hypot(sx - x, sz - z)
    if most < far <= reach:
        # sliding may not be faster than driving: cut back along the line, then asked again for room
        sx, sz, touched = x + (sx - x) * (most / far), z + (sz - z) * (most / far), True
        clearance = clearance_along(sdf, origin, cell, sx, sz, c, s, offsets)
    if clearance >= limit and far <= reach:
        return sx, sz, new, touched
    # what has no room is tried again with less: without the turn, then only the turn, then neither
    if new[0] == old[0]:
        return x, z, old, True
    _, c, s = old
    sx, sz, clearance = push_out(sdf, origin, cell, tx, tz, c, s, offsets, radius, iterations)
    far = math.hypot(sx - x, sz - z)
    if most < far <= reach:
        sx, sz = x + (sx - x) * (most / far), z + (sz - z) * (most / far)
        clearance = clearance_along(sdf, origin, cell, sx, sz, c, s, offsets)
    if clearance >= limit and far <= reach:
        return sx, sz, old, True
    if are_clear(sdf, origin, cell, x, z, new[1], new[2], offsets, limit):
        return x, z, new, True
    return x, z, old, True


@kernel(error_model="numpy")
def keep_apart(sdf, origin, cell, x, z, tx, tz, discs, radius, limit):
    """Move a disc from (x, z) towards (tx, tz) without entering other discs ``(x, z, radius)`` [N, 3].

    It slides along them as along walls. A disc that overlaps another one already may move away from it, but not closer.

    Args:
        sdf: signed distances of the floor's grid [m].
        origin: position of the grid.
        cell: size of its cells [m].
        x: position of the disc along x [m].
        z: position of the disc along z [m].
        tx: position that it moves towards along x [m].
        tz: position that it moves towards along z [m].
        discs: other discs ``(x, z, radius)`` [N, 3] [m].
        radius: radius of the disc [m].
        limit: least clearance from walls [m].

    Returns:
        ``(x, z, touched)``.
    """
    sx, sz, touched = tx, tz, False
    for _ in range(APART_ITERATIONS):
        free = True
        for k in range(len(discs)):
            ox, oz = discs[k, 0], discs[k, 1]
            # never more than the present distance: whoever overlaps already may leave, and is not thrown
            # out
            least = min(radius + discs[k, 2], math.hypot(x - ox, z - oz))
            far = math.hypot(sx - ox, sz - oz)
            if 1e-9 < far < least - APART_TOLERANCE_M:
                sx, sz = ox + (sx - ox) / far * least, oz + (sz - oz) / far * least
                free, touched = False, True
        if free:
            break
    if not touched:
        return tx, tz, False
    # pushed out of one disc it may have got into another, where the attempts ran out
    for k in range(len(discs)):
        least = min(radius + discs[k, 2], math.hypot(x - discs[k, 0], z - discs[k, 1]))
        if math.hypot(sx - discs[k, 0], sz - discs[k, 1]) < least - 2.0 * APART_TOLERANCE_M:
            return x, z, True
    # what pushes them aside pushes them neither into walls nor farther than they wanted to walk
    far = math.hypot(sx - x, sz - z) > math.hypot(tx - x, tz - z) + APART_TOLERANCE_M
    if far or sample_sdf(sdf, origin, cell, sx, sz) < limit:
        return x, z, True
    return sx, sz, True


@kernel(error_model="numpy")
def keep_worlds_apart(sdf, origin, cell, before, xz, contact, discs, radius, limit):
    """Apply `keep_apart` in W worlds, in place: ``before`` and ``xz`` [W, 2], ``contact`` [W], ``discs`` [W, N, 3]."""
    for w in range(len(xz)):
        xz[w, 0], xz[w, 1], touched = keep_apart(
            sdf, origin, cell, before[w, 0], before[w, 1], xz[w, 0], xz[w, 1], discs[w], radius, limit
        )
        contact[w] = contact[w] or touched


@kernel(error_model="numpy")
def first_not_finite(rows):
    """Return the index of the first row of ``rows`` [W, n] with NaN or infinity, or -1 if there is none."""
    for w in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            if not math.isfinite(rows[w, k]):
                return w
    return -1


@kernel(error_model="numpy")
def velocities(action, limits):
    """Return the velocities that an action [2 or 3] stands for, each component clipped to -1..1 of its limit.

    ``limits`` are speed [m/s], lateral speed [m/s], turn rate [rad/s], and the share of the speed allowed backwards.
    Returns ``(speed, lateral, turn)``.
    """
    # limits[3] is 0 or 1: a base that may not drive backwards stands still instead
    speed = min(max(action[0], -limits[3]), 1.0) * limits[0]
    lateral = min(max(action[2], -1.0), 1.0) * limits[1] if len(action) > 2 else 0.0
    return speed, lateral, min(max(action[1], -1.0), 1.0) * limits[2]


@kernel(error_model="numpy")
def drive_worlds(
    sdf, origin, cell, xz, heading, contact, action, limits, dt, offsets, radius, iterations, tolerance, touch, most
):
    """Apply `drive_base` in W worlds, in place; return the first world with a non-finite action [W, 2 or 3], or -1."""
    broken = first_not_finite(action)
    if broken >= 0:
        return broken
    for w in range(len(heading)):
        speed, lateral, turn = velocities(action[w], limits)
        # a base that is not driven keeps its place to the last bit, and touches nothing
        contact[w] = False
        if speed != 0.0 or lateral != 0.0 or turn != 0.0:
            xz[w, 0], xz[w, 1], heading[w], contact[w] = drive_base(
                sdf,
                origin,
                cell,
                xz[w, 0],
                xz[w, 1],
                heading[w],
                speed,
                lateral,
                turn,
                dt,
                offsets,
                radius,
                iterations,
                tolerance,
                touch,
                most,
            )
    return -1


@kernel(error_model="numpy")
def _aim_worlds(xz, heading, action, limits, dt, goals, drives):
    """Write the poses that bases would reach without obstacles to ``goals`` [W, 3], and whether they move to ``drives``."""
    broken = first_not_finite(action)
    if broken >= 0:
        return broken
    for w in range(len(heading)):
        speed, lateral, turn = velocities(action[w], limits)
        drives[w] = speed != 0.0 or lateral != 0.0 or turn != 0.0
        goals[w] = integrate(xz[w, 0], xz[w, 1], heading[w], speed, lateral, turn, dt)
    return -1


def drive_robots(
    state: RobotState,
    free: FreeSpace,
    action: np.ndarray,
    spec: BaseSpec,
    *,
    dt: float = STEP_S,
    finder: Any = None,
) -> None:
    """Move a robot in all its worlds by one step, in place.

    On stairs and right before them robots drive at `STAIRS_SHARE` of the commanded velocity.

    Args:
        state: state of the robot.
        free: free floor.
        action: forward velocity and left turn, -1..1 of the limits, [W, 2]; with ``spec.max_lateral_mps`` the velocity to
            the left follows, [W, 3].
        spec: limits of the base.
        dt: duration of the step [s].
        finder: the `h3data_habitat.navmesh.pathfinder.PathFinder` for ``slide="habitat"``; by default one is made of ``free``
            and cached.

    Raises:
        InputError: the actions have another shape, or one is not finite; then nothing moves. Or the package that slides
            bases in this way is not there.
    """
    # before anything moves: the kernels check no bounds
    action = per_world(action, state, width=3 if spec.max_lateral_mps else 2)
    if free.has_stairs:
        # `per_world` hands on the caller's own array where it is float64 already
        action = action.copy()
        action[:, (0, *range(2, action.shape[1]))] *= stairs_speeds(free.heights, state.xz)[:, None]
    limits = (spec.max_speed_mps, spec.max_lateral_mps, spec.max_turn_rad_s, float(spec.allow_back))
    moved = state.xz, state.heading, state.contact
    offsets = cached_offsets(spec.disc_offsets_m)
    if spec.slide == "strict":
        broken = drive_worlds(
            free.sdf,
            free.origin,
            free.cell_m,
            *moved,
            action,
            limits,
            dt,
            offsets,
            spec.disc_radius_m,
            spec.slide_iterations,
            spec.clearance_tolerance_m,
            spec.contact_tolerance_m,
            spec.farthest_m(dt),
        )
    elif spec.slide == "habitat":
        slide, goals, drives = SLIDES.get(spec.slide), np.empty((len(action), 3)), np.empty(len(action), np.bool_)
        broken = _aim_worlds(state.xz, state.heading, action, limits, dt, goals, drives)
        if broken < 0:
            slide(
                free,
                finder,
                moved=moved,
                goals=goals,
                drives=drives,
                offsets=offsets,
                touch_m=spec.contact_tolerance_m,
                root_height_m=spec.habitat.root_height_m,
                rules=(spec.habitat.slides, spec.habitat.slides_while_turning, spec.habitat.navmesh_slides),
            )
    else:
        raise InputError(
            f"Unknown slide {spec.slide!r}. Expected one of: {', '.join(get_args(Slide))}.", code="H3-SIM-036"
        )
    if broken >= 0:
        raise InputError(f"Actions must be finite. That of world {broken} is {action[broken]}.", code="H3-SIM-034")


@kernel(error_model="numpy")
def _stairs_speeds(heights, xz, out):
    for w in range(len(xz)):
        near = 1.0 - min(way_to_stairs(heights, xz[w, 0], xz[w, 1]) / STAIRS_NEAR_M, 1.0)
        out[w] = 1.0 - (1.0 - STAIRS_SHARE) * near


def stairs_speeds(heights: np.ndarray, xz: np.ndarray) -> np.ndarray:
    """Return the shares [W] of its usual speed of a robot at ``xz`` [W, 2]: less on and before stairs."""
    shares = np.empty(len(xz))
    _stairs_speeds(heights, xz, shares)
    return shares


def discs_at(xz: np.ndarray, heading: np.ndarray, offsets_m: tuple[float, ...], radius_m: float) -> np.ndarray:
    """Return the discs ``(x, z, radius)`` [W, D, 3] of a base at ``xz`` [W, 2], centred at D offsets along its axis."""
    along = cached_offsets(tuple(offsets_m))
    discs = np.empty((len(xz), len(along), 3))
    discs[:, :, 0] = xz[:, :1] + np.cos(heading)[:, None] * along
    discs[:, :, 1] = xz[:, 1:] - np.sin(heading)[:, None] * along
    discs[:, :, 2] = radius_m
    return discs


@lru_cache(maxsize=64)
def cached_offsets(disc_offsets_m: tuple[float, ...]) -> np.ndarray:
    """Return the offsets of discs [D] [m] as an array, cached: to make one takes a tenth of the step of one world."""
    return np.array(disc_offsets_m, np.float64)


def per_world(rows: np.ndarray, state: AgentState, *, width: int) -> np.ndarray:
    """Return ``width`` numbers for each world, float64 [W, width], as the kernels check no bounds."""
    rows = np.asarray(rows, np.float64)
    worlds = len(state.heading)
    if rows.shape != (worlds, width):
        raise InputError(
            f"Expected shape {[worlds, width]}: {width} numbers per world, got {list(rows.shape)}.", code="H3-SIM-035"
        )
    return rows
