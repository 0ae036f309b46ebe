"""Walking along a path with smooth starts, stops and curves.

Each step is a pure pursuit of the path: the person turns towards a point ahead on it and walks in the direction of view
or a little sideways, and more slowly while the point is not ahead. Turn rate and speed change no faster than
`StrideSpec` says. The disc of the body is pushed out of walls and furniture like that of a driven person
(`sim_kinematic.motion.step.push_out`), so that a curve never cuts into them.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.floor_heights import way_to_stairs
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.motion.gait import step_cycle
from sim_kinematic.motion.spec import STEP_S, WalkerSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.motion.step import push_out, wrap_angle

PROGRESS_M = 0.02
"""Length of the steps in which the place on the path is searched [m]."""
CREEP_MPS, SHARP_RAD = 0.1, 0.6
"""Speed below which people walk in any direction at once [m/s], and change of direction at which they stop [rad]."""
FRONT_M, FRONT_ROOM_M, FRONT_RAD = 0.3, 0.15, 0.5
"""Limits for turning before walking: a distance ahead [m], a room [m] and an angle [rad]. People whose heading differs
by more than the angle from their direction turn first if the room at the distance ahead is smaller. Otherwise legs that
swing while people turn in a curve would enter the obstacle."""
TURN_ROOM_M, TURN_RAD = 0.1, 1.2
"""Room beside a person [m] and turn [rad] for turning on the spot: with less room and a larger turn, people turn where
they stand. Walking slowly along a U-turn would bring the elbows of the broadest body 5 cm into the wall."""
SHOULDER_M = 0.05
"""Distance beyond their radius that people who cut a corner keep, where there is room [m]: without it, the upper arms
of the broadest body were 3 cm inside door posts."""
FACE_M, FACE_RAD = 0.6, 0.8
"""Length of the end of a path on which people turn to their target [m], and angle by which they walk sideways there
[rad]. People who turned only after they arrived spent 3% of the steps of rearrangement turning."""
STAIRS_SHARE = 0.5
"""Share of their speed with which people climb stairs, measured in the plan view."""


@kernel(error_model="numpy")
def point_along(path, cumulative, along):
    """Return the point (x, z) of a path [K, 2] at the distance ``along`` [m] from its start."""
    k = 1
    while k < len(path) - 1 and cumulative[k] < along:
        k += 1
    length = cumulative[k] - cumulative[k - 1]
    share = min(max((along - cumulative[k - 1]) / length, 0.0), 1.0) if length > 0.0 else 1.0
    return (
        path[k - 1, 0] + share * (path[k, 0] - path[k - 1, 0]),
        path[k - 1, 1] + share * (path[k, 1] - path[k - 1, 1]),
    )


@kernel(error_model="numpy")
def next_waypoint_index(cumulative, along):
    """Return the number of the first waypoint beyond ``along`` [m], at most the last one."""
    k = 1
    while k < len(cumulative) - 1 and cumulative[k] <= along + 1e-9:
        k += 1
    return k


@kernel(error_model="numpy")
def _bearing(x, z, heading, to_x, to_z):
    """Return the angle [rad] from a heading to a point, positive to the left."""
    if math.hypot(to_x - x, to_z - z) < 1e-6:
        return 0.0
    return wrap_angle(math.atan2(-(to_z - z), to_x - x) - heading)


@kernel(error_model="numpy")
def progress_along(path, cumulative, along, x, z):
    """Return the distance along the path of the point nearest to (x, z) that is not behind ``along`` [m]."""
    total = cumulative[-1]
    px, pz = point_along(path, cumulative, along)
    gap = math.hypot(px - x, pz - z)
    # only forward and to the first nearest point: where a path folds back, its next leg may be nearer still
    while along < total:
        ahead = min(along + PROGRESS_M, total)
        px, pz = point_along(path, cumulative, ahead)
        nearer = math.hypot(px - x, pz - z)
        if nearer > gap:
            break
        along, gap = ahead, nearer
    return along


@kernel(error_model="numpy")
def slide_along_walls(sdf, origin, cell, radius, x, z, nx, nz, most):
    """Return the end of a step from (x, z) towards (nx, nz) that keeps ``radius`` [m] away from obstacles.

    The step is at most ``most`` [m] long. Returns ``(x, z, moved, clearance)``: the position, the length that obstacles
    allowed, and the least clearance [m].
    """
    sx, sz, clearance = push_out(sdf, origin, cell, nx, nz, 1.0, 0.0, (0.0,), radius, 6)
    moved = math.hypot(sx - x, sz - z)
    # being pushed out of a wall must not carry anybody farther than they walk
    share = min(most / moved, 1.0) if moved > 0.0 else 1.0
    sx, sz = x + share * (sx - x), z + share * (sz - z)
    return sx, sz, moved, min(clearance, sample_sdf(sdf, origin, cell, sx, sz))


@kernel(error_model="numpy")
def stride_step(
    sdf, origin, cell, heights, radius, path, cumulative, goes, halts, facing, state, speed, limits, patience, dt
):
    """Walk one step along a path, in place, and return whether the end has been reached.

    Args:
        sdf: signed distances of the floor's grid [m].
        origin: position of the grid.
        cell: size of its cells [m].
        heights: heights of the floor [m].
        radius: radius of the body [m].
        path: points of the path [K, 2].
        cumulative: length of the path up to each point [K] [m].
        goes: whether the person walks; otherwise they slow down to a stand.
        halts: whether they stop at the last point; otherwise they pass it.
        facing: heading to turn to from `FACE_M` before the end on [rad]; NaN: none.
        state: x, z, heading, speed, turn rate, distance along the path, angle between walking and view, largest distance
            along the path so far, steps without progress, and whether the person follows the path itself with all its
            corners.
        speed: walking speed [m/s].
        limits: `StrideSpec.limits`.
        patience: steps without progress after which the person follows the path itself.
        dt: duration of the step [s].
    """
    accel, decel, turn_rate, turn_accel, gain, look, sidestep, sidestep_rate, arrive = limits
    x, z, heading, v, turn = state[0], state[1], state[2], state[3], state[4]
    keeps_to_path, total = state[9] > 0.0, cumulative[-1]
    if heights.shape[0]:  # they are slow enough when they set foot on stairs
        to_stairs = way_to_stairs(heights, x, z)
        speed = min(speed, math.sqrt((STAIRS_SHARE * speed) ** 2 + 2.0 * decel * to_stairs))
    along = progress_along(path, cumulative, state[5], x, z)
    end_x, end_z = path[-1, 0], path[-1, 1]
    to_end = math.hypot(end_x - x, end_z - z)
    room = sample_sdf(sdf, origin, cell, x, z) - radius
    ahead = min(0.3 + max(room, 0.0), look)
    if keeps_to_path:  # to each waypoint in turn, even where the path folds back
        k = next_waypoint_index(cumulative, along)
        if k < len(path) - 1 and math.hypot(path[k, 0] - x, path[k, 1] - z) <= max(v * dt, arrive / 4.0):
            along = cumulative[k]
            k += 1
        ahead = min(0.1, max(cumulative[k] - along, 0.0))
    tx, tz = point_along(path, cumulative, min(along + ahead, total))
    bearing = _bearing(x, z, heading, tx, tz)
    # 0.5: distance beyond the point that they walk towards at which people notice a corner [m]
    fx, fz = point_along(path, cumulative, min(along + ahead + 0.5, total))
    bend = max(abs(bearing), abs(_bearing(x, z, heading, fx, fz)))  # they slow down before a corner
    closing = to_end < 2.0 * arrive and along + ahead >= total
    wanted = min(max(gain * bearing, -turn_rate), turn_rate)
    if closing or not goes:
        wanted = 0.0
    aims = goes and not math.isnan(facing) and to_end < FACE_M and along + ahead >= total and not keeps_to_path
    if aims:
        missing = wrap_angle(facing - heading)
        if not closing:  # as far as they can walk sideways
            missing = bearing + min(max(wrap_angle(missing - bearing), -FACE_RAD), FACE_RAD)
        wanted = min(max(gain * missing, -turn_rate), turn_rate)
    turn += min(max(wanted - turn, -turn_accel * dt), turn_accel * dt)
    facing = 1.0 if closing else max(math.cos(bend), 0.0) ** 2
    left = to_end if along >= total - ahead else total - along
    most = max(speed * max(facing, 0.2), CREEP_MPS / 2)
    # they can still brake before the end; never zero, or they would not get there
    most = min(most, max(math.sqrt(2.0 * decel * left), CREEP_MPS / 2))
    widest = math.pi if closing or keeps_to_path else FACE_RAD if aims else sidestep
    wanted_off = min(max(bearing, -widest), widest)
    if not goes or (keeps_to_path and abs(wrap_angle(wanted_off - state[6])) > SHARP_RAD):
        most = 0.0
    if not keeps_to_path and not closing and abs(bearing) > FRONT_RAD:
        front = sample_sdf(sdf, origin, cell, x + math.cos(heading) * FRONT_M, z - math.sin(heading) * FRONT_M)
        if front < FRONT_ROOM_M or (room < TURN_ROOM_M and abs(bearing) > TURN_RAD):
            most = 0.0
    v += min(max(most - v, -decel * dt), accel * dt)
    there = goes and to_end <= v * dt and along + ahead >= total
    if there and halts:
        state[0], state[1], state[2], state[3], state[4], state[5] = end_x, end_z, heading + turn * dt, 0.0, 0.0, total
        return True
    off, most_off = state[6], sidestep_rate * dt
    off = wanted_off if v < CREEP_MPS else off + min(max(wrap_angle(wanted_off - off), -most_off), most_off)
    direction = heading + off
    nx, nz = x + math.cos(direction) * v * dt, z - math.sin(direction) * v * dt
    beside = sample_sdf(sdf, origin, cell, nx, nz)
    # wanted, not needed: who is in a narrower gap already keeps the room that there is
    wide = min(radius + SHOULDER_M, max(room + radius, radius))
    if beside < wide and not closing and not keeps_to_path:
        sx, sz, moved, clearance = slide_along_walls(sdf, origin, cell, wide, x, z, nx, nz, v * dt)
        if clearance >= wide - 1e-3:
            nx, nz, v, beside = sx, sz, min(v, max(moved / dt, v - decel * dt)), radius
    if beside < radius:
        sx, sz, moved, clearance = slide_along_walls(sdf, origin, cell, radius, x, z, nx, nz, v * dt)
        if clearance >= min(radius, room + radius) - 1e-3:
            nx, nz, v = sx, sz, min(v, max(moved / dt, v - decel * dt))
        # they were pushed into something else, so they stay; patience ends that
        elif not keeps_to_path:
            nx, nz, v = x, z, 0.0
    state[0], state[1], state[2], state[3], state[4], state[5] = nx, nz, heading + turn * dt, v, turn, along
    state[6] = off
    # waiting for somebody is no lack of progress
    state[8] = 0.0 if along > state[7] + PROGRESS_M or not goes else state[8] + 1.0
    state[7] = max(state[7], along)
    # cutting corners has led to where they cannot go on; the path itself is known to be free
    if state[8] > patience:
        state[9] = 1.0
    return there


@kernel(error_model="numpy")
def stride_gait(
    sdf,
    origin,
    cell,
    heights,
    radius,
    path,
    cumulative,
    goes,
    halts,
    facing,
    state,
    speed,
    limits,
    patience,
    dt,
    xz,
    heading,
    distance,
    set_off,
    blend,
    rate,
    before,
):
    """Apply `stride_step` and the gait of one person, in place; write the gait's state from before to ``before`` [6]."""
    before[0], before[1], before[2] = state[0], state[1], state[2] = xz[0, 0], xz[0, 1], heading[0]
    before[3], before[4], before[5] = distance[0], set_off[0], blend[0]
    there = stride_step(
        sdf,
        origin,
        cell,
        heights,
        radius,
        path,
        cumulative,
        goes,
        halts,
        facing,
        state,
        speed,
        limits,
        patience,
        dt,
    )
    xz[0, 0], xz[0, 1], heading[0] = state[0], state[1], state[2]
    walked = math.hypot(state[0] - before[0], state[1] - before[1])
    distance[0], set_off[0], blend[0] = step_cycle(distance[0], set_off[0], blend[0], walked, rate)
    return there


@kernel(error_model="numpy")
def stride_track(
    sdf, origin, cell, heights, radius, path, cumulative, halts, state, speed, limits, patience, dt, track
):
    """Walk the whole path, or as much as fits into ``track`` [n, 3] (x, z, heading); return the number of steps."""
    for k in range(len(track)):
        there = stride_step(
            sdf,
            origin,
            cell,
            heights,
            radius,
            path,
            cumulative,
            True,
            halts,
            math.nan,
            state,
            speed,
            limits,
            patience,
            dt,
        )
        track[k, 0], track[k, 1], track[k, 2] = state[0], state[1], state[2]
        if there:
            return k + 1
    return len(track)


class Strider:
    """Person who walks along a path step by step, and who can brake, wait and set off again."""

    def __init__(self, free: FreeSpace, spec: WalkerSpec, *, radius_m: float = 0.25, halts: bool = False) -> None:
        """Create a walker without a path; with ``halts``, it stops at the last point of a path, else it passes it.

        Raises:
            InputError: the walker has no `StrideSpec`.
        """
        if spec.stride is None:
            raise InputError("Expected a walker with a stride, got one who turns on the spot.", code="H3-SIM-038")
        self._radius_m = radius_m
        self.walk_on(free)
        self._blend_rate = STEP_S / spec.blend_s
        self._rules = (
            float(spec.speed_mps),
            tuple(map(float, spec.stride.limits)),
            round(spec.stride.patience_s / STEP_S),
            STEP_S,
        )
        self._path, self._cumulative = np.zeros((2, 2)), np.zeros(2)
        self._lengths: list[float] = [0.0, 0.0]
        """Lengths of paths (`_cumulative`), in which a step looks up its place."""
        self._state = np.zeros(10)
        self._halts, self._facing = halts, math.nan
        self.arrived = True

    def walk_on(self, free: FreeSpace) -> None:
        """Continue the same path on another floor."""
        self.free = free
        self._grid = free.sdf, free.origin, free.cell_m, free.heights, float(self._radius_m)

    def halt(self) -> None:
        """Stop the person, because something else has brought them to a stand."""
        self._state[3:5] = self._state[6] = 0.0

    @property
    def ahead(self) -> Array:
        """Remaining waypoints [K, 2] of the path, of which the person walks to the first."""
        return self._path[min(self._next, len(self._path) - 1) :]

    @property
    def _next(self) -> int:
        return bisect_left(self._lengths, self._state.item(5) + PROGRESS_M)

    def begin(self, path: Array, *, facing: float | None = None) -> None:
        """Set the path [K, 2] from the present position; speed and turn rate continue.

        The person arrives with the heading ``facing`` [rad], as far as they can turn on the last steps.
        """
        self._facing = math.nan if facing is None else facing
        path = np.asarray(path, np.float64)
        # a path of one point becomes a segment without length: the kernels look at two points
        self._path = np.ascontiguousarray(path if len(path) > 1 else np.repeat(path, 2, axis=0))
        self._cumulative = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self._path, axis=0).T))])
        self._lengths = self._cumulative.tolist()
        # not 3, 4 and 6: speed, turn rate and sidestep go on from the last path
        self._state[5] = 0.0
        self._state[7:] = 0.0
        self.arrived = False

    def walk(self, gait: HumanState, *, goes: bool = True) -> Array:
        """Move the gait of one person by a step, in place; return its six numbers before the step [6]."""
        told, before = (goes, self._halts, self._facing, self._state, *self._rules), np.empty(6)
        moved = gait.xz, gait.heading, gait.distance, gait.set_off, gait.blend, self._blend_rate
        self.arrived = self.free.entries(stride_gait, *self._grid, self._path, self._cumulative, *told, *moved, before)
        return before

    def whole(self, xz: Array, heading: float, *, most: int) -> NDArray[np.float64]:
        """Return the steps (x, z, heading) [n, 3] to the end of the path, at most ``most`` of them."""
        state, track = self._state, np.empty((most, 3))
        state[0], state[1], state[2] = xz[0], xz[1], heading
        count = stride_track(*self._grid, self._path, self._cumulative, self._halts, state, *self._rules, track)
        self.arrived = count < most
        return track[:count]
