"""`encounter_series` by a kernel, for many rows: a sixth of NumPy's time, and equal to the last bit."""

# A block of rows at a time: its poses are put beside each other, and each loop over the block does one kind of arithmetic
# without branches, so that LLVM computes several rows at once. One loop for all of it takes two and a half times as long.

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel

_BLOCK = 256
"""Rows that are computed together; what is kept of them fits into the first cache."""


@kernel(error_model="numpy", boundscheck=False)
def fill_series(robot_pose, human_pose, reach_m, time_ns, starts, limits, quantities, flags):
    """Computes the series of `h3data.metrics.paper.encounter` for many episodes in one pass.

    The operations and their order are those of `encounter_series`, so that the results are equal to the last bit.

    Args:
        robot_pose: poses of the robots, float32 [T, 7], the rows of all episodes after each other.
        human_pose: poses of the people, likewise.
        reach_m: distance between the two agents that counts for following, measured along free paths [T] [m].
        time_ns: times of the rows [T].
        starts: first row of each episode.
        limits: values of `Thresholds` in the order of its fields.
        quantities: filled with dist_m, reach_m, facing_dot and speed_m_s, [4, T].
        flags: filled with in_reach, facing, found, near, backs_up and yields, [6, T].
    """
    near_m, far_m, least_facing, avoid_m, yield_m_s, still_m_s = limits
    rows = len(robot_pose)
    # Row k of a block is at k + 1 in these four, whose first value is that of the row before; the first row has no velocity.
    xs, zs, forward_xs, forward_zs = np.full((4, _BLOCK + 1), np.nan)
    qxs, qys, qzs, qws, dxs, dys, dzs, reaches, dts = np.empty((9, _BLOCK))
    alongs, floor_dists, moves, steps = np.empty((4, _BLOCK))
    for first in range(0, rows, _BLOCK):
        count = min(_BLOCK, rows - first)
        end = first + count
        for k in range(count):
            t = first + k
            x, y, z = np.float64(robot_pose[t, 0]), np.float64(robot_pose[t, 1]), np.float64(robot_pose[t, 2])
            xs[k + 1], zs[k + 1] = x, z
            qxs[k], qys[k] = np.float64(robot_pose[t, 3]), np.float64(robot_pose[t, 4])
            qzs[k], qws[k] = np.float64(robot_pose[t, 5]), np.float64(robot_pose[t, 6])
            dxs[k], dys[k] = np.float64(human_pose[t, 0]) - x, np.float64(human_pose[t, 1]) - y
            dzs[k] = np.float64(human_pose[t, 2]) - z
            reaches[k] = np.float64(reach_m[t])
            dts[k] = np.float64(time_ns[t] - time_ns[max(t - 1, 0)]) * 1e-9
        for k in range(count):
            qx, qy, qz, qw = qxs[k], qys[k], qzs[k], qws[k]
            x, z = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qz - qy * qw)
            length = np.sqrt(x * x + z * z)
            if length == 0:
                length = np.inf
            forward_xs[k + 1], forward_zs[k + 1] = x / length, z / length
        dist_m, reach_or_nan = quantities[0, first:end], quantities[1, first:end]
        for k in range(count):
            dx, dy, dz = dxs[k], dys[k], dzs[k]
            dist = np.sqrt(dx * dx + dy * dy + dz * dz)
            dist_m[k], reach_or_nan[k] = dist, np.nan if np.isnan(dist) else reaches[k]
        facing_dot = quantities[2, first:end]
        for k in range(count):
            dx, dz = dxs[k], dzs[k]
            floor_dist = np.sqrt(dx * dx + dz * dz)
            along = forward_xs[k + 1] * dx + forward_zs[k + 1] * dz
            alongs[k], floor_dists[k] = along, floor_dist
            facing_dot[k] = along / (floor_dist if floor_dist > 0 else 1.0)
        speed_m_s = quantities[3, first:end]
        for k in range(count):
            step_x, step_z = xs[k + 1] - xs[k], zs[k + 1] - zs[k]
            step = np.sqrt(step_x * step_x + step_z * step_z)
            moves[k], steps[k] = step_x * forward_xs[k] + step_z * forward_zs[k], step
            speed_m_s[k] = step / dts[k]
        in_reach, facing, found = flags[0, first:end], flags[1, first:end], flags[2, first:end]
        for k in range(count):
            reaches_it = (reach_or_nan[k] >= near_m) & (reach_or_nan[k] <= far_m)
            faces_it = alongs[k] > least_facing * floor_dists[k]
            in_reach[k], facing[k], found[k] = reaches_it, faces_it, reaches_it & faces_it
        near, backs_up, yields = flags[3, first:end], flags[4, first:end], flags[5, first:end]
        for k in range(count):
            is_near = dist_m[k] < avoid_m
            retreats = is_near & (moves[k] < -still_m_s * dts[k])
            near[k], backs_up[k] = is_near, retreats
            yields[k] = is_near & (not retreats) & (steps[k] < yield_m_s * dts[k])
        xs[0], zs[0], forward_xs[0], forward_zs[0] = xs[count], zs[count], forward_xs[count], forward_zs[count]
    # the step from the last row of the episode before is no velocity
    for start in starts:
        quantities[3, start], flags[4, start], flags[5, start] = np.nan, False, False
