"""Simulated trials of a robot's next commands in the presence of a walking person.

The experts of social navigation choose among these trials. The motion is that of the simulator itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import wrap_angle
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace._distance_field import corner_distances, field_at
from h3data.scene.freespace._points import SNAP_M
from h3data.scene.freespace._sdf import sample_sdf
from h3data.scene.freespace._visibility import nearest_free
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import gap_along
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.step import cached_offsets, drive_facing, velocities


class Rollouts(NamedTuple):
    """Results of N simulated trials."""

    xz: NDArray[np.float64]
    """Places [N, 2] [m] after ``look_steps`` steps."""
    heading: NDArray[np.float64]
    """Headings at the end [N] [rad]."""
    gap_m: NDArray[np.float64]
    """Least gap to the person during the trial [N] [m]; gaps in later steps count as wider."""


def roll_out(
    free: FreeSpace,
    base: BaseSpec,
    xz: NDArray[np.float64],
    heading: float,
    commands: NDArray[np.float64],
    person: NDArray[np.float64] | None = None,
    *,
    look_steps: int,
) -> Rollouts:
    """Simulate N commands from one pose.

    A command [N, 4] is ``(forward, turn, steps, then)``: forward and left turn in -1..1 of the limits for a number of
    steps, then straight on at speed ``then``. The base slides along obstacles as in
    `sim_kinematic.motion.step.drive_base`. The simulation lasts as long as the person walks along ``person`` [H, 2],
    one place per step, or ``look_steps`` steps without a person.

    Commands that start alike should be next to each other: their common part is simulated once (6,900 instead of 4,700
    expert steps per CPU second).
    """
    ends, nobody = np.empty((len(commands), 4)), np.empty((0, 2))
    walk = nobody if person is None else person
    free.entries(_roll_out, *_arguments(free, base, xz, heading), commands, walk, look_steps, ends)
    return Rollouts(ends[:, :2], ends[:, 2], ends[:, 3])


def roll_out_to(
    free: FreeSpace,
    base: BaseSpec,
    xz: NDArray[np.float64],
    heading: float,
    commands: NDArray[np.float64],
    goal: NDArray[np.float64],
    *,
    look_steps: int,
    turn_cost_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lengths of the ways [N] [m] from the ends of the trials of `roll_out` to ``goal`` [2], and errors of heading.

    The error [N] [rad] is the angle between the heading at the end and the direction of the way. Where another trial is
    certainly better, if each radian costs ``turn_cost_m``, the length is infinite instead, which saves searches.
    """
    ends = free.entries(
        _roll_out_to,
        free.graph,
        goal[0],
        goal[1],
        turn_cost_m,
        *_arguments(free, base, xz, heading),
        commands,
        look_steps,
    )
    # NumPy's arctan2 differs from a kernel's in the last bit on some processors
    return ends[:, 3], np.abs(wrap_angle(np.arctan2(-ends[:, 1], ends[:, 0]) - ends[:, 2]))


def _arguments(free: FreeSpace, base: BaseSpec, xz: NDArray[np.float64], heading: float) -> tuple[object, ...]:
    """Return what kernels of roll-outs need to know of the floor and the base."""
    return (
        free.sdf,
        free.origin,
        free.cell_m,
        xz[0],
        xz[1],
        heading,
        (base.max_speed_mps, 0.0, base.max_turn_rad_s, float(base.allow_back)),
        STEP_S,
        cached_offsets(base.disc_offsets_m),
        base.disc_radius_m,
        base.slide_iterations,
        base.clearance_tolerance_m,
        base.contact_tolerance_m,
        cached_offsets(hull_of(base)),
        base.disc_radius_m + AVOIDANCE.person_radius_m,
        AVOIDANCE.doubt_mps,
        base.farthest_m(STEP_S),
    )


@kernel(error_model="numpy")
def _roll_out(
    sdf,
    origin,
    cell,
    x0,
    z0,
    heading0,
    limits,
    dt,
    offsets,
    radius,
    iterations,
    tolerance,
    touch,
    hull,
    reach,
    doubt,
    most,
    commands,
    person,
    look_steps,
    ends,
):
    rules, begun = (
        (offsets, radius, iterations, tolerance, touch, most),
        (heading0, math.cos(heading0), math.sin(heading0)),
    )
    branch, branch_x, branch_z, branch_facing, branch_gap = 0, x0, z0, begun, math.inf
    for n in range(len(commands)):
        speed, _, turn = velocities(commands[n, :2], limits)
        then = min(max(commands[n, 3], -limits[3]), 1.0) * limits[0]
        alike = n > 0 and commands[n, 0] == commands[n - 1, 0] and commands[n, 1] == commands[n - 1, 1]
        if alike and commands[n, 2] >= branch:  # begin where the one before went on straight
            for k in range(3):  # by element: to copy slices, numba compiles an error text for 2 s
                ends[n, k] = ends[n - 1, k]
        else:
            branch, branch_x, branch_z, branch_facing, branch_gap = 0, x0, z0, begun, math.inf
        first, x, z, facing, gap = branch, branch_x, branch_z, branch_facing, branch_gap
        straight = still = False
        for step in range(first, max(len(person), look_steps)):
            if step >= commands[n, 2] and not straight:
                branch, branch_x, branch_z, branch_facing, branch_gap = step, x, z, facing, gap
                speed, turn, straight, still = then, 0.0, True, False
            # a step that has moved nothing is the same the next time
            if not still:
                turned, before = facing, (x, z, facing[0])
                if turn != 0.0:
                    heading = facing[0] + turn * dt
                    turned = heading, math.cos(heading), math.sin(heading)
                x, z, facing, _ = drive_facing(sdf, origin, cell, x, z, facing, turned, speed, 0.0, turn, dt, rules)
                still = before == (x, z, facing[0])
            # the gap is looked at for as long as the person is foreseen, the pose only for the next
            # ``look_steps``
            if step < len(person):
                now = gap_along(x, z, facing[1], facing[2], person[step, 0], person[step, 1], hull, reach)
                gap = min(gap, now + doubt * step * dt)
            if step < look_steps:
                ends[n, 0], ends[n, 1], ends[n, 2] = x, z, facing[0]
        ends[n, 3] = gap


@kernel(error_model="numpy")
def _roll_out_to(
    graph,
    goal_x,
    goal_z,
    turn_cost,
    sdf,
    origin,
    cell,
    x0,
    z0,
    heading0,
    limits,
    dt,
    offsets,
    radius,
    iterations,
    tolerance,
    touch,
    hull,
    reach,
    doubt,
    most,
    commands,
    look_steps,
):
    ends, least = np.empty((len(commands), 4)), math.inf
    _roll_out(
        sdf,
        origin,
        cell,
        x0,
        z0,
        heading0,
        limits,
        dt,
        offsets,
        radius,
        iterations,
        tolerance,
        touch,
        hull,
        reach,
        doubt,
        most,
        commands,
        np.empty((0, 2)),
        look_steps,
        ends,
    )
    goal_x, goal_z, island = nearest_free(graph, goal_x, goal_z, SNAP_M)
    goals = np.array([[goal_x, goal_z]])[: int(island >= 0)]
    corner = corner_distances(graph, goals)
    last_x, last_z, left, dx, dz = math.nan, math.nan, math.inf, 1.0, 0.0
    for n in range(len(commands)):
        x, z, heading, _ = ends[n]
        ends[n, 3] = math.inf
        # no way is shorter than the straight line; the table of corners is in float32
        if math.hypot(goal_x - x, goal_z - z) - 1e-4 >= least:
            continue
        # trials that only turn end at one place
        if x != last_x or z != last_z:
            last_x, last_z = x, z
            left, dx, dz = field_at(graph, corner, goals, x, z, SNAP_M)
            if math.isinf(left):  # there is no direction
                dx, dz = 1.0, 0.0
        ends[n, 3], ends[n, 0], ends[n, 1] = left, dx, dz
        off = abs((math.atan2(-ends[n, 1], ends[n, 0]) - heading + math.pi) % (2 * math.pi) - math.pi)
        least = min(least, ends[n, 3] + turn_cost * off)
    return ends


def straight_walk(
    free: FreeSpace, xz: NDArray[np.float64], velocity: NDArray[np.float64], steps: int
) -> NDArray[np.float64]:
    """Return the positions [steps, 2] [m] of a person walking from ``xz`` [2] at a velocity [2] [m/s] up to a wall."""
    walk = np.empty((steps, 2))
    (x, z), (vx, vz), room = xz.tolist(), velocity.tolist(), free.radius_m - AVOIDANCE.wall_m
    free.entries(_straight_walk, free.sdf, free.origin, free.cell_m, x, z, vx, vz, float(room), STEP_S, walk)
    return walk


@kernel(error_model="numpy")
def _straight_walk(sdf, origin, cell, x0, z0, vx, vz, room, dt, walk):
    x, z, blocked = x0, z0, vx == 0.0 and vz == 0.0
    for step in range(len(walk)):
        if not blocked:
            next_x, next_z = x0 + vx * ((step + 1) * dt), z0 + vz * ((step + 1) * dt)
            blocked = sample_sdf(sdf, origin, cell, next_x, next_z) < room
            x, z = (x, z) if blocked else (next_x, next_z)
        walk[step, 0], walk[step, 1] = x, z
