"""Compiled search behind `h3data.bodies.robots.ik`: one robot arm, many targets."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.kinematics import SLIDES, TURNS
from h3data.kernels import kernel, kernel_part

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e3
"""Damping at the start, and its limits, in the unit of the squared singular values of the Jacobian, to which it is added."""
PATIENCE, GIVE_UP = 4, 1e-3
"""Rule for giving up: `PATIENCE` steps each reduced the error by less than the share `GIVE_UP`."""
FREE_RANGE = math.pi
"""Greatest distance from 0 at which a joint without limits starts a new attempt."""


@kernel_part()
def _walk(target, oriented, weight, point, origins, kinds, axes, columns, gains, offsets, q, ends, jacobian, error):
    """Write the errors [2] of posture ``q``, their vector [6] and its derivative [6, J]."""
    links = len(kinds)
    frame, next_frame = np.eye(4), np.eye(4)
    spots, lines = np.zeros((links, 3)), np.zeros((links, 3))
    for k in range(links):
        for i in range(3):
            for j in range(4):
                next_frame[i, j] = (
                    frame[i, 0] * origins[k, 0, j] + frame[i, 1] * origins[k, 1, j] + frame[i, 2] * origins[k, 2, j]
                )
            next_frame[i, 3] += frame[i, 3]
        frame, next_frame = next_frame, frame
        x, y, z = axes[k]
        for i in range(3):
            lines[k, i] = frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z
            spots[k, i] = frame[i, 3]
        way = gains[k] * q[columns[k]] + offsets[k]
        if kinds[k] == SLIDES:
            for i in range(3):
                frame[i, 3] += lines[k, i] * way
        elif kinds[k] == TURNS:
            s, c = math.sin(way), math.cos(way)
            d = 1 - c
            # Rodrigues' formula from the right, on each row of the frame
            for i in range(3):
                a, b, e = frame[i, 0], frame[i, 1], frame[i, 2]
                along = d * (a * x + b * y + e * z)
                frame[i, 0] = c * a + s * (b * z - e * y) + along * x
                frame[i, 1] = c * b + s * (e * x - a * z) + along * y
                frame[i, 2] = c * e + s * (a * y - b * x) + along * z
    hand, left = np.empty(3), np.empty((3, 3))
    error[:] = 0
    for i in range(3):
        hand[i] = frame[i, 0] * point[0] + frame[i, 1] * point[1] + frame[i, 2] * point[2] + frame[i, 3]
        error[i] = target[i, 3] - hand[i]
        for j in range(3):
            # the turn that is left, in the axes of the base: target times the transposed frame
            left[i, j] = target[i, 0] * frame[j, 0] + target[i, 1] * frame[j, 1] + target[i, 2] * frame[j, 2]
    ends[0] = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    ends[1] = 0.0
    if oriented:
        turn = _rotation_vector(left)
        ends[1] = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
        for i in range(3):
            error[3 + i] = weight * turn[i]
    jacobian[:] = 0
    for k in range(links):
        # added up, because links that follow by mimic share the column of their leader
        column, gain = columns[k], gains[k]
        if kinds[k] == SLIDES:
            for i in range(3):
                jacobian[i, column] += gain * lines[k, i]
        elif kinds[k] == TURNS:
            rx, ry, rz = hand[0] - spots[k, 0], hand[1] - spots[k, 1], hand[2] - spots[k, 2]
            lx, ly, lz = lines[k]
            jacobian[0, column] += gain * (ly * rz - lz * ry)
            jacobian[1, column] += gain * (lz * rx - lx * rz)
            jacobian[2, column] += gain * (lx * ry - ly * rx)
            if oriented:
                for i in range(3):
                    jacobian[3 + i, column] += weight * gain * lines[k, i]


@kernel_part()
def _rotation_vector(r):
    """Return the axis times angle [3] of a rotation matrix."""
    v = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    sine = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    cosine = (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2
    if sine > 1e-6:
        return v * (math.atan2(sine, cosine) / sine)
    if cosine > 0:
        return v
    best = 0  # half a turn: the axis is the longest column of R + 1
    for i in range(1, 3):
        if r[i, i] > r[best, best]:
            best = i
    axis = r[:, best].copy()
    axis[best] += 1
    return axis * (math.pi / math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2))


@kernel_part()
def _solve(a, b, size):
    """Solve ``a x = b`` for a positive definite matrix; both arguments are overwritten, ``b`` with x."""
    for i in range(size):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            # Cholesky; rounding may leave a pivot below 0, whose root would be NaN
            a[i, j] = math.sqrt(max(total, 1e-300)) if i == j else total / a[j, j]
    for i in range(size):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]


@kernel_part()
def _step(jacobian, error, size, damping, q, free, lower, upper, move):
    """Write the damped step of all joints into ``move``; joints at a limit that push outwards stay."""
    move[:] = 0
    still = np.zeros(len(q), np.bool_)
    a, b = np.empty((6, 6)), np.empty(6)
    for _ in range(len(free)):
        # (J J^T + damping) b = e in the space of errors: at most 6 x 6, however many joints there are
        for i in range(size):
            b[i] = error[i]
            for j in range(i + 1):
                total = damping if i == j else 0.0
                for c in free:
                    if not still[c]:
                        total += jacobian[i, c] * jacobian[j, c]
                a[i, j] = total
        _solve(a, b, size)
        again = False
        for c in free:
            move[c] = 0.0
            if still[c]:
                continue
            for i in range(size):
                move[c] += jacobian[i, c] * b[i]
            if (move[c] < 0 and q[c] <= lower[c]) or (move[c] > 0 and q[c] >= upper[c]):
                still[c], again = True, True
        if not again:
            break
    longest = 0.0
    for c in free:
        longest = max(longest, abs(move[c]))
    # longest move of a joint in one step of the search [rad or m]
    max_step = 0.6
    # all joints by one factor, which keeps the direction of the step
    if longest > max_step:
        move *= max_step / longest


@kernel_part()
def _noise(restart, column):
    """Return a number in [0, 1) that depends on its arguments alone (the finaliser of splitmix64)."""
    value = np.uint64(restart) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(column) * np.uint64(0xD1B54A32D192ED03)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return float(value >> np.uint64(11)) * 2.0**-53


@kernel(error_model="numpy")
def solve_targets(
    targets: NDArray[np.float64],
    oriented: bool,
    point: NDArray[np.float64],
    origins: NDArray[np.float64],
    kinds: NDArray[np.int64],
    axes: NDArray[np.float64],
    columns: NDArray[np.int64],
    gains: NDArray[np.float64],
    offsets: NDArray[np.float64],
    free: NDArray[np.int64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    weight: float,
    tolerance_m: float,
    tolerance_rad: float,
    iterations: int,
    restarts: int,
    q: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> None:
    """Improve joint positions ``q`` [N, J] so that ``point`` [3] of the last link of a chain meets ``targets`` [N, 4, 4].

    The arrays of the chain are described in `h3data.bodies.robots.kinematics.link_frames`. Only the joints ``free``
    move. ``errors`` [N, 2] receives the remaining distance [m] and angle [rad].
    """
    joints = q.shape[1]
    size = 6 if oriented else 3
    here, there, move, best = np.empty(joints), np.empty(joints), np.empty(joints), np.empty(joints)
    jacobian, next_jacobian = np.empty((6, joints)), np.empty((6, joints))
    error, next_error = np.empty(6), np.empty(6)
    ends, next_ends = np.empty(2), np.empty(2)
    for n in range(len(q)):
        best_cost = np.inf
        for attempt in range(restarts + 1):
            here[:] = q[n]
            # the first attempt begins where the caller is; later ones begin anywhere within the limits
            if attempt:
                for c in free:
                    low, high = max(lower[c], -FREE_RANGE), min(upper[c], FREE_RANGE)
                    here[c] = low + (high - low) * _noise(attempt, c) if high > low else lower[c]
            args = (origins, kinds, axes, columns, gains, offsets)
            _walk(targets[n], oriented, weight, point, *args, here, ends, jacobian, error)
            cost, damping, slow = error @ error, FIRST_DAMPING, 0
            for _ in range(iterations):
                if (ends[0] <= tolerance_m and ends[1] <= tolerance_rad) or damping > MOST_DAMPING or slow > PATIENCE:
                    break
                _step(jacobian, error, size, damping, here, free, lower, upper, move)
                there[:] = here
                for c in free:
                    there[c] = min(max(here[c] + move[c], lower[c]), upper[c])
                _walk(targets[n], oriented, weight, point, *args, there, next_ends, next_jacobian, next_error)
                next_cost = next_error @ next_error
                # Levenberg and Marquardt: a step that helps is taken and damps less, any other is taken back
                if next_cost < cost:
                    slow = slow + 1 if next_cost > (1 - GIVE_UP) * cost else 0
                    cost, damping = next_cost, max(damping * 0.2, LEAST_DAMPING)
                    here[:] = there
                    ends[:] = next_ends
                    error[:] = next_error
                    jacobian[:] = next_jacobian
                else:
                    damping *= 6
            if cost < best_cost:
                best_cost = cost
                best[:] = here
                errors[n] = ends
            if ends[0] <= tolerance_m and ends[1] <= tolerance_rad:
                break
        q[n] = best
