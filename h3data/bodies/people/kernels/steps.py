"""Compiled kernels for feet on stairs: the position of a foot on a tread, and the path of a foot over noses of steps.

Positions along a flight are in metres upwards from the lower end of its ramp; tread n is at about n times the going
(the depth of a step), and tread 0 is the landing. Heel and toe tip of a foot are ``heel`` (negative) and ``toe`` [m]
ahead of its ankle.
"""

from __future__ import annotations

import math

from h3data.kernels import kernel_part
from h3data.scene.floor_heights import AXIS, END, START, STEPS, nose_at, step_at, tread_at

BESIDE_M = 0.2
"""Distance before the first riser from which people climb [m]."""
UP_SHARE, DOWN_SHARE = 0.2, 0.25
"""Shares of a swing within which the foot rises over the noses, and within which it descends."""
EDGE_M = 0.015
"""Distance beyond heel and toe tip within which a swinging foot keeps clear of steps [m], as its pitch and bend move
both by some millimetres."""
RISER_M, OVERHANG_M, CLEAR_M = 0.025, 0.03, 0.02
"""Smallest distance of a foot from the riser ahead of or behind it; largest distance by which heel or toe stand out
over the edge of a tread, as many feet are nearly as long as a tread; height at which both pass over the noses [m]."""
USUAL, DOWN_NEARER = 0.62, 0.3
"""Shares of a tread. Each foot moves on by two treads, also if the middle of the foot would be nearer to another tread
by at most the first share. Downstairs, feet land nearer to the body by the second share, because a foot far ahead and
below is out of reach."""


@kernel_part()
def tread_length(heights):
    """Return the going (depth of a step) of the first flight of stairs [m]."""
    for k in range(len(heights)):
        if heights[k, STEPS] > 0.0:
            return abs(heights[k, END] - heights[k, START]) / heights[k, STEPS]
    return 1.0


@kernel_part()
def beside_steps(heights, x, z):
    """Return whether a position (x, z) is on a flight of stairs or directly before it."""
    k, _, place = step_at(heights, x, z)
    if k < 0:
        return False
    # places along a flight are counted in treads
    near = BESIDE_M * heights[k, STEPS] / abs(heights[k, END] - heights[k, START])
    return -near < place - 0.5 and place + 0.5 < heights[k, STEPS] + near


@kernel_part()
def _upwards(heights, k, heading):
    """Return the cosine of the angle between a heading and the direction in which a flight rises."""
    # flights are stored by their lower and upper end along an axis, whichever way that points
    sign = 1.0 if heights[k, END] > heights[k, START] else -1.0
    return sign * (math.cos(heading) if heights[k, AXIS] == 0.0 else -math.sin(heading))


@kernel_part()
def _middle(x, z, heading, heel, toe):
    # the sole stands, not the ankle, which is nearer to the heel
    half = (heel + toe) / 2
    return x + math.cos(heading) * half, z - math.sin(heading) * half


@kernel_part()
def tread_of(heights, x, z, heading, heel, toe):
    """Return the number of the tread on which a foot with its ankle at (x, z) stands."""
    middle_x, middle_z = _middle(x, z, heading, heel, toe)
    return step_at(heights, middle_x, middle_z)[1]


@kernel_part()
def under_foot(heights, x, z, heading, heel, toe):
    """Return the height [m] of the tread or floor on which a foot with its ankle at (x, z) stands."""
    middle_x, middle_z = _middle(x, z, heading, heel, toe)
    return tread_at(heights, 0.0, middle_x, middle_z)


@kernel_part()
def on_a_tread(heights, x, z, heading, heel, toe, came_from):
    """Move a position (x, z) of an ankle along the flight so that the foot is on one tread.

    Away from stairs it is unchanged.

    ``came_from`` is the tread on which the foot stood before, -1 if it does not matter.
    """
    middle_x, middle_z = _middle(x, z, heading, heel, toe)
    k, tread, place = step_at(heights, middle_x, middle_z)
    if k < 0:
        return x, z
    last = int(heights[k, STEPS])
    going = abs(heights[k, END] - heights[k, START]) / last
    if came_from >= 0:
        down = place < came_from
        # going down, the next tread is already below: a foot that reached for the middle would overshoot it
        near = place + DOWN_NEARER if down else place
        tread = int(min(max(math.floor(near + 0.5), 0.0), last))
        usual = came_from - 2 if down else came_from + 2
        # keeps the rhythm of one tread a step where the length of the stride is between two
        if 0 <= usual <= last and abs(near - usual) < USUAL:
            tread = usual
    cosine = _upwards(heights, k, heading)
    # a foot that is turned aside takes less of the tread
    high = abs(cosine) * (toe - heel) / 2
    low = -high
    at = place * going
    to = at
    if tread > 0:
        # not over the edge behind it,
        to = max(to, (tread - 0.5) * going - OVERHANG_M - low)
    if tread < last:
        # and not into the riser before it
        to = min(to, (tread + 0.5) * going - RISER_M - high)
    move = (to - at) * (1.0 if heights[k, END] > heights[k, START] else -1.0)
    return (x + move, z) if heights[k, AXIS] == 0.0 else (x, z + move)


@kernel_part()
def over_steps(heights, x, z, heading, heel, toe, low, high, share):
    """Return the height [m] of the floor below a swinging foot at (x, z) that has passed ``share`` of its path over steps.

    The path leads from a floor at ``low`` to one at ``high``. The height is never below the floor under heel and toe,
    and at least that of the noses of the steps between the floors.
    """
    # eased, so that the foot leaves and arrives without a speed upwards
    line = low + (high - low) * share * share * (3 - 2 * share)
    c, s = math.cos(heading), math.sin(heading)
    under, nose = line, line
    for at in (heel, toe):
        edge = at + math.copysign(EDGE_M, at)
        under = max(under, tread_at(heights, 0.0, x + c * edge, z - s * edge))
        nose = max(nose, nose_at(heights, 0.0, x + c * at, z - s * at) + CLEAR_M)
    # full height only in the middle: at the ends the foot is on a tread, below the line of the noses
    up, down = min(share / UP_SHARE, 1.0), min((1.0 - share) / DOWN_SHARE, 1.0)
    over = up * up * (3 - 2 * up) * down * down * (3 - 2 * down)
    # the floor under heel and toe has the last word, whatever the curve says
    return max(line + over * (nose - line), under)
