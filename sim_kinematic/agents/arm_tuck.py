"""Room for the arms beside a person, and the degree to which the person folds each arm towards the body.

A line runs along each side of the person, forward and back. An obstacle near the line causes the arm to fold: fully if
it is beside the person, and less the farther ahead or behind it is. An arm therefore starts to fold before the person
reaches a door post, and swings out again after it.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from h3data.bodies import Humanoid
from h3data.bodies.people.arms import CLOSE_COLLARS, CLOSE_SHOULDERS, COLLARS, SHOULDERS
from h3data.bodies.people.kernels.clips import tuck_all
from h3data.bodies.people.reach import Hand
from h3data.geometry import IDENTITY_POSE, Array
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.motion.spec import STEP_S, ArmRoomSpec, WalkerSpec
from sim_kinematic.motion.state import HumanState

ROUNDING = 1e-9
"""Tolerance in the comparisons of `_draw_in_worlds`, far above what rounding can cause."""
BLOCK = 256
"""Number of lines beside people that are followed together, so that their data fit into the first cache."""
LOOKS = 3
"""Number of steps along a line after which finished lines are removed, which saves a tenth of the time. A line is
finished when no further step can change the fold of its arm, so the results are the same."""
HANDS: tuple[Hand, ...] = ("left", "right")
"""Hands in the order of `HumanState.arms`."""
CARRY_FREE_M, CARRY_TIGHT_M = 0.14, 0.06
"""Room around the palm above which a hand that carries something is held out, and below which the hand is close to the
body [m]. Hand and object reach 8 to 10 cm beyond the palm."""
FAN, ONWARD = np.linspace(-1.0, 1.0, 9) * 1.2, np.array([0.25, 0.5, 0.75])
"""Turns of the body [rad], and distances straight ahead [m], at which the room for a held object is measured in
advance."""


@kernel(error_model="numpy")
def _draw_in_worlds(sdf, origin, cell, xz, heading, arms, busy, rate, aside, free, tight, within, fade, step):
    """Move all arms [W, 2] by one step in place, each by at most ``rate`` towards the value for its line, 0..1.

    Distances differ by no more than the path between two points, so where there is room a line is followed by as much. What
    it asks for is the most of its looks. A line is left as soon as no further look can change the arm.

    On a line each look has to wait for the one before, so all lines of a block advance by one look in turn, in loops over
    arrays that compile to vector instructions but for the look-up itself (`sample_sdf`, bit for bit). Line after line takes
    three times as long. Skipping looks by a remembered clearance would spare little: in furnished homes four lines in five
    come near something.
    """
    worlds, end = len(heading), within + fade
    flat, columns = sdf.reshape(-1), sdf.shape[1]
    most_x, most_z, last_x, last_z = sdf.shape[0] - 1.0, sdf.shape[1] - 1.0, sdf.shape[0] - 2.0, sdf.shape[1] - 2.0
    numbers = np.empty((14, min(2 * worlds, BLOCK)))
    # one by one: rows of a slice would not be known to be contiguous
    x, z, c, s, along, most, enough = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6]
    a, b, off_x, off_z, cells, room, asks = (
        numbers[7],
        numbers[8],
        numbers[9],
        numbers[10],
        numbers[11],
        numbers[12],
        numbers[13],
    )
    low_x, low_z = origin[0], origin[1]
    lines, goes_on = np.empty(numbers.shape[1], np.intp), np.empty(numbers.shape[1], np.uint8)
    for begin in range(0, worlds, BLOCK // 2):
        stop, count = min(begin + BLOCK // 2, worlds), 0
        for w in range(begin, stop):
            cosine, sine = math.cos(heading[w]), math.sin(heading[w])
            for k in range(2):
                line, side = 2 * (w - begin) + k, 2.0 * k - 1.0
                asks[line], along[count], most[count], lines[count] = 0.0, -end, 0.0, line
                # the right of a heading h is (sin h, cos h) in (x, z); side is -1 for the left arm
                x[count], z[count] = xz[w, 0] + sine * side * aside, xz[w, 1] + cosine * side * aside
                c[count], s[count], enough[count] = cosine, sine, min(arms[w, k] + rate + ROUNDING, 1.0)
                # the next line overwrites that of a busy arm, which asks for nothing and so comes out
                count += k != busy
        while count > 0:
            for _ in range(LOOKS):
                for n in range(count):  # cells, and places in them
                    # samples of the field are at the middles of its cells
                    fx = (x[n] + c[n] * along[n] - low_x) / cell - 0.5
                    fz = (z[n] - s[n] * along[n] - low_z) / cell - 0.5
                    cx, cz = fx if fx > 0.0 else 0.0, fz if fz > 0.0 else 0.0
                    cx, cz = cx if cx < most_x else most_x, cz if cz < most_z else most_z
                    i, j = np.floor(cx), np.floor(cz)
                    i, j = i if i < last_x else last_x, j if j < last_z else last_z
                    a[n], b[n], off_x[n], off_z[n], cells[n] = cx - i, cz - j, fx - cx, fz - cz, i * columns + j
                for n in range(count):  # distances
                    k = np.uint64(np.int64(cells[n]))  # unsigned: a negative index would have to be looked for
                    below = k + np.uint64(columns)
                    near = (1.0 - a[n]) * ((1.0 - b[n]) * flat[k] + b[n] * flat[k + np.uint64(1)])
                    far = a[n] * ((1.0 - b[n]) * flat[below] + b[n] * flat[below + np.uint64(1)])
                    room[n] = near + far
                    if off_x[n] != 0.0 or off_z[n] != 0.0:
                        # off the grid: the value at its border less the distance to it, as `sample_sdf`
                        room[n] -= cell * np.hypot(off_x[n], off_z[n])
                for n in range(count):  # what they ask for, and where the next look is
                    share, beyond, stride = (free - room[n]) / (free - tight), abs(along[n]) - within, room[n] - free
                    need = (share if share < 1.0 else 1.0) - (beyond if beyond > 0.0 else 0.0) / fade
                    need = need if need > most[n] else most[n]
                    at = along[n] + (stride if stride > step else step)
                    along[n], most[n] = at, need
                    # the last term: farther on even a thing right on the line would ask for less than `need`
                    goes_on[n] = (at <= end) & (need < enough[n]) & (at - within < (1.0 - need) * fade + ROUNDING)
            left = 0
            for n in range(count):
                asks[lines[n]] = most[n]
                x[left], z[left], c[left], s[left] = x[n], z[n], c[n], s[n]
                along[left], most[left], enough[left], lines[left] = along[n], most[n], enough[n], lines[n]
                left += goes_on[n]
            count = left
        for w in range(begin, stop):
            for k in range(2):
                arms[w, k] += min(max(asks[2 * (w - begin) + k] - arms[w, k], -rate), rate)


@kernel(error_model="numpy")
def draw_in_planted(sdf, origin, cell, xz, heading, arms, busy, room, quats):
    """Move the arms of people with planted feet by one step, and fold them in the poses [W, 55, 4].

    The rules are those of `draw_arms`.
    """
    _draw_in_worlds(sdf, origin, cell, xz, heading, arms, busy, *room)
    tuck_all(quats, arms, SHOULDERS, CLOSE_SHOULDERS)
    tuck_all(quats, arms, COLLARS, CLOSE_COLLARS)


@lru_cache(maxsize=64)
def arm_room(body: Humanoid, rules: ArmRoomSpec) -> tuple[float, ...]:
    """Return the constants for a body by which `_draw_in_worlds` folds its arms."""
    # room is measured from the line, which is `aside_m` off the middle of the body
    width = width_m(body) - rules.aside_m
    return (
        rules.rate,
        rules.aside_m,
        width + rules.free_m,
        width + rules.tight_m,
        rules.within_m,
        rules.fade_m,
        rules.step_m,
    )


def draw_arms(
    state: HumanState, free: FreeSpace, body: Humanoid, rules: ArmRoomSpec | None, *, busy: Hand | None = None
) -> None:
    """Move the arms of people in all worlds towards or away from the body by one step, in place.

    How far each arm is folded in follows from the room beside the body; without rules the arms stay as they are. An arm
    whose hand is ``busy`` is released.
    """
    if rules is None:
        return
    moved, room = (state.xz, state.heading, state.arms), arm_room(body, rules)
    _draw_in_worlds(free.sdf, free.origin, free.cell_m, *moved, HANDS.index(busy) if busy else -1, *room)


@kernel(error_model="numpy")
def _held_close(sdf, origin, cell, x, z, heading, ahead, aside, per_rad, per_m, free, tight, fan, onward):
    """Return how close to the body a hand has to be now, 0..1, so that it is close enough where the body may be soon.

    The hand is ``ahead`` of the body and ``aside`` to its right when held out. A turn of 1 rad takes as long as coming in by
    ``per_rad``, a metre ahead as long as ``per_m``.
    """
    most = 0.0
    for turn in fan:
        c, s = math.cos(heading + turn), math.sin(heading + turn)
        room = sample_sdf(sdf, origin, cell, x + c * ahead + s * aside, z - s * ahead + c * aside)
        most = max(most, min((free - room) / (free - tight), 1.0) - per_rad * abs(turn))
    c, s = math.cos(heading), math.sin(heading)
    for further in onward:
        far = ahead + further
        room = sample_sdf(sdf, origin, cell, x + c * far + s * aside, z - s * far + c * aside)
        most = max(most, min((free - room) / (free - tight), 1.0) - per_m * further)
    return most


def held_close(
    free: FreeSpace, xz: Array, heading: float, hand: tuple[float, float], spec: WalkerSpec, rules: ArmRoomSpec
) -> float:
    """Return how close to the body a person holds their load at a place [2] and heading, from 0 (held out) to 1.

    ``hand`` is the position of the hand when it is held out: ahead of the body and to its right [m]. The person looks
    ahead as far as they turn and walk, at the limits of ``spec``, while the arm comes in at ``rules.rate`` per step.
    """
    rates = rules.rate / (spec.turn_rad_s * STEP_S), rules.rate / (spec.speed_mps * STEP_S)
    where = free.sdf, free.origin, free.cell_m, *xz.tolist(), float(heading), *hand
    return free.entries(_held_close, *where, *rates, CARRY_FREE_M, CARRY_TIGHT_M, FAN, ONWARD)


@lru_cache(maxsize=64)
def width_m(body: Humanoid) -> float:
    """Return half the width [m] of a person who stands with both arms folded, measured by the capsules of the body."""
    joints = body.joint_matrices(IDENTITY_POSE[None], *body.clip_pose([0], [0.0], arms=np.ones((1, 2))))
    start, end, radius = body.capsules_world(joints)
    # z of the agent root frame is the person's side
    return float((np.abs(np.stack([start, end])[:, 0, :, 2]).max(0) + radius).max())
