"""Locomotion of people: to waypoints (`walk_humans`) or by commands of speed and turn (`drive_people`).

Both functions drive one walking cycle (`step_cycle`), which is played by distance so that planted feet do not slide.
`cycle_phase` returns the phase of a person in the motion clip.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.kernels import kernel
from sim_kinematic.motion.spec import STEP_S, BaseSpec, WalkerSpec
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.motion.step import drive_robots, keep_worlds_apart, per_world, wrap_angle

if TYPE_CHECKING:
    from h3data.bodies.people.clips import Clip
    from h3data.scene import FreeSpace


@kernel(error_model="numpy")
def walk_towards(x, z, heading, goal_x, goal_z, speed, turn, dt, turn_before_walk, arrive):
    """Move a waypoint walker by one step and return ``(x, z, heading, walked)``.

    The person turns on the spot first and never overshoots the waypoint.
    """
    dx, dz = goal_x - x, goal_z - z
    distance = math.hypot(dx, dz)
    if distance <= arrive:
        return x, z, heading, 0.0
    error = wrap_angle(math.atan2(-dz, dx) - heading)
    # on the spot first: only the straight line to the waypoint is known to be free
    most = turn * dt
    if abs(error) > turn_before_walk:
        return x, z, heading + min(max(error, -most), most), 0.0
    # exactly onto the waypoint: the line to the next one is free from there
    walked = min(speed * dt, distance)
    return x + dx / distance * walked, z + dz / distance * walked, heading + error, walked


@kernel(error_model="numpy")
def step_cycle(distance, set_off, blend, walked, rate):
    """Return the walking cycle ``(distance, set_off, blend)`` of a person after a step of ``walked`` [m].

    ``walked`` is negative for a step backwards. At a blend above 0.5 one foot stands
    (`h3data.bodies.people.kernels.legs.settle`), so a walk starts there.
    """
    # the phase stays while the legs come to rest, so the feet do not slide
    if walked == 0.0:
        return distance, set_off, max(blend - rate, 0.0)
    # from rest the clip begins anew, where `cycle_phase` starts it; within a walk it goes on
    if blend == 0.0:
        set_off = distance
    return distance + walked, set_off, min(max(blend, 0.5) + rate, 1.0)


@kernel(error_model="numpy")
def _walk_worlds(xz, heading, distance, set_off, blend, goal, speed, turn, dt, turn_before_walk, arrive, blend_rate):
    for w in range(len(heading)):
        xz[w, 0], xz[w, 1], heading[w], walked = walk_towards(
            xz[w, 0], xz[w, 1], heading[w], goal[w, 0], goal[w, 1], speed, turn, dt, turn_before_walk, arrive
        )
        distance[w], set_off[w], blend[w] = step_cycle(distance[w], set_off[w], blend[w], walked, blend_rate)


@kernel(error_model="numpy")
def _step_cycles(distance, set_off, blend, xz, before, backwards, rate):
    for w in range(len(distance)):
        # what they got on, not what they wanted to: the legs of somebody held by a wall stand still
        walked = math.hypot(xz[w, 0] - before[w, 0], xz[w, 1] - before[w, 1])
        walked = -walked if backwards[w] else walked
        distance[w], set_off[w], blend[w] = step_cycle(distance[w], set_off[w], blend[w], walked, rate)


def walk_humans(state: HumanState, goal_xz: Array, spec: WalkerSpec, *, dt: float = STEP_S) -> None:
    """Move a person in all their worlds one step straight towards waypoints ``goal_xz`` [W, 2], in place.

    The waypoints come from `FreeSpace.path`, so the straight line to the next one is free.
    """
    _walk_worlds(
        state.xz,
        state.heading,
        state.distance,
        state.set_off,
        state.blend,
        per_world(goal_xz, state, width=2),
        spec.speed_mps,
        spec.turn_rad_s,
        dt,
        spec.turn_before_walk_rad,
        spec.arrive_m,
        dt / spec.blend_s,
    )


def move_people(state: HumanState, xz: Array, heading: Array, spec: WalkerSpec) -> None:
    """Move a person in all their worlds to ``xz`` [W, 2] [m] and ``heading`` [W] [rad] after a step, in place."""
    # the cycle goes on by the distance covered, which is known only after the move
    before = state.xz.copy()
    state.xz[:], state.heading[:] = xz, heading
    backwards = np.zeros(len(before), np.bool_)
    _step_cycles(state.distance, state.set_off, state.blend, state.xz, before, backwards, STEP_S / spec.blend_s)


def drive_people(
    state: HumanState,
    free: FreeSpace,
    action: Array,
    spec: WalkerSpec,
    *,
    radius_m: float = 0.25,
    backwards: bool = False,
    others: Array | None = None,
) -> NDArray[np.bool_]:
    """Move a person, a disc that slides along obstacles, by ``action`` [W, 2] in all their worlds, in place.

    Args:
        state: State of the person.
        free: Free floor of the home.
        action: Forward and left turn, -1..1 of the walker's speed and turn rate.
        spec: Settings of the person's walk.
        radius_m: Radius of the disc.
        backwards: True if a negative speed walks backwards; False if it stands still.
        others: Discs ``(x, z, radius)`` of others to slide along, [W, N, 3]; None: the person walks through them.

    Returns:
        True for people who touched an obstacle or others, [W].

    Raises:
        InputError: the actions have another shape, or one is not finite; then nothing has moved.
    """
    action = per_world(action, state, width=2)
    touched, before = np.zeros(len(action), np.bool_), state.xz.copy()
    # a person under control is a base of one disc, so walls stop both by the same rules
    disc = RobotState(xz=state.xz, heading=state.heading, contact=touched, joints=np.zeros((len(action), 0)))
    base = _disc(spec.speed_mps, spec.turn_rad_s, radius_m, backwards)
    drive_robots(disc, free, action, base)
    if others is not None:
        keep_worlds_apart(
            free.sdf,
            free.origin,
            free.cell_m,
            before,
            state.xz,
            touched,
            others,
            radius_m,
            radius_m - base.clearance_tolerance_m,
        )
    _step_cycles(
        state.distance,
        state.set_off,
        state.blend,
        state.xz,
        before,
        (action[:, 0] < 0) & backwards,
        STEP_S / spec.blend_s,
    )
    return touched


@lru_cache(maxsize=64)
def _disc(speed_mps: float, turn_rad_s: float, radius_m: float, backwards: bool) -> BaseSpec:
    return BaseSpec(
        max_speed_mps=speed_mps,
        max_turn_rad_s=turn_rad_s,
        allow_back=backwards,
        disc_offsets_m=(0.0,),
        disc_radius_m=radius_m,
    )


def cycle_phase(clip: Clip, distance: NDArray[np.float64], set_off: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the phases [...], 0..1, of a walking clip, given the distances walked in all and at the last start [m]."""
    return (clip.start_phase + (distance - set_off) / clip.stride_m) % 1.0
