"""Numba intrinsics that compute ambient occlusion for 8 pixels of a row of the coarse image at a time."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from h3data.kernels.vectors import (
    FLOAT,
    FLOAT8,
    INT,
    INT8,
    LANES,
    Vec,
    fma,
    gather,
    intrinsic,
    lanes,
    load,
    pick,
    splat,
    spread,
    store,
)

TAPS = 12
# Float32 words of the table shared by all blocks of an image.
FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y, LAST_X, LAST_Y, RADIUS, NEAR_RADIUS, GAIN, BIAS_PER_Z = range(10)
OFFSETS = 16
"""First word of the taps' positions on the unit disc: x and y, for 8 lanes, for each tap, for four rows."""
ROW_OFFSETS = TAPS * 2 * LANES
TABLE_WORDS = OFFSETS + 4 * ROW_OFFSETS

BIAS_M = 0.004
"""Height above a surface [m], in addition to a share of the distance from the eye, above which a point occludes the
surface."""
SAME_SURFACE_M = 0.05
"""Distance from each other's planes within which pixels belong to one surface, so that amounts are blurred between them
[m]."""
NOWHERE = 1e-3
"""Weight of "not occluded", which takes effect if no neighbouring coarse pixel is on the pixel's surface."""


def _slope(b: Any, before2: Vec, before: Vec, middle: Vec, after: Vec, after2: Vec) -> Vec:
    """Step of 1/z to the next pixel, taken from the side on which the surface bends less."""
    left, right = middle - before, after - middle
    bend_left = (left - (before - before2)).unary("fabs")
    bend_right = ((after2 - after) - right).unary("fabs")
    return left.where(bend_left.compare("<=", bend_right), right)


def _emit_occlusion(
    b: Any, inv_z_at: Any, z_at: Any, planes_at: Any, plane_bytes: Any, x: Any, y: Any, row: Any, table_at: Any
) -> None:
    """Emit the code of occlusion, as `occlusion_block` describes."""
    offset = b.shl(b.add(b.mul(y, row), x), ir.Constant(x.type, 2))
    row_bytes = b.shl(row, ir.Constant(x.type, 2))
    here = b.add(inv_z_at, offset)

    def inv_z(dx: int, dy: int) -> Vec:
        return Vec(b, load(b, b.add(here, b.mul(row_bytes, ir.Constant(x.type, dy))), 4 * dx))

    near = inv_z(0, 0)
    slope_x = _slope(b, *(inv_z(k, 0) for k in range(-2, 3)))
    slope_y = _slope(b, *(inv_z(0, k) for k in range(-2, 3)))

    # The surface's plane over the ray (u, v, 1): 1/z = a u + b v + c. Its distance from the eye is 1 / |(a, b, c)|.
    fx, fy = spread(b, table_at, FOCAL_X), spread(b, table_at, FOCAL_Y)
    px = lanes(b) + Vec(b, splat(b, b.uitofp(x, FLOAT)))
    py = Vec(b, splat(b, b.uitofp(y, FLOAT)))
    per_fx, per_fy = fx.reciprocal(), fy.reciprocal()
    u, v = (px - spread(b, table_at, CENTER_X)) * per_fx, (py - spread(b, table_at, CENTER_Y)) * per_fy
    plane_u, plane_v = slope_x * fx, slope_y * fy
    plane_1 = near - plane_u * u - plane_v * v
    squared = fma(plane_u, plane_u, fma(plane_v, plane_v, plane_1 * plane_1)).maximum(1e-18)
    distance = squared.unary("sqrt").reciprocal()
    z = near.maximum(1e-6).reciprocal()
    eye_x, eye_y = u * z, v * z

    # The disc of taps has a fixed radius in metres, bounded by its size in the image.
    radius = spread(b, table_at, RADIUS)
    radius = radius.minimum(spread(b, table_at, NEAR_RADIUS) * z)
    reach_x, reach_y = radius * fx * near, radius * fy * near
    per_radius2 = (radius * radius).reciprocal()
    bias = z * spread(b, table_at, BIAS_PER_Z) + BIAS_M
    offsets_at = b.add(table_at, b.mul(b.and_(y, ir.Constant(x.type, 3)), ir.Constant(x.type, 4 * ROW_OFFSETS)))
    last_x, last_y = spread(b, table_at, LAST_X), spread(b, table_at, LAST_Y)
    row_words = splat(b, b.trunc(row, INT), INT8)
    total = Vec(b, ir.Constant(FLOAT8, [0.0] * LANES))
    for k in range(TAPS):
        to_x, to_y = (Vec(b, load(b, offsets_at, 4 * (OFFSETS + LANES * (2 * k + axis)))) for axis in (0, 1))
        # clamped: a tap outside of the image looks at its edge
        sx = (fma(to_x, reach_x, px) + 0.5).maximum(0.0).minimum(last_x).unary("floor")
        sy = (fma(to_y, reach_y, py) + 0.5).maximum(0.0).minimum(last_y).unary("floor")
        index = b.add(b.mul(b.fptosi(sy.value, INT8), row_words), b.fptosi(sx.value, INT8))
        sz = Vec(b, gather(b, z_at, index))
        dx, dy = sx - px, sy - py
        expected = fma(slope_x, dx, fma(slope_y, dy, near))
        # the plane's 1/z times the tap's z is 1 on the plane and less in front of it; times the distance it is a height
        rise = distance * (Vec(b, ir.Constant(FLOAT8, [1.0] * LANES)) - expected * sz)
        ex, ey, ez = fma(u + dx * per_fx, sz, -eye_x), fma(v + dy * per_fy, sz, -eye_y), sz - z
        apart2 = fma(ex, ex, fma(ey, ey, ez * ez))
        # falls to 0 at the radius, so that a surface does not begin to occlude with a step
        within = (-(apart2 * per_radius2 - 1.0)).maximum(0.0)
        total = fma((rise - bias).maximum(0.0) * within, (apart2 + 1e-6).unary("sqrt").reciprocal(), total)
    amount = (total * spread(b, table_at, GAIN)).maximum(0.0)
    amount = amount.divided_by(
        amount + 1.0
    )  # compressed, so that thin objects on the floor still show beside deep corners
    amount = amount.where(near.compare(">", 0.0), 0.0)
    at = b.add(planes_at, offset)
    for value in (slope_x, slope_y, distance * z * (1 / SAME_SURFACE_M), amount):
        store(b, value.value, at)
        at = b.add(at, plane_bytes)


_p = types.uintp


@intrinsic
def occlusion_block(typing_context, inv_z_at, z_at, planes_at, plane_bytes, x, y, row, table_at):
    """Compute occlusion of 8 neighbouring coarse pixels, starting at (x, y).

    The arguments are the addresses of pixel (0, 0) in 1/z (two pixels around the image are readable), in z, and in the
    four results, which are ``plane_bytes`` apart: slopes of 1/z along x and y, sharpness [m] (see `_likeness`) and
    amount 0..1. ``row`` is the number of words per row.
    """

    def codegen(context, builder, signature, arguments):
        _emit_occlusion(builder, *arguments)
        return context.get_dummy_value()

    return types.void(*[_p] * 8), codegen


def _likeness(nearness: Vec, expected: Vec, sharpness: Vec) -> Vec:
    """Return 1 for the ``expected`` nearness of a plane, falling to 0 at `SAME_SURFACE_M` off the plane."""
    return (-((nearness - expected).unary("fabs") * sharpness - 1.0)).maximum(0.0)


@intrinsic
def blur_block(typing_context, inv_z_at, slope_at, sharpness_at, source_at, target_at, step_bytes):
    """Blur the amounts of 8 coarse pixels along x or y: ``step_bytes`` to the next pixel, slopes at ``slope_at``."""

    def codegen(context, b, signature, arguments):
        inv_z_at, slope_at, sharpness_at, source_at, target_at, step_bytes = arguments
        near, slope, sharpness = (Vec(b, load(b, at)) for at in (inv_z_at, slope_at, sharpness_at))
        amounts, weights = None, None
        # each of the four rotations of taps in a row gets the same total weight
        for step, base in ((-2, 0.5), (-1, 1.0), (0, 1.0), (1, 1.0), (2, 0.5)):
            offset = b.mul(step_bytes, ir.Constant(step_bytes.type, step))
            amount = Vec(b, load(b, b.add(source_at, offset)))
            other = Vec(b, load(b, b.add(inv_z_at, offset)))
            weight = _likeness(other, near + slope * float(step), sharpness) * base if step else near * 0.0 + 1.0
            amounts = weight * amount if amounts is None else fma(weight, amount, amounts)
            weights = weight if weights is None else weights + weight
        assert amounts is not None
        assert weights is not None
        store(b, amounts.divided_by(weights).value, target_at)
        return context.get_dummy_value()

    return types.void(*[_p] * 6), codegen


_LEFT, _RIGHT = (0, 0, 1, 1, 2, 2, 3, 3), (0, 1, 1, 2, 2, 3, 3, 4)


def _emit_dimming(
    b: Any,
    inv_z_at: Any,
    planes_at: Any,
    plane_bytes: Any,
    lower_bytes: Any,
    near_at: Any,
    strip_at: Any,
    strip_bytes: Any,
    half_row: Any,
    strength: Any,
) -> None:
    """Emit the code of dimming, as `dim_block` describes."""
    rows = [ir.Constant(lower_bytes.type, 0), lower_bytes]
    amount_at = b.add(planes_at, b.mul(plane_bytes, ir.Constant(plane_bytes.type, 3)))
    raw = [load(b, b.add(amount_at, row)) for row in rows]
    largest = Vec(b, raw[0]).maximum(Vec(b, raw[1]))
    some = b.icmp_unsigned("!=", largest.compare(">", 0.0).bits(0), ir.Constant(INT, 0))
    # most blocks of a picture lie on open walls and floors, where all amounts are 0
    with b.if_then(some):
        near = Vec(b, load(b, near_at))
        half_x = Vec(b, ir.Constant(FLOAT8, [0.0, 0.5] * 4))
        half_y = Vec(b, splat(b, half_row))
        amounts, weights = Vec(b, ir.Constant(FLOAT8, [0.0] * LANES)), Vec(b, ir.Constant(FLOAT8, [NOWHERE] * LANES))
        for row, raw_amount, dy in zip(rows, raw, (half_y, -half_y), strict=True):
            coarse = load(b, b.add(inv_z_at, row))
            slope_at = b.add(planes_at, row)
            slope_x = load(b, slope_at)
            slope_y = load(b, b.add(slope_at, plane_bytes))
            sharpness = load(b, b.add(slope_at, b.shl(plane_bytes, ir.Constant(plane_bytes.type, 1))))
            for order, dx in ((_LEFT, half_x), (_RIGHT, -half_x)):
                c, gx, gy, s, a = (
                    Vec(b, pick(b, plane, plane, order)) for plane in (coarse, slope_x, slope_y, sharpness, raw_amount)
                )
                weight = _likeness(near, fma(gx, dx, fma(gy, dy, c)), s)
                amounts, weights = fma(weight, a, amounts), weights + weight
        light = -(amounts.divided_by(weights) * Vec(b, splat(b, strength)) - 1.0)
        at = strip_at
        for _ in range(3):
            level = Vec(b, b.sitofp(load(b, at, 0, INT8), FLOAT8))
            store(b, b.fptosi((level * light).value, INT8), at)
            at = b.add(at, strip_bytes)


@intrinsic
def dim_block(
    typing_context, inv_z_at, planes_at, plane_bytes, lower_bytes, near_at, strip_at, strip_bytes, half_row, strength
):
    """Dim 8 pixels of a strip of linear levels (3 rows of int32) by the amounts of the surrounding coarse pixels.

    The arguments are the addresses of the coarse pixel above and left of the first pixel, in 1/z and in the results of
    `occlusion_block`. ``lower_bytes`` is the offset to the coarse row below: 0 if the row coincides with a coarse row
    (then ``half_row`` is 0, else 0.5). ``near_at`` holds the 8 pixels' own 1/z.
    """

    def codegen(context, builder, signature, arguments):
        _emit_dimming(builder, *arguments)
        return context.get_dummy_value()

    return types.void(*[_p] * 7, types.float32, types.float32), codegen
