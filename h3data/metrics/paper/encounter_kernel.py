"""Kernel for `encounter_series` of many rows, ten times as fast as NumPy with bit-identical results."""

# Eight rows at a time as LLVM vectors: their poses are transposed in registers, and what the next rows need of the last one
# stays there. Loops over blocks of rows that LLVM vectorises itself take one and a half times as long, since they have to put
# each number of a pose beside its neighbours one by one. Four square roots and four divisions are three quarters of the time.

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from h3data.kernels import kernel
from h3data.kernels.vectors import DOUBLE8, FLOAT, INT64, LANES, Vec, fetch, intrinsic, load, pick, spread, store


@intrinsic
def fill_eights(typing_context, robot_pose, human_pose, reach_m, time_ns, limits, quantities, flags, first, count):
    """Fill ``8 * count`` rows of the encounter series from row ``first`` on, eight rows at a time."""

    def codegen(context, b, signature, arguments):
        *arrays, first, count = (
            value if kind == types.intp else context.make_array(kind)(context, b, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        robot_at, human_at, reach_at, time_at, limits_at, quantities_at, flags_at = (
            b.ptrtoint(array.data, INT64) for array in arrays
        )
        near_m, far_m, least_facing, avoid_m, yield_m_s, still_m_s = (
            spread(b, limits_at, k, DOUBLE8) for k in range(6)
        )
        rows = b.extract_value(arrays[-1].shape, 1)  # the series lie one after another
        # of the eight rows before: x and z of the robot, its forward direction (x, z), and the time
        kinds = [DOUBLE8] * 4 + [ir.VectorType(INT64, LANES)]
        last = [cgutils.alloca_once_value(b, ir.Constant(kind, None)) for kind in kinds]

        def at(address, size):
            row = b.add(first, b.mul(loop.index, ir.Constant(INT64, LANES)))
            return b.add(address, b.mul(row, ir.Constant(INT64, size)))

        with cgutils.for_range(b, count, intp=INT64) as loop:
            # 64 rows ahead: the processor fetches rows by itself only up to the end of a page
            for address, size in ((robot_at, 28), (human_at, 28), (time_at, 8)):
                for line in range(0, size * LANES, 64):
                    fetch(b, b.add(at(address, size), ir.Constant(INT64, 64 * size + line)))
            x, y, z, qx = _columns(b, at(robot_at, 28), 0)
            _, qy, qz, qw = _columns(b, at(robot_at, 28), 3)
            human_x, human_y, human_z, _ = _columns(b, at(human_at, 28), 0)
            dx, dy, dz = human_x - x, human_y - y, human_z - z
            across, up = -((qy * qy + qz * qz) * 2.0) + 1.0, (qx * qz - qy * qw) * 2.0
            length = (across * across + up * up).unary("sqrt")
            length = length.where(~length.compare("==", 0.0), np.inf)
            forward_x, forward_z = across.divided_by(length), up.divided_by(length)
            dist = (dx * dx + dy * dy + dz * dz).unary("sqrt")
            floor_dist = (dx * dx + dz * dz).unary("sqrt")
            along = forward_x * dx + forward_z * dz
            facing_dot = along.divided_by(floor_dist.where(floor_dist.compare(">", 0.0), 1.0))
            kind = arrays[2].data.type.pointee
            reach = load(b, at(reach_at, 4 if kind == FLOAT else 8), 0, ir.VectorType(kind, LANES))
            reach = Vec(b, b.fpext(reach, DOUBLE8) if kind == FLOAT else reach)
            reach = reach.where(dist.compare(">=", 0.0), np.nan)
            now = [x.value, z.value, forward_x.value, forward_z.value, load(b, at(time_at, 8), 0, kinds[-1])]
            *before, then = (pick(b, b.load(slot), new, range(7, 15)) for slot, new in zip(last, now, strict=True))
            last_x, last_z, last_forward_x, last_forward_z = (Vec(b, value) for value in before)
            dt = Vec(b, b.sitofp(b.sub(now[-1], then), DOUBLE8)) * 1e-9
            for slot, new in zip(last, now, strict=True):
                b.store(new, slot)
            step_x, step_z = x - last_x, z - last_z
            step = (step_x * step_x + step_z * step_z).unary("sqrt")
            in_reach = reach.compare(">=", near_m) & reach.compare("<=", far_m)
            facing = along.compare(">", least_facing * floor_dist)
            near = dist.compare("<", avoid_m)
            backs_up = near & (step_x * last_forward_x + step_z * last_forward_z).compare("<", -still_m_s * dt)
            yields = near & ~backs_up & step.compare("<", yield_m_s * dt)
            for k, values in enumerate((dist, reach, facing_dot, step.divided_by(dt))):
                store(b, values.value, b.add(at(quantities_at, 8), b.mul(rows, ir.Constant(INT64, 8 * k))))
            for k, mask in enumerate((in_reach, facing, in_reach & facing, near, backs_up, yields)):
                of_rows = b.zext(mask.value, ir.VectorType(ir.IntType(8), LANES))
                store(b, of_rows, b.add(at(flags_at, 1), b.mul(rows, ir.Constant(INT64, k))))
        return context.get_dummy_value()

    arrays = (robot_pose, human_pose, reach_m, time_ns, limits, quantities, flags)
    return types.void(*arrays, types.intp, types.intp), codegen


@kernel(error_model="numpy", boundscheck=False)
def fill_series(robot_pose, human_pose, reach_m, time_ns, starts, limits, quantities, flags):
    """Compute the series of `h3data.metrics.paper.encounter` for many episodes in one pass.

    The operations and their order are those of `encounter_series`, so that the results are bit-identical.

    Args:
        robot_pose: poses of the robots, float32 [T, 7], with the rows of all episodes in sequence, at least eight.
        human_pose: poses of the people, float32 [T, 7], for the same rows.
        reach_m: distance between the two agents that counts for following, measured along free paths [T] [m].
        time_ns: times of the rows [T] [ns].
        starts: first row of each episode.
        limits: values of `Thresholds` in the order of its fields.
        quantities: filled with dist_m, reach_m, facing_dot and speed_m_s, [4, T].
        flags: filled with in_reach, facing, found, near, backs_up and yields, [6, T].
    """
    last, values = len(robot_pose) - LANES, np.array(limits)
    fill_eights(robot_pose, human_pose, reach_m, time_ns, values, quantities, flags, 0, len(robot_pose) // LANES)
    # the last eight rows may begin among those before, where the first of them has its velocity already
    speed, backs_up, yields = quantities[3, last], flags[4, last], flags[5, last]
    fill_eights(robot_pose, human_pose, reach_m, time_ns, values, quantities, flags, last, 1)
    quantities[3, last], flags[4, last], flags[5, last] = speed, backs_up, yields
    # the step from the last row of the episode before is no velocity
    for start in starts:
        quantities[3, start], flags[4, start], flags[5, start] = np.nan, False, False


def _columns(b, address, first):
    """Return four columns, from ``first`` on, of eight rows of seven float32 at ``address``, as float64."""
    kind = ir.VectorType(FLOAT, 4)
    halves = [load(b, address, 28 * row + 4 * first, kind) for row in range(LANES)]
    rows = [pick(b, halves[k], halves[k + 4], range(LANES)) for k in range(4)]
    # all shuffles stay within the halves of a register, which is what AVX does in one instruction
    pairs = [
        pick(b, rows[k], rows[k + 1], order)
        for order in ([0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15])
        for k in (0, 2)
    ]
    return [
        Vec(b, b.fpext(pick(b, pairs[k], pairs[k + 1], order), DOUBLE8))
        for k in (0, 2)
        for order in ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
    ]
