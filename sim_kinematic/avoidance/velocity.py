"""Velocity of a robot's base for keeping clear of people and other robots.

The robot compares possible next commands by short simulations, as in the dynamic window approach (Fox, Burgard and
Thrun, 1997). The other agents are assumed to keep their velocity.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.yielding import RULES, Neighbours, discs_to_avoid
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_worlds, integrate_along, least_clearance, wrap_angle

# standing still comes first: of equal commands the first one wins
_CANDIDATES = np.array([(0.0, 0.0), *itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=2)])


@kernel(error_model="numpy")
def least_gap(x, z, heading, other_x, other_z, hull, reach):
    """Return the least distance [m] between the discs of a hull and a floor point, minus the radii ``reach``."""
    return gap_along(x, z, math.cos(heading), math.sin(heading), other_x, other_z, hull, reach)


@kernel(error_model="numpy", inline="always")
def gap_along(x, z, c, s, other_x, other_z, hull, reach):
    """Return the result of `least_gap` for a heading whose cosine ``c`` and sine ``s`` are known."""
    least = math.inf
    for offset in hull:
        dx = x + c * offset - other_x
        dz = z - s * offset - other_z
        least = min(least, math.hypot(dx, dz) - reach)
    return least


@kernel(error_model="numpy")
def try_command(sdf, origin, cell, pose, room, speed, turn, length, arc, others, base, hull, rules, enough, gaps):
    """Roll out a command that is held for at most ``length`` [m] and ``arc`` [rad].

    Returns ``(x, z, heading, most lacking)``: the final pose, and the largest part of a margin that is lacking [m]. The
    base stops where it would touch an obstacle; at first it has ``room`` [m] to the nearest one. The least gap to each
    other agent is written to ``gaps`` [N]; later gaps count as wider by a rate [m/s]. The trial ends early when an agent
    already lacks ``enough`` of its margin.
    """
    (x, z, heading), (offsets, disc_radius), (steps, stride, doubt, dt) = pose, base, rules
    gaps[:] = math.inf
    lacks, c, s, far = -math.inf, math.cos(heading), math.sin(heading), np.abs(offsets).max()
    was_speed = was_turn = math.nan  # of a step that the floor has stopped
    for step in range(1, steps + 1):
        if abs(speed) * step * dt > length:
            speed = 0.0
        # rounded to the nearest step, so that a turn neither stops short nor overshoots by a whole one
        if abs(turn) * (step - 0.5) * dt > arc:
            turn = 0.0
        # the same step from the same place is stopped again
        if speed != was_speed or turn != was_turn:
            nx, nz, nh = integrate_along(x, z, heading, c, s, speed, 0.0, turn, dt)
            nc, ns = (math.cos(nh), math.sin(nh)) if turn != 0.0 else (c, s)
            # the signed distance changes by up to the square root of 2 per metre between its samples: it is looked up
            # only where there may be no room any more
            room -= math.sqrt(2.0) * dt * (abs(speed) + abs(turn) * far) + 1e-9
            if room <= 0.0:
                room = least_clearance(sdf, origin, cell, nx, nz, nh, offsets) - disc_radius
            if room >= 0.0:
                x, z, heading, c, s = nx, nz, nh, nc, ns
            else:
                was_speed, was_turn = speed, turn
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
    sdf, origin, cell, pose, goal, wanted, length, arc, others, base, hull, limits, rules, costs, before, gaps
):
    """Return the number of the candidate that `keep_clear` chooses, or -1 for the command that is ``wanted``.

    The rows of ``others`` [N, 7] are ``(x, z, velocity x, velocity z, sum of both radii, margin, settled)``. ``before``
    is the last candidate, or NaN if it does not count. ``gaps`` [N] is a work array.
    """
    (max_speed, max_turn), (still_margin, gap_weight, heading_weight, turn_weight, change_weight) = limits, costs
    room = least_clearance(sdf, origin, cell, pose[0], pose[1], pose[2], base[0]) - base[1]
    # a robot that stands too near to somebody already could not leave if it had to keep more than it has
    if others[:, 6].any():
        forward, turn = _CANDIDATES[0, 0] * max_speed, _CANDIDATES[0, 1] * max_turn  # of standing still
        try_command(
            sdf, origin, cell, pose, room, forward, turn, math.inf, math.inf, others, base, hull, rules, math.inf, gaps
        )
        for n in range(len(others)):
            if others[n, 6] != 0.0:
                others[n, 5] = min(still_margin, gaps[n])
    forward, turn = wanted[0] * max_speed, wanted[1] * max_turn
    _, _, _, lacks = try_command(
        sdf, origin, cell, pose, room, forward, turn, length, arc, others, base, hull, rules, 0.0, gaps
    )
    if lacks <= 0.0:
        return -1
    best, least, counts = -1, math.inf, not math.isnan(before[0])
    for n in range(len(_CANDIDATES) + counts):
        # the last command first: it is often good, and what is worse is left the sooner
        c = n - counts if n >= counts else len(_CANDIDATES)
        forward, turn = (_CANDIDATES[c, 0], _CANDIDATES[c, 1]) if c < len(_CANDIDATES) else before
        # only the worst gap counts: more room on one side must not make up for less on the other
        x, z, heading, lacks = try_command(
            sdf,
            origin,
            cell,
            pose,
            room,
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
        # of equal ones the first in the table, in whatever order they are tried
        if cost < least or (cost == least and c < best):
            best, least = c, cost
    return best


@kernel(error_model="numpy")
def _within(wanted, before, up, down):
    """Return the value nearest to ``wanted`` if the size of ``before`` may grow by ``up`` and shrink by ``down``."""
    # mirrored, because to brake is to make a number smaller in size, whatever its sign
    sign = -1.0 if before < 0.0 else 1.0
    value, least, most = sign * wanted, max(sign * before - down, -up), sign * before + up
    # of equal numbers the first, as Python's `min` and `max`: 0.0 and -0.0 differ in recordings
    value = least if least > value else value
    return sign * (most if most < value else value)


@kernel(error_model="numpy")
def clear_step(
    sdf, origin, cell, xz, heading, contact, wanted, goal, length, others, base, target, before, eases, drives
):
    """Choose the command of a robot's base in a step and drive by it; return the avoiding command and the one driven.

    Args:
        sdf: signed distances of the floor's grid [m].
        origin: position of the grid.
        cell: size of its cells [m].
        xz: place of the base [1, 2].
        heading: its heading [1].
        contact: whether it touches an obstacle [1]; ``xz``, ``heading`` and ``contact`` are changed in place.
        wanted: command (forward, turn: -1..1 of the limits).
        goal: floor point [2] to which the base is going.
        length: distance to the goal [m].
        others: rows of `choose_command` [N, 7].
        base: `base_numbers` of the base.
        target: command that kept clear of others in the last step; NaN where it does not count.
        before: command of the last step.
        eases: whether the command changes gradually from ``before``, unless an agent has to be avoided.
        drives: whether the base drives; otherwise nothing is changed.
    """
    keeps, (offsets, hull, limits, radius, sliding, wall, rules, costs, rates) = wanted, base
    if len(others):
        # close to the goal its bearing turns around with every centimetre
        bearing = math.atan2(-(goal[1] - xz[0, 1]), goal[0] - xz[0, 0])
        chosen = choose_command(
            sdf,
            origin,
            cell,
            (xz[0, 0], xz[0, 1], heading[0]),
            goal,
            wanted,
            length,
            abs(wrap_angle(bearing - heading[0])) if length > 0.1 else math.inf,
            others,
            (offsets, wall),
            hull,
            (limits[0], limits[2]),
            rules,
            costs,
            target,
            np.empty(len(others)),
        )
        if chosen >= 0:
            keeps = (_CANDIDATES[chosen, 0], _CANDIDATES[chosen, 1]) if chosen < len(_CANDIDATES) else target
    command = keeps
    # what keeps it clear of somebody is done at once: eased, it came 12 cm nearer to a person than it wanted
    if eases and keeps == wanted:
        # it stops turning at once, to end where it wants to
        command = _within(keeps[0], before[0], rates[0], rates[1]), _within(keeps[1], before[1], rates[2], 1.0)
    if drives:
        action = np.array(command).reshape(1, 2)
        drive_worlds(sdf, origin, cell, xz, heading, contact, action, limits, STEP_S, offsets, radius, *sliding)
    return keeps, command


@kernel(error_model="numpy")
def clear_of_others(
    sdf,
    origin,
    cell,
    xz,
    heading,
    contact,
    wanted,
    goal,
    agents,
    offsets,
    heeded,
    held_by,
    agreed,
    rules,
    base,
    target,
    before,
    eases,
    drives,
):
    """Return the result of `clear_step` among the agents that `discs_to_avoid` finds near the base."""
    x, z = xz[0, 0], xz[0, 1]
    others = discs_to_avoid(x, z, agents, offsets, heeded, held_by, agreed, base[3], rules)
    length = math.hypot(goal[0] - x, goal[1] - z)
    return clear_step(
        sdf, origin, cell, xz, heading, contact, wanted, goal, length, others, base, target, before, eases, drives
    )


def keep_clear(
    free: FreeSpace,
    base: tuple[Any, ...],
    state: RobotState,
    wanted: tuple[float, float],
    towards: NDArray,
    others: Neighbours,
    held_by: NDArray[np.int64],
    target: tuple[float, float] | None = None,
    before: tuple[float, float] | None = None,
    *,
    drives: bool = False,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the command (forward, turn: -1..1 of the limits) that replaces ``wanted`` to keep clear of others.

    The result is ``wanted`` itself if it leaves every agent its margin, else the best of 25 candidates. They are
    compared by the largest lack of a margin, then by the path to ``towards`` [2], then by the difference from the
    command ``target``, if it counts. The second result is the command of this step, which changes gradually from
    ``before`` if that counts and no agent has to be avoided.

    Args:
        free: the floor.
        base: `base_numbers` of the base.
        state: state of the base; with ``drives`` it makes the step, sliding strictly, except on stairs.
        wanted: wanted command.
        towards: floor point [2] to which the base is going.
        others: other agents, of which the heeded ones count.
        held_by: number of the agent that holds each object, [K].
        target: first result of the last step.
        before: second result of the last step.
        drives: whether the base makes the step.
    """
    goal_x, goal_z = towards.tolist()
    return free.entries(
        clear_of_others,
        *(free.sdf, free.origin, free.cell_m),
        *(state.xz, state.heading, state.contact),
        (float(wanted[0]), float(wanted[1])),
        (goal_x, goal_z),
        *(others.agents, others.offsets, others.heeded, held_by, others.agreed, RULES),
        base,
        # NaN rather than None: the kernel is compiled for one type
        (math.nan, math.nan) if target is None else target,
        (0.0, 0.0) if before is None else before,
        before is not None,
        drives,
    )


def base_numbers(base: BaseSpec) -> tuple[Any, ...]:
    """Return the constants of a base that `clear_step` takes."""
    spec, speed, (offsets, hull) = AVOIDANCE, STEP_S / base.max_speed_mps, _discs(base)
    limits = (base.max_speed_mps, base.max_lateral_mps, base.max_turn_rad_s, float(base.allow_back))
    sliding = (base.clearance_tolerance_m, base.contact_tolerance_m, base.farthest_m(STEP_S))
    return (
        offsets,
        hull,
        tuple(map(float, limits)),
        float(base.disc_radius_m),
        (base.slide_iterations, *map(float, sliding)),
        float(base.disc_radius_m - spec.wall_tolerance_m),
        (spec.horizon_steps, spec.stride_steps, spec.doubt_mps, STEP_S),
        (spec.still_margin_m, spec.gap_weight, spec.heading_weight_m, spec.turn_weight_m, spec.change_weight_m),
        (spec.accel_mps2 * speed, spec.brake_mps2 * speed, spec.turn_accel_rad_s2 * STEP_S / base.max_turn_rad_s),
    )


def braking_speed(accel: float, left: float, last: float = 0.0) -> float:
    """Return the speed from which braking at a rate reaches the speed ``last`` after a remaining distance or angle."""
    return math.sqrt(2.0 * accel * max(left, 0.0) + last * last)


@lru_cache(maxsize=64)
def _discs(base: BaseSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the offsets of a base's discs and of those of its hull along its x axis [m]."""
    return np.array(base.disc_offsets_m, np.float64), np.array(hull_of(base), np.float64)


def crowding(base: BaseSpec, stands: NDArray, others: Neighbours) -> NDArray[np.int64]:
    """Rate how close a robot at stands ``(x, z, heading)`` [N, 3] would be to other agents at present, as int [N].

    The rating is 1 within the margin of an agent, 2 in contact with one, and 0 otherwise.
    """
    discs = others.beside(stands[0, :2] if len(stands) else np.zeros(2), base.disc_radius_m)[:, [0, 1, 4, 5]]
    return _crowding(
        np.ascontiguousarray(stands), np.ascontiguousarray(discs), _discs(base)[1], AVOIDANCE.still_margin_m
    )


@kernel(error_model="numpy")
def _crowding(stands, discs, hull, contact):
    """Return the ratings of `crowding` for discs ``(x, z, reach, margin)`` [M, 4] and gaps [m] below which is contact."""
    levels = np.zeros(len(stands), np.int64)
    for n in range(len(stands)):
        for disc in discs:
            gap = least_gap(stands[n, 0], stands[n, 1], stands[n, 2], disc[0], disc[1], hull, disc[2])
            levels[n] = max(levels[n], 2 if gap < contact else 1 if gap < disc[3] else 0)
    return levels
