"""`encounter_series` by a kernel, for many rows: a tenth of NumPy's time, and equal to the last bit."""

# Eight rows at a time as LLVM vectors: their poses are transposed in registers, and what the next rows need of the last one
# stays there. Loops over blocks of rows that LLVM vectorises itself take one and a half times as long, since they have to put
# each number of a pose beside its neighbours one by one. Four square roots and four divisions are three quarters of the time.

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from h3data.kernels import kernel
from h3data.kernels.vectors import DOUBLE8, FLOAT, FLOAT8, INT, INT64, LANES, Vec, intrinsic, load, pick, splat, store


@intrinsic
def fill_eights(typing_context, robot_pose, human_pose, reach_m, time_ns, before, limits, quantities, flags, count):
    """Fills the series of the first ``count`` times eight rows, and ``before`` with what the rows after them need of these.

    ``before`` holds x and z of the robot, its forward direction (x, z), and the time as an int64.
    """

    def codegen(context, builder, signature, arguments):
        b = builder
        *arrays, packs = (
            value if kind == types.intp else context.make_array(kind)(context, b, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        addresses = [b.ptrtoint(array.data, INT64) for array in arrays]
        robot_at, human_at, reach_at, time_at, before_at, limits_at, quantities_at, flags_at = addresses
        double = DOUBLE8.element
        limits = [Vec(b, splat(b, load(b, limits_at, 8 * k, double), DOUBLE8)) for k in range(6)]
        near_m, far_m, least_facing, avoid_m, yield_m_s, still_m_s = limits
        rows = b.extract_value(arrays[-1].shape, 1)  # the series lie one after another
        kinds = [DOUBLE8] * 4 + [ir.VectorType(INT64, LANES)]
        last = [
            cgutils.alloca_once_value(b, splat(b, load(b, before_at, 8 * k, kind.element), kind))
            for k, kind in enumerate(kinds)
        ]

        def shifted(values):
            """Values of the rows before, of which the first is the last one of the eight rows before."""
            pairs = [(b.load(slot), value) for slot, value in zip(last, values, strict=True)]
            for slot, value in zip(last, values, strict=True):
                b.store(value, slot)
            return [pick(b, old, new, range(7, 15)) for old, new in pairs]

        def at(address, size):
            return b.add(address, b.mul(loop.index, ir.Constant(INT64, LANES * size)))

        with cgutils.for_range(b, packs, intp=INT64) as loop:
            x, y, z, qx = _columns(b, at(robot_at, 28), 0)
            _, qy, qz, qw = _columns(b, at(robot_at, 28), 3)
            human_x, human_y, human_z, _ = _columns(b, at(human_at, 28), 0)
            dx, dy, dz = human_x - x, human_y - y, human_z - z
            across, up = -((qy * qy + qz * qz) * 2.0) + 1.0, (qx * qz - qy * qw) * 2.0
            length = (across * across + up * up).unary("sqrt")
            length = Vec(b, b.select(length.compare("==", 0.0).value, length._lift(np.inf), length.value))
            forward_x, forward_z = across.divided_by(length), up.divided_by(length)
            dist = (dx * dx + dy * dy + dz * dz).unary("sqrt")
            floor_dist = (dx * dx + dz * dz).unary("sqrt")
            along = forward_x * dx + forward_z * dz
            apart = floor_dist.compare(">", 0.0).value
            facing_dot = along.divided_by(Vec(b, b.select(apart, floor_dist.value, floor_dist._lift(1.0))))
            single = arrays[2].data.type.pointee == FLOAT
            reach = load(b, at(reach_at, 4 if single else 8), 0, FLOAT8 if single else DOUBLE8)
            reach = Vec(b, b.fpext(reach, DOUBLE8) if single else reach)
            known = b.fcmp_ordered("ord", dist.value, dist.value)
            reach = Vec(b, b.select(known, reach.value, reach._lift(np.nan)))
            now = load(b, at(time_at, 8), 0, kinds[-1])
            *of_row_before, then = shifted([x.value, z.value, forward_x.value, forward_z.value, now])
            last_x, last_z, last_forward_x, last_forward_z = (Vec(b, value) for value in of_row_before)
            dt = Vec(b, b.sitofp(b.sub(now, then), DOUBLE8)) * 1e-9
            step_x, step_z = x - last_x, z - last_z
            step = (step_x * step_x + step_z * step_z).unary("sqrt")
            speed = step.divided_by(dt)
            in_reach = reach.compare(">=", near_m) & reach.compare("<=", far_m)
            facing = along.compare(">", least_facing * floor_dist)
            near = dist.compare("<", avoid_m)
            ahead = step_x * last_forward_x + step_z * last_forward_z
            backs_up = near & ahead.compare("<", -still_m_s * dt)
            yields = near & ~backs_up & step.compare("<", yield_m_s * dt)
            for k, values in enumerate((dist, reach, facing_dot, speed)):
                store(b, values.value, b.add(at(quantities_at, 8), b.mul(rows, ir.Constant(INT64, 8 * k))))
            for k, mask in enumerate((in_reach, facing, in_reach & facing, near, backs_up, yields)):
                flags_of_rows = b.zext(mask.value, ir.VectorType(ir.IntType(8), LANES))
                store(b, flags_of_rows, b.add(at(flags_at, 1), b.mul(rows, ir.Constant(INT64, k))))
        for k, slot in enumerate(last):
            store(b, b.extract_element(b.load(slot), ir.Constant(INT, LANES - 1)), before_at, 8 * k)
        return context.get_dummy_value()

    arrays = (robot_pose, human_pose, reach_m, time_ns, before, limits, quantities, flags)
    return types.void(*arrays, types.intp), codegen


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
    count = len(robot_pose) // LANES
    before, thresholds = np.full(5, np.nan), np.array(limits)
    fill_eights(robot_pose, human_pose, reach_m, time_ns, before, thresholds, quantities, flags, count)
    done, rest = LANES * count, len(robot_pose) - LANES * count
    if rest:  # as if eight rows were left
        robots, people = np.zeros((2, LANES, 7), np.float32)
        reaches, times = np.zeros(LANES, reach_m.dtype), np.zeros(LANES, np.int64)
        robots[:rest], people[:rest] = robot_pose[done:], human_pose[done:]
        reaches[:rest], times[:rest] = reach_m[done:], time_ns[done:]
        last_quantities, last_flags = np.empty((4, LANES)), np.empty((6, LANES), np.bool_)
        fill_eights(robots, people, reaches, times, before, thresholds, last_quantities, last_flags, 1)
        quantities[:, done:], flags[:, done:] = last_quantities[:, :rest], last_flags[:, :rest]
    # the step from the last row of the episode before is no velocity
    for start in starts[: len(robot_pose)]:  # without rows there is no first one
        quantities[3, start], flags[4, start], flags[5, start] = np.nan, False, False


def _columns(b, address, first):
    """Four columns, from ``first`` on, of eight rows of seven float32 at ``address``, as float64."""
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
