"""Compiled kernels of planted walking: the motion of the feet while the root moves in any direction, and the pose at any time.

`step_gait` is a phase machine. A foot is either planted, at a fixed position on the floor in the world, or swings from
there to its next position: as far ahead as in the gait at this speed, plus half of the root's further motion and turn
during the stance. If a map of the floor is given, feet avoid walls and furniture. On stairs the root follows a ramp and
feet step from tread to tread (`steps`). Nothing else moves a foot, so a planted foot cannot slide. The rate of the
phase follows from the speed, the turning rate and the errors of the feet, and is 0 when both feet are in the standing
position.

`pose_gait` computes the pose from one state alone. Joints come from tables by speed and phase; legs are solved from the
feet in closed form.

The body frame (+Z forward, +Y up, +X left) has its origin at the root. Feet are ``(left, forward, yaw)`` in the body
frame and ``(x, z, heading)`` in the world [m, m, rad].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from h3data.bodies.people.kernels.legs import KNEES, LegMeasures, lowest, sinking, write_legs
from h3data.bodies.people.kernels.steps import (
    beside_steps,
    on_a_tread,
    over_steps,
    tread_length,
    tread_of,
    under_foot,
)
from h3data.bodies.people.kernels.tuple_math import (
    dot,
    from_vector,
    inverse,
    multiply,
    nlerp,
    plus,
    put,
    row3,
    row4,
    turned,
)
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array
from h3data.kernels import kernel, kernel_part
from h3data.scene.floor_heights import height_at, step_at
from h3data.scene.freespace._sdf import sample_sdf, sdf_gradient

# columns of a state
PHASE, SHOWN, SPEED, TURN, SINK, IDLE, TIME, X, Z, HEADING, AHEAD, STYLE, LOOK, LOOK_RATE = range(14)
"""Columns of a state. ``PHASE`` of the feet is 0 where the left foot strikes; ``SHOWN`` is the phase of trunk and arms,
which follows it smoothly. ``SPEED`` of the gait is negative backwards, and ``STYLE`` is the speed of trunk and arms
[m/s]. ``TURN`` is the smoothed turning rate [rad/s] and ``SINK`` the lowering of the pelvis [m]. ``IDLE`` is the share
of the breathing and sway of a standing person, 0 to 1. ``TIME`` is in seconds, then come the root and ``AHEAD``, its
approximate speed [m/s]. ``LOOK`` is the turn of the head to the left [rad], and ``LOOK_RATE`` its rate [rad/s]."""
FOOT = 14
"""First column of a state that belongs to the left foot."""
AIR, SHARE, SINCE = 0, 1, 2
"""Columns of a foot's swing: whether it swings, its progress 0..1, and its progress at the start (above 0 in the first step
of a walk)."""
PLANT, LEFT_AT, LANDS_AT = 3, 6, 9
"""Columns of a foot: its planted position in the world [3], its offset from the gait's position when it left the floor
[3], and the offset when it lands [3]."""
SHAPE_OFF = 12
"""Columns of a foot: differences of pitch, bend [deg], ankle forward and up [m] from the gait since it left the floor or landed
[4]."""
FOOT_COLUMNS = 16
STATE_COLUMNS = FOOT + 2 * FOOT_COLUMNS

SETTLED_M, SETTLED_RAD = 0.02, 0.10
"""Distance [m] and angle [rad] within which a foot counts as being at its position."""
LANDING_M, LANDING_RAD = 0.06, 0.20
"""Largest distance [m] and angle [rad] by which the landing position of a swinging foot changes in a step."""
FIRST_SHARE = 0.25
"""Share of its stance that the standing foot has passed when the other foot starts the first step of a walk."""
JUMP_M = 0.5
"""Distance in one step above which the root has been set to a new place, so that the person stands [m]."""
MOST_STEPS, LEAST_S, SAME_S = 30, 1e-3, 1e-6
"""Largest number of steps between two rows, shortest step `LEAST_S` [s], and `SAME_S`, the difference below which steps
are equally long [s]: times of recordings are whole nanoseconds, and 33,333,333 ns for 1/30 s moved feet by up to 5 cm,
as a foot that leaves the floor one step later lands elsewhere."""
ACCELERATION, AHEAD_ACCELERATION, STYLE_ACCELERATION = 9.0, 25.0, 3.0
"""Limits of the acceleration [m/s^2] with which the gait, the landing positions of feet, and the trunk and arms follow
the speed of the root."""
TURN_SHARE = 0.35
"""Share of a change of the root's turning rate that the gait adopts in a step."""
CYCLES_PER_RAD, SETTLE_HZ = 0.7, 1.5
"""Number of cycles of two steps per radian of a turn on the spot, in which each foot takes a step every 41 degrees, and
the cadence [1/s] of steps that correct the positions of feet."""
TWIST_RAD, OFF_M = 0.6, 0.45
"""Largest yaw of a landing foot from the body [rad], and its largest distance from its position in the steady gait
[m]."""
CATCH_UP = 0.015
"""Cycles per step by which the phase of trunk and arms approaches the phase of the feet after a jump."""
LIFT, LIFT_MOST_M = 0.18, 0.06
"""Additional lift of a foot that deviates from the gait, as a share of the deviation, and its limit [m]."""
STRETCHED = 0.994
"""Largest share of its length to which a leg is stretched; straighter knees would straighten abruptly."""
CROUCH_M, CROUCH_MPS, RISE_MPS = 0.06, 0.2, 0.5
"""Distance by which the pelvis is lowered on stairs [m], the speed of lowering, and the largest speed of rising again
[m/s]."""
LETS_GO, OVER_BY, DRAWS = 0.4, 0.8, 0.3
"""Shares of a foot's swing: after the first, the pelvis is no longer lowered to keep that foot within reach; at the
second, a foot between treads is above its landing position; from the third on, the pelvis sinks for a foot that lands
on a lower tread."""
SHAPE_LEFT = 0.78
"""Share of the differences in `SHAPE_OFF` that remains after a step."""
EARLY_M, EARLY_SHARE = 0.04, 0.5
"""Lowering of the pelvis [m] above which a foot behind the body leaves the floor early, if the other foot stands, and
the share of its stance from which on it may leave."""
CLEARANCE_M = 0.012
"""Smallest distance of a swinging foot from the floor [m]."""
FOOT_ROOM_M = 0.03
"""Distance of heel and toe tip of a swinging foot from walls and furniture [m]. The resting positions of the feet of a
person whose root is 25 cm from a wall are farther away (5 cm on the largest body). With 6 cm, such people never stopped
correcting the positions of their feet."""
SLIDES, LOOKS, TOUCHES_M = 3, 12, 2e-3
"""Largest number of straight lines, and of samples of the map on each, by which heel and toes slide from below the root
along obstacles to their position. Moved along the gradient of the distances instead, some feet ended on the far side of
walls."""
IDLE_IN, IDLE_OUT = 0.6, 3.0
"""Rates [1/s] at which standing sway starts and ends."""
LOOK_S, LOOK_RAD = 0.30, 0.6
"""Time by which the head anticipates the turn of the root [s], and the largest angle of the head [rad]."""
LOOK_GAIN, LOOK_RAD_S, LOOK_ACCELERATION = 7.0, 1.9, 18.0
"""Rate at which the head approaches that angle [1/s], its largest speed (110 degrees a second), and its largest
acceleration [rad/s^2], as in turns of the head to objects (`h3data.bodies.people.kernels.attention`). Without these
limits the end of a turn on the spot turned the face by 15 degrees in a step."""
SWING_MPS, TOE_M = 3.0, 0.13
"""Largest horizontal speed relative to the body [m/s] of a swinging foot's ankle and of a point ahead of it at this
distance [m], unless the steady gait is faster. The phase is slowed down to keep within the limit. Without this limit,
toes moved 15 cm in a step on curves at 0.5 m/s."""

WALKS_MPS, KNEE_SHARE = 1.6, 1.25
"""Largest speed [m/s] at which ankle, ball and knee of a drawn leg are kept from moving faster than in the steady gait, and
the factor by which knees move less than ankles in it. Above this speed, people jog."""

_NECK, _HEAD = JOINT_INDEX["neck"], JOINT_INDEX["head"]
_SPINES = (JOINT_INDEX["spine1"], JOINT_INDEX["spine2"], JOINT_INDEX["spine3"])


class GaitTables(NamedTuple):
    """Tables of a body's gaits by speed (rows, starting with standing) and by phase or share of stance or swing (columns)."""

    legs: LegMeasures
    half_width: float
    ankle_height: float
    speeds: Array
    """Walking speeds of the rows, rising from 0, [R] [m/s]."""
    travel: Array
    """Length of a cycle, [R] [m]; 0 at rest."""
    cadence: Array
    """Cycles per second, [R]."""
    stance: Array
    """Share of the cycle that a foot is on the floor, [R]."""
    strike: Array
    """Distance ahead of the pelvis at which a foot strikes, in cycles, [R]."""
    swing: Array
    """Largest horizontal speed of a swinging foot relative to the body, [R] [m/s]."""
    middle: Array
    """Position of the feet while the body does not travel, [R] [m]."""
    quats: Array
    """Rotations of the joints in the body frame by speed and phase, [R, P, 55, 4]; rotations of legs are not used."""
    pelvis: Array
    """Position of the pelvis by speed and phase, [R, P, 3] [m]."""
    stand_foot: Array
    """Pitch and bend of a foot on the floor, [R, S, 2] [deg]."""
    swing_foot: Array
    """Pitch and bend of a swinging foot, [R, S, 2] [deg]."""
    swing_path: Array
    """Offset of a swinging foot's ankle, forward and up, from an eased line between its positions on the floor, [R, S,
    2] [m]."""
    to_root: Array
    """Rotation from the body frame to the agent root frame, [4]."""
    sdf: Array
    """Distances to walls and furniture [X, Z] [m] (`h3data.scene.FreeSpace.sdf`); shape [0, 0] if there are no
    obstacles."""
    origin: Array
    """Lower corner of the grid of ``sdf``, [2] [m]."""
    cell_m: float
    """Side of the cells of ``sdf`` [m]."""
    heights: Array
    """Table of floor heights (`h3data.scene.floor_heights`), [K, 10]; [0, 10] if the floor is level."""
    clear: float
    """1 for people who are only drawn: knees and swinging feet, too, keep clear of the obstacles of ``sdf``. 0 for people
    whose joints are recorded, so that these stay the same in any bit."""


@kernel_part(borrows=True)
def _row(table, speed):
    """Return the row below a speed, and the share of the next one."""
    v = abs(speed)
    last = len(table.speeds) - 1
    if v >= table.speeds[last]:
        return last - 1, 1.0
    k = 0
    while table.speeds[k + 1] <= v:
        k += 1
    return k, (v - table.speeds[k]) / (table.speeds[k + 1] - table.speeds[k])


@kernel_part(borrows=True)
def _at(column, k, f):
    return column[k] + f * (column[k + 1] - column[k])


@kernel_part(borrows=True)
def _eased(u):
    # the smoothstep: speed is 0 at both ends, so that a foot neither jerks off the floor nor stamps
    return u * u * (3 - 2 * u)


@kernel_part(borrows=True)
def _wrapped(angle):
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@kernel_part(borrows=True)
def _to_world(x, z, heading, left, ahead, yaw):
    c, s = math.cos(heading), math.sin(heading)
    return x + c * ahead - s * left, z - s * ahead - c * left, heading + yaw


@kernel_part(borrows=True)
def _to_body(x, z, heading, px, pz, ph):
    c, s = math.cos(heading), math.sin(heading)
    dx, dz = px - x, pz - z
    return -s * dx - c * dz, c * dx - s * dz, _wrapped(ph - heading)


@kernel_part(borrows=True)
def _gait_ahead(table, k, f, speed, phase):
    """Return how far ahead of the pelvis the steady gait has a foot on the floor at its own phase, 0 at its strike."""
    # walking backwards is the same gait with the feet travelling the other way
    way = math.copysign(1.0, speed) * _at(table.travel, k, f)
    return _at(table.middle, k, f) + way * (_at(table.strike, k, f) - phase)


@kernel_part(borrows=True)
def _swing_ahead(table, k, f, speed, share):
    stance = _at(table.stance, k, f)
    # a swing joins the two ends of the stance, so that a steady gait needs no correction at either
    off, on = _gait_ahead(table, k, f, speed, stance), _gait_ahead(table, k, f, speed, 0.0)
    return off + _eased(share) * (on - off)


@kernel_part(borrows=True)
def _own_phase(phase, foot):
    own = phase - 0.5 * foot
    return own - math.floor(own)


@kernel_part(borrows=True)
def _foot_room(table, x, z):
    """Return the free distance of heel or toes beyond what they keep from walls and furniture [m]."""
    # drawn feet keep more: those of capsules are 5 cm thick, and distances are 1 cm too great at corners
    return sample_sdf(table.sdf, table.origin, table.cell_m, x, z) - FOOT_ROOM_M * (1 + 0.55 * table.clear)


@kernel_part(borrows=True)
def _slides_to(table, x, z, to_x, to_z):
    """Return where a point ends that moves from free floor towards a place and slides along obstacles in between."""
    for _ in range(SLIDES):
        way_x, way_z = to_x - x, to_z - z
        length, done = math.hypot(way_x, way_z), 0.0
        # the point is there: the next line would divide by zero
        if length < 1e-9:
            break
        way_x, way_z = way_x / length, way_z / length
        # sphere tracing: within the free distance nothing can be hit, so each look may go as far as it says
        room = _foot_room(table, x, z)
        for _ in range(LOOKS):
            if room <= TOUCHES_M or done >= length:
                break
            done = min(done + room, length)
            room = _foot_room(table, x + way_x * done, z + way_z * done)
        x, z = x + way_x * done, z + way_z * done
        if done >= length and room >= 0.0:
            break
        away_x, away_z = sdf_gradient(table.sdf, table.origin, table.cell_m, x, z)
        # only the part of the motion that leads into the obstacle is taken away; the rest goes on along it
        square = max(away_x * away_x + away_z * away_z, 1e-9)
        into = min((way_x * away_x + way_z * away_z) / square, 0.0) * (length - done)
        # twice the tolerance: from the border itself the next look would find no room and never get away
        back = max(2 * TOUCHES_M - room, 0.0) / math.sqrt(square)
        to_x, to_z = x + way_x * (length - done) - into * away_x, z + way_z * (length - done) - into * away_z
        x, z = x + back * away_x, z + back * away_z
    return x, z


@kernel_part(borrows=True)
def _room_at(table, state, left, ahead):
    """Return the distance of a place in the body frame to obstacles [m], and the direction away from them: (left, ahead, 0)."""
    x, z, _ = _to_world(state[X], state[Z], state[HEADING], left, ahead, 0.0)
    room, away = (
        sample_sdf(table.sdf, table.origin, table.cell_m, x, z),
        sdf_gradient(table.sdf, table.origin, table.cell_m, x, z),
    )
    return room, _to_body(0.0, 0.0, state[HEADING], away[0], away[1], 0.0)


@kernel_part(borrows=True)
def _beside_things(table, state, foot, left, ahead, yaw, flat):
    """Return a place of a foot in the body frame, moved out of walls and furniture: (left, ahead).

    ``flat`` is the share of its length that a pitched foot covers; at 0 the place stays.
    """
    if table.sdf.shape[0] == 0 or flat == 0.0:
        return left, ahead
    x, z, heading = _to_world(state[X], state[Z], state[HEADING], left, ahead, yaw)
    c, s, feet = flat * math.cos(heading), flat * math.sin(heading), table.legs.feet[foot]
    # one look from the root answers for most feet in open rooms: nothing is nearer than that
    near, moved = _foot_room(table, state[X], state[Z]), False
    # heel and toe tip; only corners reach in between
    for point in range(2 + 2 * int(table.clear)):
        along = feet[0, 2] + (0.0, 1.0, 0.75, 0.45)[point] * (feet[2, 2] - feet[0, 2])
        at_x, at_z = x + c * along, z - s * along
        if math.hypot(at_x - state[X], at_z - state[Z]) > near:
            slid_x, slid_z = _slides_to(table, state[X], state[Z], at_x, at_z)
            if abs(slid_x - at_x) + abs(slid_z - at_z) > 1e-6:
                x, z, moved = x + slid_x - at_x, z + slid_z - at_z, True
    if not moved:  # to the last bit
        return left, ahead
    return _to_body(state[X], state[Z], state[HEADING], x, z, heading)[:2]


@kernel_part(borrows=True)
def _lands_at(table, k, f, state, foot, left, ahead, gone):
    """Return the world position (x, z) at which a swinging foot will land.

    The foot lands ``left`` and ``ahead`` of its place in the gait; the phase is ``gone`` cycles behind the root.
    """
    # where the gait has it at its strike, seen from where the root will be by then
    side = table.half_width if foot == 0 else -table.half_width
    onward = math.copysign(1.0, state[SPEED]) * _at(table.travel, k, f) * (1.0 - _own_phase(state[PHASE], foot) - gone)
    onward += _gait_ahead(table, k, f, state[SPEED], 0.0)
    return _to_world(state[X], state[Z], state[HEADING], side + left, ahead + onward, 0.0)[:2]


@kernel_part(borrows=True)
def _on_a_tread(table, state, foot, x, z, heading, came_from):
    """Move the place of a foot in the world along the stairs so that it lies on one tread.

    Heel and toe then reach at most a little beyond the tread's edge.
    """
    return on_a_tread(table.heights, x, z, heading, table.legs.feet[foot, 0, 2], table.legs.feet[foot, 2, 2], came_from)


@kernel_part(borrows=True)
def _came_from(table, state, foot):
    """Return the number of the tread that a foot stands on or has left."""
    at, feet = FOOT + foot * FOOT_COLUMNS + PLANT, table.legs.feet[foot]
    return tread_of(table.heights, state[at], state[at + 1], state[at + 2], feet[0, 2], feet[2, 2])


@kernel_part(borrows=True)
def _stand_place(table, state, foot):
    """Return the place of a standing person's foot in the body frame: (left, ahead)."""
    side = table.half_width if foot == 0 else -table.half_width
    if table.heights.shape[0] == 0:
        return side, table.middle[0]
    x, z, heading = _to_world(state[X], state[Z], state[HEADING], side, table.middle[0], 0.0)
    x, z = _on_a_tread(table, state, foot, x, z, heading, -1)
    return _to_body(state[X], state[Z], state[HEADING], x, z, heading)[:2]


@kernel_part(borrows=True)
def _above_root(table, k, f, state, foot, along):
    """Return the height of the floor under a foot above that under the root [m].

    For a swinging foot, whose ankle is ``along`` ahead of its place [m], it is the height of its path over steps.
    """
    if table.heights.shape[0] == 0:
        return 0.0
    at, feet = FOOT + foot * FOOT_COLUMNS, table.legs.feet[foot]
    root = height_at(table.heights, 0.0, state[X], state[Z])
    heel, toe = feet[0, 2], feet[2, 2]
    low = under_foot(table.heights, state[at + PLANT], state[at + PLANT + 1], state[at + PLANT + 2], heel, toe)
    if state[at + AIR] == 0.0:
        return low - root
    lands_x, lands_z = _lands_at(table, k, f, state, foot, state[at + LANDS_AT], state[at + LANDS_AT + 1], 0.0)
    high = under_foot(table.heights, lands_x, lands_z, state[HEADING] + state[at + LANDS_AT + 2], heel, toe)
    # from floor to floor beside the stairs there is nothing to climb over
    if low == high and step_at(table.heights, lands_x, lands_z)[0] < 0:
        return low - root
    share = min(max((state[at + SHARE] - state[at + SINCE]) / max(1.0 - state[at + SINCE], 1e-6), 0.0), 1.0)
    left, ahead, yaw, _ = _swing_place(table, k, f, state, foot)
    x, z, heading = _to_world(state[X], state[Z], state[HEADING], left, ahead, yaw)
    return over_steps(table.heights, x, z, heading, heel + along, toe + along, low, high, share) - root


@kernel_part(borrows=True)
def _steps_off(table, state, foot):
    """Return whether a swinging foot has left a place in a stairwell, from where it goes straight to its end."""
    at = FOOT + foot * FOOT_COLUMNS
    return table.heights.shape[0] > 0 and step_at(table.heights, state[at + PLANT], state[at + PLANT + 1])[0] >= 0


@kernel_part(borrows=True)
def _stair_line(table, k, f, state, foot, done, gone):
    """Return the foot on its path between two treads, of which it has passed the share ``done``.

    Returns left, ahead and yaw in the body frame, and that share. ``gone`` is as in `_lands_at`.
    """
    at = FOOT + foot * FOOT_COLUMNS
    lands_x, lands_z = _lands_at(table, k, f, state, foot, state[at + LANDS_AT], state[at + LANDS_AT + 1], gone)
    x = state[at + PLANT] + done * (lands_x - state[at + PLANT])
    z = state[at + PLANT + 1] + done * (lands_z - state[at + PLANT + 1])
    # the line is kept in the world: in the body frame a turn of the root would bend it over the edge of a tread
    turn = _wrapped(state[HEADING] + state[at + LANDS_AT + 2] - state[at + PLANT + 2])
    left, ahead, yaw = _to_body(state[X], state[Z], state[HEADING], x, z, state[at + PLANT + 2] + done * turn)
    return left, ahead, yaw, done


@kernel_part(borrows=True)
def _swing_line(table, k, f, state, foot, share):
    """Return the same as `_swing_place`, at a share of the swing and without obstacles."""
    at = FOOT + foot * FOOT_COLUMNS
    since = state[at + SINCE]
    if _steps_off(table, state, foot):
        part = min(max((share - since) / max(1.0 - since, 1e-6), 0.0), 1.0)
        # over its tread before the end, so that it comes down from above and not through the nose
        return _stair_line(table, k, f, state, foot, _eased(min(part / OVER_BY, 1.0)), 0.0)
    done = _eased(min(max((share - since) / max(1.0 - since, 1e-6), 0.0), 1.0))
    side = table.half_width if foot == 0 else -table.half_width
    left = side + (1 - done) * state[at + LEFT_AT] + done * state[at + LANDS_AT]
    # what the foot was off when it left fades out while what it should be off when it lands fades in
    ahead = _swing_ahead(table, k, f, state[SPEED], share)
    ahead += (1 - done) * state[at + LEFT_AT + 1] + done * state[at + LANDS_AT + 1]
    yaw = (1 - done) * state[at + LEFT_AT + 2] + done * state[at + LANDS_AT + 2]
    return left, ahead, yaw, done


@kernel_part(borrows=True)
def _swing_place(table, k, f, state, foot):
    """Return where a swinging foot is over the floor, in the body frame, and how far it has moved since it left."""
    left, ahead, yaw, done = _swing_line(table, k, f, state, foot, state[FOOT + foot * FOOT_COLUMNS + SHARE])
    left, ahead = _beside_things(table, state, foot, left, ahead, yaw, 1.0)
    return left, ahead, yaw, done


@kernel_part(borrows=True)
def _foot_place(table, k, f, state, foot):
    """Return where a foot is over the floor, in the body frame: left, ahead, yaw."""
    at = FOOT + foot * FOOT_COLUMNS
    if state[at + AIR] > 0.0:
        left, ahead, yaw, _ = _swing_place(table, k, f, state, foot)
        return left, ahead, yaw
    return _to_body(state[X], state[Z], state[HEADING], state[at + PLANT], state[at + PLANT + 1], state[at + PLANT + 2])


@kernel_part(borrows=True)
def _curve(curves, k, f, share, i):
    place = min(max(share, 0.0), 1.0) * (curves.shape[1] - 1)
    low = min(int(place), curves.shape[1] - 2)
    part = place - low
    # linear in the share and in the speed, between samples that are dense enough not to show
    below = curves[k, low, i] + part * (curves[k, low + 1, i] - curves[k, low, i])
    above = curves[k + 1, low, i] + part * (curves[k + 1, low + 1, i] - curves[k + 1, low, i])
    return below + f * (above - below)


@kernel_part(borrows=True)
def _gait_shape(table, k, f, state, foot):
    """Return pitch, bend [deg], and the ankle's place forward and up from a foot's place, as in the gait."""
    at = FOOT + foot * FOOT_COLUMNS
    if state[at + AIR] == 0.0:
        share = _own_phase(state[PHASE], foot) / _at(table.stance, k, f)
        # who walks backwards rolls from toe to heel; the curves of walking forwards would look like a limp, so
        # feet stay flat
        forwards = 1.0 if state[SPEED] >= 0.0 else 0.0
        pitch = forwards * _curve(table.stand_foot, k, f, share, 0)
        return pitch, forwards * _curve(table.stand_foot, k, f, share, 1), 0.0, 0.0
    share, aside = state[at + SHARE], 1.4 * (table.half_width if foot == 0 else -table.half_width)
    # a raised knee needs room: where there are less than 10 cm ahead of the foot, drawn steps get lower, down to 0.3
    low = min(max(0.3 + 7.0 * _room_at(table, state, aside, 0.25)[0], 0.3), 1.0) if table.clear > 0.0 else 1.0
    # backwards a little of the swing is left: without any the toes would drag
    forwards = low * (1.0 if state[SPEED] >= 0.0 else 0.3)
    pitch, bend = _curve(table.swing_foot, k, f, share, 0), _curve(table.swing_foot, k, f, share, 1)
    along, up = _curve(table.swing_path, k, f, share, 0), _curve(table.swing_path, k, f, share, 1)
    # a turn of the foot counts as its toes move: they are about 0.2 m from the ankle
    off = math.hypot(
        state[at + LEFT_AT] - state[at + LANDS_AT], state[at + LEFT_AT + 1] - state[at + LANDS_AT + 1]
    ) + 0.2 * abs(state[at + LEFT_AT + 2] - state[at + LANDS_AT + 2])
    # its square has no speed at either end, as the path has none
    arc = math.sin(math.pi * min(max((share - state[at + SINCE]) / max(1 - state[at + SINCE], 1e-6), 0.0), 1.0))
    # drawn knees pop less with 0.4 of the lift
    lift = low * min((1 - 0.6 * table.clear) * LIFT * off, LIFT_MOST_M) * arc * arc
    return forwards * pitch, forwards * bend, forwards * along, up + lift - (1 - low) * (up - table.ankle_height)


@kernel_part(borrows=True)
def _shape(table, k, f, state, foot):
    """Return `_gait_shape` with contact: a foot on the floor pivots about heel or ball, others stay above it."""
    at, feet = FOOT + foot * FOOT_COLUMNS, table.legs.feet[foot]
    pitch, bend, along, up = _gait_shape(table, k, f, state, foot)
    pitch, bend = pitch + state[at + SHAPE_OFF], max(bend + state[at + SHAPE_OFF + 1], 0.0)
    if state[at + AIR] == 0.0:
        bend = max(-pitch, 0.0)
        # toes up it stands on the heel, heel up on the ball; the pivot keeps its place, so the ankle moves
        # about it
        pivot = 0 if pitch > 0.0 else 1
        c, s = math.cos(math.radians(pitch)), math.sin(math.radians(pitch))
        y, z = feet[pivot, 1], feet[pivot, 2]
        return pitch, bend, z - (c * z - s * y), y - (c * y + s * z) + table.ankle_height
    along, up = along + state[at + SHAPE_OFF + 2], up + state[at + SHAPE_OFF + 3]
    share = (state[at + SHARE] - state[at + SINCE]) / max(1 - state[at + SINCE], 1e-6)
    # the clearance grows and ends within the swing: a jump by it would show when the foot leaves or lands
    clear = CLEARANCE_M * min(1.0, 8 * share, 12 * (1 - share))
    return pitch, bend, along, up + max(clear - lowest(feet, up, pitch, bend), 0.0)


@kernel_part(borrows=True)
def _ankle(table, k, f, state, foot):
    """Return the ankle in the body frame, pitch, bend [deg] and yaw [rad] of a foot."""
    left, ahead, yaw = _foot_place(table, k, f, state, foot)
    pitch, bend, along, up = _shape(table, k, f, state, foot)
    c, s = math.cos(yaw), math.sin(yaw)
    # last, because the height of the floor depends on how far ahead the ankle is
    up += _above_root(table, k, f, state, foot, along)
    # of drawn people again: beside its place on the floor, a swinging ankle reaches farther ahead
    flat = table.clear * state[FOOT + foot * FOOT_COLUMNS + AIR] * math.cos(math.radians(pitch))
    left, ahead = _beside_things(table, state, foot, left + s * along, ahead + c * along, yaw, flat)
    return (left, up, ahead), pitch, bend, yaw


@kernel_part(borrows=True)
def _write_feet(table, state, ankle, foot):
    """Writes ankles [2, 3] in the body frame, and pitch, yaw and bend of the feet [2, 3] [deg]."""
    # feet go by the speed, trunk and arms by the style, which follows it more slowly
    k, f = _row(table, state[SPEED])
    for side in range(2):
        at, pitch, bend, yaw = _ankle(table, k, f, state, side)
        ankle[side, 0], ankle[side, 1], ankle[side, 2] = at
        foot[side, 0], foot[side, 1], foot[side, 2] = pitch, math.degrees(yaw), bend


@kernel_part(borrows=True)
def _knee_from(table, path, turn):
    """Return the place of a knee from its hip, and how far it is off the line to the ankle.

    ``path`` is from hip to ankle, and ``turn`` the direction of the knee [rad].
    """
    thigh, shank, square = table.legs.thigh, table.legs.shank, dot(path, path)
    # the knee is on a circle of radius ``bow`` about the line from hip to ankle
    part = (thigh * thigh - shank * shank + square) / (2 * square)
    bow = math.sqrt(max(thigh * thigh - part * part * square, 0.0))
    return part * path[0] + bow * math.sin(turn), part * path[1], part * path[2] + bow * math.cos(turn), bow


@kernel_part(borrows=True)
def _knee(table, state, quats, pelvis, ankle, foot, side):
    """Returns the outward component of the direction of a knee, as `write_legs` needs it.

    Knees of drawn people turn by half of the yaw of the foot, and away from obstacles. Knees that point where the feet do
    are up to 8 cm inside counters from which people turn away, since the trailing foot lags behind by up to 31 degrees.
    """
    if table.clear == 0.0:
        return KNEES[side]
    yaw = math.radians(foot[side, 1])
    hip = plus((pelvis[0], pelvis[1], pelvis[2]), turned(row4(quats, 0), row3(table.legs.hips, side)), 1.0)
    path, turn = plus(row3(ankle, side), hip, -1.0), 0.5 * yaw + KNEES[side]
    for _ in range(3):
        c, s = math.cos(turn), math.sin(turn)
        knee = _knee_from(table, path, turn)
        room, away = _room_at(table, state, hip[0] + knee[0], hip[2] + knee[2])
        # 0.12: distance of a knee from obstacles [m], a little more than its radius
        turn += min(max(0.12 - room, 0.0) / max(knee[3], 0.05), 0.5) * (c * away[0] - s * away[1])
    return math.tan(min(max(turn, -0.8), 0.8)) * math.cos(yaw) - math.sin(yaw)


@kernel_part(borrows=True)
def _keep_shape(table, k, f, state, foot, shape):
    """Keep the earlier ``shape`` (pitch, bend, forward, up) of a foot that has just left the floor or landed.

    The state stores the difference from the gait, which fades later.
    """
    at = FOOT + foot * FOOT_COLUMNS
    # the difference is kept and fades: the shape itself must not jump from that of a standing to that of a swinging
    # foot
    now = _gait_shape(table, k, f, state, foot)
    state[at + SHAPE_OFF], state[at + SHAPE_OFF + 1] = shape[0] - now[0], shape[1] - now[1]
    in_air = state[at + AIR]
    state[at + SHAPE_OFF + 2], state[at + SHAPE_OFF + 3] = in_air * (shape[2] - now[2]), in_air * (shape[3] - now[3])


@kernel_part(borrows=True)
def _plant(table, state, foot, place, steps):
    at = FOOT + foot * FOOT_COLUMNS
    x, z, heading = _to_world(state[X], state[Z], state[HEADING], place[0], place[1], place[2])
    if table.heights.shape[0]:
        # it may land a little beside where it aimed; at rest it has to be on one tread
        x, z = _on_a_tread(table, state, foot, x, z, heading, _came_from(table, state, foot) if steps else -1)
    state[at + AIR] = 0.0
    state[at + PLANT], state[at + PLANT + 1], state[at + PLANT + 2] = x, z, heading


@kernel_part(borrows=True)
def _leave(table, k, f, state, foot, share):
    """Let a foot leave the floor, with a share of its swing already done."""
    at = FOOT + foot * FOOT_COLUMNS
    left, ahead, yaw = _foot_place(table, k, f, state, foot)
    side = table.half_width if foot == 0 else -table.half_width
    # before the foot counts as swinging, since the shape is that of a standing foot until then
    shape = _shape(table, k, f, state, foot)
    state[at + AIR], state[at + SHARE], state[at + SINCE] = 1.0, share, share
    state[at + LEFT_AT] = left - side
    state[at + LEFT_AT + 1] = ahead - _swing_ahead(table, k, f, state[SPEED], share)
    state[at + LEFT_AT + 2] = yaw
    for i in range(3):
        state[at + LANDS_AT + i] = 0.0
    _keep_shape(table, k, f, state, foot, shape)


@kernel_part(borrows=True)
def stand_at(table, state, x, z, heading):
    """Set a state, in place, to a person who stands at a root (x, z, heading)."""
    for i in range(len(state)):
        state[i] = 0.0
    state[X], state[Z], state[HEADING] = x, z, heading
    for foot in range(2):
        side = table.half_width if foot == 0 else -table.half_width
        _plant(table, state, foot, (side, table.middle[0], 0.0), False)
    k, f = _row(table, 0.0)  # not the constants 0 and 0.0, for which numba would compile everything a second time
    _settle_pelvis(table, k, f, state, 0.0)


@kernel_part(borrows=True)
def is_settled(table, state):
    """Return whether both feet are in the standing position."""
    k, f = _row(table, 0.0)
    for foot in range(2):
        at = FOOT + foot * FOOT_COLUMNS
        if state[at + AIR] > 0.0:
            return False
        left, ahead, yaw = _foot_place(table, k, f, state, foot)
        side, middle = _stand_place(table, state, foot)
        if math.hypot(left - side, ahead - middle) > SETTLED_M or abs(yaw) > SETTLED_RAD:
            return False
    return True


@kernel_part(borrows=True)
def _begin(table, k, f, state):
    """Begin the first step, with the foot that is farther from its place, or that towards which the root turns."""
    # turning to the left the left foot opens the turn; the other one would step across it
    worst, wrong = 1 if state[TURN] < 1e-3 else 0, 0.0
    rest_k, rest_f = _row(table, 0.0)
    for foot in range(2):
        left, ahead, yaw = _foot_place(table, rest_k, rest_f, state, foot)
        side = table.half_width if foot == 0 else -table.half_width
        off = math.hypot(left - side, ahead - table.middle[0]) + 0.2 * abs(yaw)
        # a margin, so that rounding does not decide which foot goes first
        if off > wrong + SETTLED_M:
            worst, wrong = foot, off
    stance = _at(table.stance, k, f)
    # half a cycle ahead of the foot that stays, which has `FIRST_SHARE` of its stance behind it
    own = FIRST_SHARE * stance + 0.5
    state[PHASE] = (own + 0.5 * worst) % 1.0
    state[SHOWN] = state[PHASE] if abs(state[SPEED]) < 0.3 else state[SHOWN]
    _leave(table, k, f, state, worst, max((own - stance) / (1 - stance), 0.0))


@kernel_part(borrows=True)
def _change_speed(table, state, velocity, most):
    """Bring the gait's speed nearer to the root's without moving the feet, whose difference fades later."""
    k, f = _row(table, state[SPEED])
    was = state[SPEED]
    speed = was + min(max(velocity - was, -most), most)
    below, part = _row(table, speed)
    for foot in range(2):
        at = FOOT + foot * FOOT_COLUMNS
        old = _gait_shape(table, k, f, state, foot)
        if state[at + AIR] > 0.0:
            ahead = _swing_ahead(table, k, f, was, state[at + SHARE])
            # both ends get the difference: the foot stays where it is now, and where it was going to land
            off = ahead - _swing_ahead(table, below, part, speed, state[at + SHARE])
            state[at + LEFT_AT + 1] += off
            state[at + LANDS_AT + 1] += off
        state[SPEED] = speed
        new = _gait_shape(table, below, part, state, foot)
        state[SPEED] = was
        for i in range(2):
            state[at + SHAPE_OFF + i] += old[i] - new[i]
        if state[at + AIR] > 0.0:
            for i in range(2, 4):
                state[at + SHAPE_OFF + i] += old[i] - new[i]
    state[SPEED] = speed


@kernel_part(borrows=True)
def step_gait(table, state, x, z, heading, dt):
    """Advance a state by one step in which the root moves to (x, z, heading) [m, m, rad]."""
    dx, dz = x - state[X], z - state[Z]
    way = math.hypot(dx, dz)
    # also true for NaN, of which every comparison is false: an absent person stands again when they are back
    if not way <= JUMP_M:
        stand_at(table, state, x, z, heading)
        return
    turned_by = _wrapped(heading - state[HEADING])
    # on an arc the chord points along the heading halfway; with either end, a turn would look like a step sideways
    middle = state[HEADING] + turned_by / 2
    forward = math.cos(middle) * dx - math.sin(middle) * dz
    rests = way < 1e-4 and abs(turned_by) < 1e-4
    velocity = math.copysign(way, forward) / dt
    k, f = _row(table, state[SPEED])
    # zeros for people who are not only drawn, whose legs are not watched
    still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    was = (_leg_at(table, k, f, state, 0), _leg_at(table, k, f, state, 1)) if table.clear > 0.0 else (still, still)
    state[X], state[Z], state[HEADING] = x, z, heading
    state[TIME] += dt
    state[TURN] += TURN_SHARE * (turned_by / dt - state[TURN])
    gain = AHEAD_ACCELERATION * dt
    state[AHEAD] += min(max(velocity - state[AHEAD], -gain), gain)
    climbs = table.heights.shape[0] > 0 and beside_steps(table.heights, x, z)
    most = _climbing_speed(table) if climbs else 0.0
    gait = min(max(velocity, -most), most) if climbs else velocity
    # the gait follows more slowly than the root: recorded roots stop within one step, feet cannot
    _change_speed(table, state, gait, ACCELERATION * dt)
    slow = STYLE_ACCELERATION * dt
    state[STYLE] += min(max(state[SPEED] - state[STYLE], -slow), slow)
    # a filtered turn never becomes 0 by itself, and a person who rests would never count as settled
    if rests and abs(state[TURN]) < 0.02:
        state[TURN] = 0.0
    _turn_look(state, dt)
    k, f = _row(table, state[SPEED])
    stands = state[FOOT + AIR] == 0.0 and state[FOOT + FOOT_COLUMNS + AIR] == 0.0
    calm = abs(state[SPEED]) < 0.02 and abs(velocity) < 0.02 and abs(state[TURN]) < 0.1
    if stands and calm and is_settled(table, state):
        state[IDLE] = min(state[IDLE] + IDLE_IN * dt, 1.0)
        state[FOOT + SHARE] = state[FOOT + FOOT_COLUMNS + SHARE] = 0.0
    else:
        state[IDLE] = max(state[IDLE] - IDLE_OUT * dt, 0.0)
        rate = abs(state[SPEED]) / _at(table.travel, k, f) if k > 0 else table.cadence[0]
        if (
            climbs and abs(gait) == most
        ):  # steps are as long as the stairs have them, so their number depends on the speed
            rate = abs(velocity) / max(_at(table.travel, k, f), 0.2)
        # on the spot the root travels nothing; steps then follow from the turn
        rate = max(rate, CYCLES_PER_RAD * abs(state[TURN]))
        # whoever has stopped still brings the feet together
        rate = max(rate, SETTLE_HZ) if velocity == 0.0 else rate
        flies = state[FOOT + AIR] + state[FOOT + FOOT_COLUMNS + AIR]
        if flies == 1.0 and not climbs:  # a foot that is left behind needs the other one soon
            behind = 0 if state[FOOT + AIR] == 0.0 else 1
            rate *= 1 + min(max(_lacks(table, k, f, state, behind) - 0.01, 0.0) / 0.04, 1.0)
        if stands and state[FOOT + SHARE] == 0.0 and state[FOOT + FOOT_COLUMNS + SHARE] == 0.0:
            _begin(table, k, f, state)
        span, watched = _at(table.stance, k, f) / max(rate, 0.3), table.clear > 0.0 and abs(state[SPEED]) <= WALKS_MPS
        ahead = _unhurried(table, k, f, state, watched, was, min(rate * dt, 0.12), span, dt)
        _advance(table, k, f, state, watched, ahead, span, rests)
        _show(state, ahead)
    _settle_pelvis(table, k, f, state, dt)


@kernel_part(borrows=True)
def _climbing_speed(table):
    """Return the speed of the gait whose steps are one tread long [m/s]."""
    # a cycle is two steps
    length = 2 * tread_length(table.heights)
    k = 0
    while k < len(table.speeds) - 2 and table.travel[k + 1] < length:
        k += 1
    share = (length - table.travel[k]) / (table.travel[k + 1] - table.travel[k])
    return table.speeds[k] + share * (table.speeds[k + 1] - table.speeds[k])


@kernel_part(borrows=True)
def _turn_look(state, dt):
    """Turn the head by one step towards the future direction of the root."""
    wanted = min(max(LOOK_S * state[TURN], -LOOK_RAD), LOOK_RAD)
    # proportional, then limited in speed and in acceleration: heads have mass
    rate = min(max(LOOK_GAIN * (wanted - state[LOOK]), -LOOK_RAD_S), LOOK_RAD_S)
    most = LOOK_ACCELERATION * dt
    state[LOOK_RATE] += min(max(rate - state[LOOK_RATE], -most), most)
    state[LOOK] += state[LOOK_RATE] * dt


@kernel_part(borrows=True)
def _toes(table, k, f, state, foot, share):
    """Return ankle and toes of a swinging foot along the floor in the body frame, if it is free: left, 0 and ahead."""
    left, ahead, yaw, _ = _swing_line(table, k, f, state, foot, share)
    along = _curve(table.swing_path, k, f, share, 0)
    s, c, toes = math.sin(yaw), math.cos(yaw), along + TOE_M
    return (left + s * along, 0.0, ahead + c * along), (left + s * toes, 0.0, ahead + c * toes), (0.0, 0.0, 0.0)


@kernel_part(borrows=True)
def _leg_at(table, k, f, state, foot):
    """Return ankle, ball and knee of a leg in the body frame: left, up and ahead. The knee points half where the foot does."""
    ankle, pitch, _, yaw = _ankle(table, k, f, state, foot)
    c, s, (_, y, z) = math.cos(math.radians(pitch)), math.sin(math.radians(pitch)), row3(table.legs.feet[foot], 1)
    hip = plus(_pelvis(table, state), turned(_pelvis_turn(table, state), row3(table.legs.hips, foot)), 1.0)
    knee = _knee_from(table, plus(ankle, (hip[0], hip[1] - state[SINK], hip[2]), -1.0), 0.5 * yaw)
    # a foot's own frame is pitched about its ankle
    return (
        ankle,
        plus(ankle, (math.sin(yaw) * (c * z - s * y), c * y + s * z, math.cos(yaw) * (c * z - s * y)), 1.0),
        knee[:3],
    )


@kernel_part(borrows=True)
def _unhurried(table, k, f, state, watched, was, ahead, span, dt):
    """Return the cycles, at most ``ahead``, by which the phase advances so that no swinging leg moves too fast.

    What differs from the gait fades by a share. Watched legs were at ``was`` (`_leg_at`) one step ago. Their landing
    positions move here, as feet move along with them; those of others move in `_advance`.
    """
    slowest, most = ahead, max(SWING_MPS, (1.0 + 0.04 * watched) * _at(table.swing, k, f)) * dt
    for foot in range(2):
        at = FOOT + foot * FOOT_COLUMNS
        for i in range(4):  # by a share, so that the difference has no end that could be seen
            state[at + SHAPE_OFF + i] *= SHAPE_LEFT
        share = state[at + SHARE]
        if state[at + AIR] == 0.0:
            continue
        rest = max(1.0 - _own_phase(state[PHASE], foot), 1e-9)
        before = was[foot] if watched else _toes(table, k, f, state, foot, share)
        if watched:
            _aim(table, k, f, state, foot, span, ahead)
        for _ in range(2):  # the path is nearly straight
            state[at + SHARE], moved = share + (1 - share) * min(slowest / rest, 1.0), 0.0
            there = _leg_at(table, k, f, state, foot) if watched else _toes(table, k, f, state, foot, state[at + SHARE])
            for i in range(3):
                left, up, onward = plus(there[i], before[i], -1.0)
                moved = max(moved, math.hypot(math.hypot(left, onward), up) * (1.0, 1.0, KNEE_SHARE)[i])
            slowest *= min(most / max(moved, 1e-9), 1.0)
        state[at + SHARE] = share
    return slowest


@kernel_part(borrows=True)
def _advance(table, k, f, state, watched, ahead, span, rests):
    """Advance the phase by ``ahead`` cycles, in which feet leave the floor, fly and land; a stance lasts ``span`` [s]."""
    stance = _at(table.stance, k, f)
    landed, shapes = -1, (0.0, 0.0, 0.0, 0.0)
    for foot in range(2):
        at = FOOT + foot * FOOT_COLUMNS
        own = _own_phase(state[PHASE], foot)
        after = own + ahead
        if state[at + AIR] == 0.0:
            # one foot always stays on the floor: people do not hop to catch up
            stands = state[FOOT + (1 - foot) * FOOT_COLUMNS + AIR] == 0.0
            if stands and stance > after > EARLY_SHARE * stance and _lacks(table, k, f, state, foot) > EARLY_M:
                _leave(table, k, f, state, foot, 0.0)
            elif after >= stance and after < 1.0:
                _leave(table, k, f, state, foot, 0.0)
                state[at + SHARE] = min((after - stance) / (1 - stance), 1.0)
        else:
            # the rest of the swing over the rest of the phase: a foot that left late still lands at its
            # strike
            state[at + SHARE] += (1 - state[at + SHARE]) * min(ahead / max(1.0 - own, 1e-9), 1.0)
        if state[at + AIR] > 0.0:
            if not watched:
                _aim(table, k, f, state, foot, span, ahead)
            if after >= 1.0:
                state[at + SHARE] = 1.0
                left, onward, yaw, _ = _swing_place(table, k, f, state, foot)
                past = 0.0
                if _steps_off(table, state, foot):
                    left, onward, yaw, _ = _stair_line(table, k, f, state, foot, 1.0, ahead)
                else:
                    # the step ends after the strike: since then the floor has carried the foot back
                    # under the body
                    past = _gait_ahead(table, k, f, state[SPEED], after - 1.0) - _gait_ahead(
                        table, k, f, state[SPEED], 0.0
                    )
                shape = _shape(table, k, f, state, foot)
                # where a drawn foot is shown, which may still be off the gait
                off = table.clear * state[at + SHAPE_OFF + 2]
                _plant(table, state, foot, (left + math.sin(yaw) * off, onward + past + math.cos(yaw) * off, yaw), True)
                landed, shapes = foot, shape
    state[PHASE] = (state[PHASE] + ahead) % 1.0
    if rests and state[FOOT + AIR] > 0.0 and state[FOOT + FOOT_COLUMNS + AIR] > 0.0:
        # the root stopped in flight: who is nearer to the floor lands now
        landed = 0 if state[FOOT + SHARE] >= state[FOOT + FOOT_COLUMNS + SHARE] else 1
        left, onward, yaw, _ = _swing_place(table, k, f, state, landed)
        shapes = _shape(table, k, f, state, landed)
        _plant(table, state, landed, (left, onward, yaw), True)
        state[FOOT + landed * FOOT_COLUMNS + SHARE] = 1.0
        state[PHASE] = 0.5 * landed
    if landed >= 0:
        _keep_shape(table, k, f, state, landed, shapes)


@kernel_part(borrows=True)
def _aim(table, k, f, state, foot, span, gone):
    """Move the landing place of a swinging foot ahead, by half of what the root moves in its stance beyond the gait."""
    at = FOOT + foot * FOOT_COLUMNS
    half = span / 2
    yaw = min(max(state[TURN] * half, -TWIST_RAD), TWIST_RAD)
    # the root outruns the gait while it speeds up; without this feet land behind and the pelvis sinks
    ahead = min(max((state[AHEAD] - state[SPEED]) * half, -OFF_M), OFF_M)
    # on an arc the body drifts aside by v w t^2 / 2 in half a stance
    left = min(max(state[SPEED] * state[TURN] * half * half / 2, -0.12), 0.12)
    if table.heights.shape[0]:
        if beside_steps(table.heights, state[X], state[Z]):
            ahead = 0.0
        x, z = _lands_at(table, k, f, state, foot, left, ahead, gone)
        to_x, to_z = _on_a_tread(table, state, foot, x, z, state[HEADING] + yaw, _came_from(table, state, foot))
        c, s = math.cos(state[HEADING]), math.sin(state[HEADING])
        left, ahead = left - s * (to_x - x) - c * (to_z - z), ahead + c * (to_x - x) - s * (to_z - z)
    for i, aim, most in ((0, left, LANDING_M), (1, ahead, LANDING_M), (2, yaw, LANDING_RAD)):
        step = aim - state[at + LANDS_AT + i]
        state[at + LANDS_AT + i] += min(max(step, -most), most)


@kernel_part(borrows=True)
def _show(state, ahead):
    """Set trunk and arms by the phase of the feet, which has advanced by ``ahead`` cycles."""
    gap = state[PHASE] - state[SHOWN] - ahead
    # the shorter way round the cycle
    gap -= math.floor(gap + 0.5)
    state[SHOWN] = (state[SHOWN] + ahead + min(max(0.15 * gap, -CATCH_UP), CATCH_UP)) % 1.0


@kernel_part(borrows=True)
def _columns(table, phase):
    place = phase * table.quats.shape[1]
    low = int(math.floor(place)) % table.quats.shape[1]
    return low, (low + 1) % table.quats.shape[1], place - math.floor(place)


@kernel_part(borrows=True)
def _pelvis(table, state):
    k, f = _row(table, state[STYLE])
    low, high, share = _columns(table, state[SHOWN])
    x, y, z = 0.0, 0.0, 0.0
    for row, weight in ((k, 1 - f), (k + 1, f)):
        a, b = row3(table.pelvis[row], low), row3(table.pelvis[row], high)
        x += weight * (a[0] + share * (b[0] - a[0]))
        y += weight * (a[1] + share * (b[1] - a[1]))
        z += weight * (a[2] + share * (b[2] - a[2]))
    # standing people shift their weight: 5.3 s and 3.7 s share no period below 196 s, so that poses hardly repeat
    idle = _eased(state[IDLE])
    x += idle * 0.009 * math.sin(2 * math.pi * state[TIME] / 5.3)
    y -= idle * 0.003 * (1 - math.cos(2 * math.pi * state[TIME] / 5.3))
    return x, y, z


@kernel_part(borrows=True)
def _joint(table, k, f, low, high, share, j):
    below = nlerp(row4(table.quats[k, low], j), row4(table.quats[k, high], j), share)
    # saves half the work where the speed is that of a row, as for everybody who stands
    if f == 0.0:
        return below
    above = nlerp(row4(table.quats[k + 1, low], j), row4(table.quats[k + 1, high], j), share)
    return nlerp(below, above, f)


@kernel_part(borrows=True)
def _pelvis_turn(table, state):
    k, f = _row(table, state[STYLE])
    low, high, share = _columns(table, state[SHOWN])
    return _joint(table, k, f, low, high, share, 0)


@kernel_part(borrows=True)
def _tallest(table, aside, onward):
    """Return how high a hip may be above its ankle, which is ``aside`` and ``onward`` from it along the floor [m]."""
    longest = STRETCHED * (table.legs.thigh + table.legs.shank)
    return math.sqrt(max(longest * longest - aside * aside - onward * onward, 0.0))


@kernel_part(borrows=True)
def _lacks(table, k, f, state, foot):
    """Return how far the pelvis of the gait must sink for a foot to be within reach [m]."""
    place, turn = _pelvis(table, state), _pelvis_turn(table, state)
    ankle, _, _, _ = _ankle(table, k, f, state, foot)
    hip = turned(turn, row3(table.legs.hips, foot))
    return place[1] + hip[1] - ankle[1] - _tallest(table, place[0] + hip[0] - ankle[0], place[2] + hip[2] - ankle[2])


@kernel_part(borrows=True)
def _will_lack(table, k, f, state, foot):
    """Return the same as `_lacks` for a swinging foot once it has landed flat, while the pelvis stays where it is."""
    place, turn = _pelvis(table, state), _pelvis_turn(table, state)
    at, feet = FOOT + foot * FOOT_COLUMNS, table.legs.feet[foot]
    x, z = _lands_at(table, k, f, state, foot, state[at + LANDS_AT], state[at + LANDS_AT + 1], 0.0)
    heading = state[HEADING] + state[at + LANDS_AT + 2]
    gone = math.copysign(1.0, state[SPEED]) * _at(table.travel, k, f) * (1.0 - _own_phase(state[PHASE], foot))
    left, ahead, _ = _to_body(state[X], state[Z], state[HEADING], x, z, heading)
    root_x, root_z, _ = _to_world(state[X], state[Z], state[HEADING], 0.0, gone, 0.0)
    floor = under_foot(table.heights, x, z, heading, feet[0, 2], feet[2, 2])
    up = floor - height_at(table.heights, 0.0, root_x, root_z) + table.ankle_height
    hip = turned(turn, row3(table.legs.hips, foot))
    return place[1] + hip[1] - up - _tallest(table, place[0] + hip[0] - left, place[2] + hip[2] - (ahead - gone))


@kernel_part(borrows=True)
def _settle_pelvis(table, k, f, state, dt):
    """Lower the pelvis below that of the gait as far as the planted feet need it."""
    sink, climbs = 0.0, table.heights.shape[0] > 0
    for foot in range(2):
        at = FOOT + foot * FOOT_COLUMNS
        # a foot that has left needs the pelvis less and less: the pelvis would bob if it dropped the demand at once
        done = min((state[at + SHARE] - state[at + SINCE]) / LETS_GO, 1.0) if state[at + AIR] > 0.0 else 0.0
        sink = max(sink, (1 - _eased(done)) * _lacks(table, k, f, state, foot))
        if climbs and state[at + AIR] > 0.0 and _steps_off(table, state, foot):
            # one that will come down on a lower tread draws the pelvis down in time
            share = min(max((state[at + SHARE] - DRAWS) / (1 - DRAWS), 0.0), 1.0)
            sink = max(sink, _eased(share) * _will_lack(table, k, f, state, foot))
    if climbs and beside_steps(table.heights, state[X], state[Z]):
        sink = max(sink, min(CROUCH_M, state[SINK] + CROUCH_MPS * dt))
    # down at once, or a leg would tear off its foot; up slowly, or the body would bounce at every step
    state[SINK] = max(sink, state[SINK] - RISE_MPS * dt)


@kernel_part(borrows=True)
def pose_state(table, state, quats, pelvis, ankle, foot, angles):
    """Write the pose of a state into ``quats`` [55, 4] and ``pelvis`` [3] [m], in the agent root frame."""
    k, f = _row(table, state[STYLE])
    low, high, share = _columns(table, state[SHOWN])
    for j in range(quats.shape[0]):
        put(quats, j, _joint(table, k, f, low, high, share, j))
    idle = _eased(state[IDLE])
    breath = idle * 0.010 * math.sin(2 * math.pi * state[TIME] / 3.7)
    sway = -idle * 0.012 * math.sin(2 * math.pi * state[TIME] / 5.3)
    for j in _SPINES:
        put(quats, j, multiply(row4(quats, j), from_vector(-breath, 0.0, sway)))
    for j in (_NECK, _HEAD):
        put(quats, j, multiply(from_vector(0.0, 0.5 * state[LOOK], 0.0), row4(quats, j)))
    place = _pelvis(table, state)
    pelvis[0], pelvis[1], pelvis[2] = place[0], place[1] - state[SINK], place[2]
    _write_feet(table, state, ankle, foot)
    knees = (_knee(table, state, quats, pelvis, ankle, foot, 0), _knee(table, state, quats, pelvis, ankle, foot, 1))
    write_legs(table.legs, quats, pelvis, ankle, foot, knees, angles)
    to_root = row4(table.to_root.reshape(1, 4), 0)
    put(quats, 0, multiply(to_root, row4(quats, 0)))
    pelvis[0], pelvis[1], pelvis[2] = turned(to_root, (pelvis[0], pelvis[1], pelvis[2]))


@kernel(error_model="numpy")
def run_gaits(table, xz, heading, seconds, step_s, states):
    """Fill states [T, K] for a root at ``xz`` [T, 2] [m] and ``heading`` [T] [rad].

    The person stands in the first row and after jumps.

    Each row is ``seconds`` [T] after the previous one. Between rows that are further apart than ``step_s``, the root
    moves along a straight line in several steps.
    """
    for t in range(len(states)):
        if t == 0:
            stand_at(table, states[0], xz[0, 0], xz[0, 1], heading[0])
            continue
        for i in range(states.shape[1]):
            states[t, i] = states[t - 1, i]  # `states[t] = ...` takes 1.6 s to compile
        count = min(max(int(seconds[t] / step_s + 0.5), 1), MOST_STEPS)
        turn = _wrapped(heading[t] - heading[t - 1])
        if not math.hypot(xz[t, 0] - xz[t - 1, 0], xz[t, 1] - xz[t - 1, 1]) <= JUMP_M * count:
            stand_at(table, states[t], xz[t, 0], xz[t, 1], heading[t])
            continue
        for part in range(1, count + 1):
            share = part / count
            x = xz[t - 1, 0] + share * (xz[t, 0] - xz[t - 1, 0])
            z = xz[t - 1, 1] + share * (xz[t, 1] - xz[t - 1, 1])
            dt = max(seconds[t] / count, LEAST_S)
            # times are rounded in files: the same step must give the same bits as when it was simulated
            dt = step_s if abs(dt - step_s) < SAME_S else dt
            step_gait(table, states[t], x, z, heading[t - 1] + share * turn, dt)


@kernel(error_model="numpy")
def pose_gaits(table, states, quats, pelvis):
    """Write the poses of states [T, K] into ``quats`` [T, 55, 4] and ``pelvis`` [T, 3] [m], in the agent root frame."""
    ankle, foot, angles = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    for t in range(len(states)):
        pose_state(table, states[t], quats[t], pelvis[t], ankle, foot, angles)


@kernel(error_model="numpy")
def stand_one(table, state, x, z, heading):
    """Set one state [K] to a person who stands at a root."""
    stand_at(table, state, x, z, heading)


@kernel(error_model="numpy")
def step_one(table, state, x, z, heading, dt):
    """Advance one state [K] by one step in which the root moves to (x, z, heading) [m, m, rad]."""
    step_gait(table, state, x, z, heading, dt)


@kernel(error_model="numpy")
def stride_one(table, state, x, z, heading, dt, quats, pelvis):
    """Advance one state [K] by one step and write its pose: `step_one` and `pose_gaits` in one call."""
    step_gait(table, state, x, z, heading, dt)
    pose_state(table, state, quats, pelvis, np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)))


@kernel(error_model="numpy")
def one_stands(table, state):
    """Return whether both feet of a state [K] are at rest in the standing position, so that no further step follows."""
    return state[SPEED] == 0.0 and abs(state[TURN]) < 0.1 and is_settled(table, state)


@kernel(error_model="numpy")
def plant_legs(table, state, quats, pelvis):
    """Rewrite the legs of any pose, in place, so that the feet are where a state [K] has them.

    The pose, quats [55, 4] and pelvis [3], is in the agent root frame. The pelvis sinks where a leg would be too short.
    """
    ankle, foot, angles = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    _write_feet(table, state, ankle, foot)
    to_root = row4(table.to_root.reshape(1, 4), 0)
    # legs are solved in the body frame, and recorded in that of the agent root
    to_body = inverse(to_root)
    put(quats, 0, multiply(to_body, row4(quats, 0)))
    place = turned(to_body, (pelvis[0], pelvis[1], pelvis[2]))
    sink = sinking(table.legs.hips, table.legs.longest, row4(quats, 0), place, ankle)
    pelvis[0], pelvis[1], pelvis[2] = place[0], place[1] - sink, place[2]
    write_legs(table.legs, quats, pelvis, ankle, foot, KNEES, angles)
    put(quats, 0, multiply(to_root, row4(quats, 0)))
    pelvis[0], pelvis[1], pelvis[2] = turned(to_root, (pelvis[0], pelvis[1], pelvis[2]))
