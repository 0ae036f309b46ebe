"""Script for reaching postures: ``python -m bake.people.reach`` writes ``datasets/bodies/reach/table.npz``.

Per point of the grid a posture is found by Levenberg-Marquardt: little effort, joint limits, balance, an arm that is long
enough and stays out of the body, and the likeness of neighbouring points, all for several bodies at once, so that one table
serves them all. The posture and its measures come from the very kernel that answers at run time.
"""

from __future__ import annotations

import logging

import numpy as np

from bake.people.humanoid import write_npz
from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.kernels import reach as k
from h3data.bodies.people.kernels.reach import ReachBody, pose_for
from h3data.bodies.people.reach import TABLE_FILE, TABLE_FORMAT, ReachSolver, Table, reach_body
from h3data.builtin import builtin_root
from h3data.geometry import Array
from h3data.kernels import kernel, kernel_part

log = logging.getLogger(__name__)

SOLVED_FOR = ("male_2", "male_1", "neutral_0", "male_3")
"""Bodies for which the table is solved: with short arms, long arms, medium arms, and long feet."""
LOW, HIGH, COUNTS = (-0.60, 0.02, -0.04), (0.24, 1.46, 0.68), (9, 13, 9)
"""Box of targets: left, up, forward, in heights of the standing shoulder (1.4 m for somebody of 1.76 m)."""
SWEEPS, STEPS = 20, 3
LIKENESS = 0.35
"""Weight of the difference between the postures of neighbouring points."""
UNIT = 1 / 8192
"""Unit in which parameters are stored as int16: 0.2 mm, 0.007 degrees."""
EFFORT = np.array([50.0, 4, 40, 2.0, 0.7, 2.5, 0.45, 0.45, 0.60, 1.2, 1.2])
"""Weights of pelvis shift (per shoulder height squared), pelvis turn, spine and collar."""
UPPER = np.array([9.0, 9, 9, 1.40, 0.60, 0.20, 1.30, 0.65, 0.55, 0.35, 0.38])
LOWER = np.array([-9.0, -9, -9, -0.12, -0.60, -0.20, -0.30, -0.65, -0.55, -0.35, -0.38])
"""Upper and lower limits of pelvis shift (shoulder heights), and of pelvis turn, spine and collar [rad]."""
SHOULDER_EFFORT = np.array([0.10, 0.10, 0.10])
ELBOW_EASE, ELBOW_EFFORT = 0.6, 0.04
"""Elbow flexion that costs no effort [rad], and effort beyond it."""
POLE_EFFORT = 0.15
NATURAL_POLE = (-0.45, -0.6, -0.65)
"""Preferred direction of the right elbow in the chest frame: out, down and back."""
PER_BODY = 14


@kernel_part()
def _beyond(value, limit, weight):
    return weight * max(value - limit, 0.0)


@kernel_part()
def _residuals(bodies, x, u, mean, likeness, effort, lower, upper, shoulder_effort, quats, pelvis, m, r):
    n = len(effort)
    for j in range(n):
        r[j] = np.sqrt(effort[j]) * x[j]
        r[n + j] = 30 * (max(x[j] - upper[j], 0.0) + min(x[j] - lower[j], 0.0))
    at = 2 * n
    for j in range(k.PARAMETER_COUNT):
        r[at + j] = np.sqrt(likeness) * (x[j] - mean[j])
    at += k.PARAMETER_COUNT
    size = np.sqrt(x[k.POLE] ** 2 + x[k.POLE + 1] ** 2 + x[k.POLE + 2] ** 2)
    r[at] = 2 * (size - 1)
    at += 1
    share = 1 / np.sqrt(len(bodies))
    for body in bodies:
        target = (u[0] * body.scale, u[1] * body.scale, u[2] * body.scale)
        pose_for(body, x, target, 1.0, 1.0, quats, pelvis, m)
        for j in range(3):
            r[at + j] = np.sqrt(shoulder_effort[j]) * m[k.SHOULDER + j]
            r[at + 3 + j] = np.sqrt(POLE_EFFORT) * (x[k.POLE + j] - NATURAL_POLE[j])
        r[at + 6] = 150 * m[k.MISS] / (1 + (m[k.MISS] / 0.02) ** 2) ** 0.25
        r[at + 7] = np.sqrt(ELBOW_EFFORT) * (m[k.ELBOW] - ELBOW_EASE) + _beyond(0.42, m[k.ELBOW], 6.0)
        r[at + 8] = _beyond(m[k.KNEE], k.KNEE_MAX - 0.06, 20.0) + 0.25 * m[k.KNEE]
        r[at + 9] = _beyond(m[k.SHANK], k.SHANK_MAX - 0.06, 30.0)
        r[at + 10] = _beyond(m[k.BALANCE], -0.022, 60.0)
        r[at + 11] = _beyond(0.012, m[k.CLEARANCE], 40.0)
        r[at + 12] = _beyond(m[k.STRETCH], 0.0, 150.0)
        r[at + 13] = _beyond(0.70, m[k.SPREAD], 5.0)
        r[at : at + PER_BODY] *= share
        at += PER_BODY


@kernel(error_model="numpy")
def _sweep(bodies, table, low, step, steps, down, likeness, effort, lower, upper, shoulder_effort):
    """Make one pass over all points, each with ``steps`` steps towards less effort and likeness to its neighbours.

    The points are changed in place.
    """
    p = k.PARAMETER_COUNT
    count = 2 * len(effort) + p + 1 + PER_BODY * len(bodies)
    r, trial = np.empty(count), np.empty(count)
    jacobian = np.empty((count, p))
    quats, pelvis, m = np.empty((55, 4)), np.empty(3), np.empty(k.MEASURE_COUNT)
    u, mean = np.empty(3), np.empty(p)
    nx, ny, nz, _ = table.shape
    total = 0.0
    for i in range(nx):
        for jj in range(ny):
            j = ny - 1 - jj if down else jj
            for l in range(nz):
                u[0], u[1], u[2] = low[0] + step[0] * i, low[1] + step[1] * j, low[2] + step[2] * l
                mean[:] = 0
                near = 0
                for a in range(3):
                    for side in (-1, 1):
                        b = (i + side * (a == 0), j + side * (a == 1), l + side * (a == 2))
                        if 0 <= b[0] < nx and 0 <= b[1] < ny and 0 <= b[2] < nz:
                            mean += table[b]
                            near += 1
                mean /= near
                x, damping = table[i, j, l].copy(), 1e-2
                like = likeness * near
                _residuals(bodies, x, u, mean, like, effort, lower, upper, shoulder_effort, quats, pelvis, m, r)
                cost = r @ r
                for _ in range(steps):
                    for q in range(p):
                        kept = x[q]
                        x[q] = kept + 1e-5
                        _residuals(
                            bodies, x, u, mean, like, effort, lower, upper, shoulder_effort, quats, pelvis, m, trial
                        )
                        x[q] = kept
                        jacobian[:, q] = (trial - r) / 1e-5
                    square, slope = jacobian.T @ jacobian, jacobian.T @ r
                    for _ in range(5):
                        guess = x - np.linalg.solve(square + damping * np.eye(p), slope)
                        _residuals(
                            bodies, guess, u, mean, like, effort, lower, upper, shoulder_effort, quats, pelvis, m, trial
                        )
                        better = trial @ trial
                        if better < cost:
                            x, cost, damping = guess, better, damping * 0.3
                            r[:] = trial
                            break
                        damping *= 8
                table[i, j, l] = x
                total += cost
    return total


def solve_table(bodies: tuple[ReachBody, ...]) -> Table:
    """Return the postures of the right hand, from standing everywhere."""
    low, counts = np.array(LOW), np.array(COUNTS)
    step = (np.array(HIGH) - low) / (counts - 1)
    values = np.zeros((*COUNTS, k.PARAMETER_COUNT))
    values[..., k.POLE :] = NATURAL_POLE
    for sweep in range(SWEEPS):
        firm = LIKENESS * (1 + 4 * 0.6**sweep)
        cost = _sweep(bodies, values, low, step, STEPS, sweep % 2 == 0, firm, EFFORT, LOWER, UPPER, SHOULDER_EFFORT)
        log.info("sweep %d: cost %.1f per point", sweep, cost / counts.prod())
    values[..., k.POLE :] /= np.linalg.norm(values[..., k.POLE :], axis=-1, keepdims=True)
    return Table(np.round(values / UNIT).astype(np.int16) * np.float32(UNIT), low, step)


def main() -> None:
    """Solve the table, report the share of the box that each body reaches, and write the file."""
    table = solve_table(tuple(reach_body(load_humanoid(name), "right") for name in SOLVED_FOR))
    points = np.random.default_rng(0).uniform(0, 1, (20000, 3)) * (np.array(COUNTS) - 1) * table.step + table.low
    for name in humanoid_names():
        solver = ReachSolver(load_humanoid(name), "right", table)
        _log_share(name, solver, points)
    path = builtin_root() / TABLE_FILE
    path.parent.mkdir(exist_ok=True)
    write_npz(
        path,
        {
            "format": np.array(TABLE_FORMAT),
            "values": np.round(table.values / UNIT).astype(np.int16),
            "unit": np.array(UNIT),
            "low": table.low,
            "step": table.step,
        },
    )


def _log_share(name: str, solver: ReachSolver, points: Array) -> None:
    place = points[:, [2, 1, 0]] * solver.body.scale * (1, 1, -1)
    status = solver.poses(place).status
    shares = ", ".join(
        f"{label} {np.mean(status == code):.3f}"
        for code, label in ((k.REACHED, "reached"), (k.TOO_FAR, "too far"), (k.INVALID_POSTURE, "invalid"))
    )
    log.info("%s: %s", name, shares)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main()
