"""Numba intrinsics that compute the light that capsules block from 8 pixels at a time, as described in `blockers`.

There is no fused arithmetic here, so that NumPy in float32 gives the same numbers, bit for bit. Capsules that block no
light from any of the 8 pixels are skipped before roots and divisions. This changes no result, because their factor is
1.
"""

from __future__ import annotations

import functools
from typing import Any

from llvmlite import ir
from numba import types

from h3data.kernels.vectors import FLOAT8, INT, INT8, LANES, Vec, intrinsic, load, spread, store

# Float32 words of a capsule: one end, the vector to the other end, direction to the light, 1 / length^2, (vector . light),
# 1 / squared length across the light, radius and its square, half the length across the light, distance that shadows reach,
# 1 / range^4 of the ambient occlusion, group, share of the light that comes from the direction, length, and 1 / radius.
START, ALONG, LIGHT, PER_LENGTH2, ALONG_LIGHT, PER_ACROSS2, RADIUS, RADIUS2, WIDTH, REACH, PER_RANGE4 = (
    0,
    3,
    6,
    9,
    10,
    11,
    12,
    13,
    14,
    15,
    16,
)
GROUP, SHARE, LENGTH, PER_RADIUS = 17, 18, 19, 20
BLOCKER_WORDS = 21

SPREAD = 0.30
"""Tangent of the angular radius of the light, which is that of a window of 1.2 m at a distance of 2 m."""
FADE_M, KEPT_M = 0.25, 0.1
"""Distance beyond its reach up to which a shadow is complete, and the further distance over which it vanishes behind
walls (`h3data_light.field`) [m]."""
DARKEST = 0.22
"""Share of its light that a surface keeps when all of it is blocked; see `h3data_light.bake`."""

# Rows of 8 words of the rays of a block: origins and directions.
ORIGIN, DIRECTION = 0, 3
RAY_ROWS = 6
# Rows of 8 words of the scratch space: positions, light that is left, and of one group: light of the direction, other light.
POSITION, LEFT, DIRECTED, AMBIENT = 0, 3, 4, 5
SCRATCH_ROWS = 6

Triple = tuple[Vec, Vec, Vec]


def _dot(a: Triple, b: Triple) -> Vec:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _triple(b: Any, address: Any, word: int) -> Triple:
    return spread(b, address, word), spread(b, address, word + 1), spread(b, address, word + 2)


def _row(b: Any, address: Any, row: int) -> Vec:
    return Vec(b, load(b, address, 4 * LANES * row))


def _keep(b: Any, value: Vec, address: Any, row: int) -> None:
    store(b, value.value, address, 4 * LANES * row)


def _constant(b: Any, value: float) -> Vec:
    return Vec(b, ir.Constant(FLOAT8, [value] * LANES))


def _any_positive(b: Any, *values: Vec) -> Any:
    """Return whether all ``values`` are above 0 in one of the lanes at least, as a condition for ``if_then``."""
    least = functools.reduce(Vec.minimum, values)
    return b.icmp_unsigned("!=", least.compare(">", 0.0).bits(0), ir.Constant(INT, 0))


def _normal(b: Any, strip_at: Any, row_bytes: Any) -> Triple:
    rows = (b.mul(row_bytes, ir.Constant(row_bytes.type, 3 + axis)) for axis in range(3))
    x, y, z = (Vec(b, load(b, b.add(strip_at, row))) for row in rows)
    return x, y, z


_p = types.uintp


@intrinsic
def begin_block(typing_context, rays_at, near_at, scratch_at):
    """Compute the positions of 8 pixels from their rays and 1/z, and set their remaining light to 1."""

    def codegen(context, b, signature, arguments):
        rays_at, near_at, scratch_at = arguments
        z = Vec(b, load(b, near_at)).maximum(1e-9).reciprocal()
        for a in range(3):
            origin, direction = (_row(b, rays_at, first + a) for first in (ORIGIN, DIRECTION))
            _keep(b, origin + direction * z, scratch_at, POSITION + a)
        for row in (LEFT, DIRECTED, AMBIENT):
            _keep(b, _constant(b, 1.0), scratch_at, row)
        return context.get_dummy_value()

    return types.void(_p, _p, _p), codegen


def _from_start(b: Any, blocker_at: Any, scratch_at: Any) -> Triple:
    start = _triple(b, blocker_at, START)
    x, y, z = (_row(b, scratch_at, POSITION + a) - start[a] for a in range(3))
    return x, y, z


def _take(b: Any, taken: Vec, blocker_at: Any, owners_at: Any, scratch_at: Any, row: int) -> None:
    """Multiply a row of the scratch space by what is left, except for pixels of the capsule's own group."""
    own = Vec(b, load(b, owners_at)).compare("==", spread(b, blocker_at, GROUP))
    # 1 - taken: vectors have no number on the left of an operator
    left = (-(taken - 1.0)).where(~own, 1.0)
    _keep(b, _row(b, scratch_at, row) * left, scratch_at, row)


@intrinsic
def block_all_light(typing_context, blocker_at, strip_at, row_bytes, owners_at, scratch_at):
    """Multiply AMBIENT of 8 pixels by the share of light that a capsule leaves, seen from the nearest point of its axis.

    ``strip_at`` is the address of a strip of 6 rows of which the last three hold normals (`shading_simd.light_block`).
    """

    def codegen(context, b, signature, arguments):
        blocker_at, strip_at, row_bytes, owners_at, scratch_at = arguments
        normal, along = _normal(b, strip_at, row_bytes), _triple(b, blocker_at, ALONG)
        radius2, from_start = spread(b, blocker_at, RADIUS2), _from_start(b, blocker_at, scratch_at)
        s = (_dot(from_start, along) * spread(b, blocker_at, PER_LENGTH2)).maximum(0.0).minimum(1.0)
        x, y, z = (along[a] * s - from_start[a] for a in range(3))
        # inside of a capsule, as where a foot sinks into a carpet, its surface is the nearest that it gets
        distance2 = _dot((x, y, z), (x, y, z)).maximum(radius2)
        window = (-(distance2 * distance2 * spread(b, blocker_at, PER_RANGE4) - 1.0)).maximum(0.0)
        towards = _dot(normal, (x, y, z)).maximum(0.0)
        with b.if_then(_any_positive(b, window, towards)):
            per_distance, one = distance2.unary("sqrt").reciprocal(), _constant(b, 1.0)
            radius, length = spread(b, blocker_at, RADIUS), spread(b, blocker_at, LENGTH)
            before, after = length * s + radius, length * (-(s - 1.0)) + radius
            covered = ((before * per_distance).minimum(1.0) + (after * per_distance).minimum(1.0)) * 0.5
            facing = towards * per_distance
            hidden = (facing * (radius * per_distance) * covered * window * window).minimum(one)
            _take(b, hidden, blocker_at, owners_at, scratch_at, AMBIENT)
        return context.get_dummy_value()

    return types.void(_p, _p, _p, _p, _p), codegen


@intrinsic
def block_one_direction(typing_context, blocker_at, owners_at, scratch_at):
    """Multiply DIRECTED of 8 pixels by the share that a capsule leaves: a sphere at its point nearest the ray to the light."""

    def codegen(context, b, signature, arguments):
        blocker_at, owners_at, scratch_at = arguments
        along, light = (_triple(b, blocker_at, word) for word in (ALONG, LIGHT))
        to_light, radius = spread(b, blocker_at, ALONG_LIGHT), spread(b, blocker_at, RADIUS)
        from_start = _from_start(b, blocker_at, scratch_at)
        beside, ahead = _dot(from_start, along), _dot(from_start, light)
        s = ((beside - ahead * to_light) * spread(b, blocker_at, PER_ACROSS2)).maximum(0.0).minimum(1.0)
        x, y, z = (along[a] * s - from_start[a] for a in range(3))
        away = s * to_light - ahead
        off2 = (_dot((x, y, z), (x, y, z)) - away * away).maximum(0.0)
        # at least 1 cm, because it is a divisor below
        disc = (away * SPREAD).maximum(0.01)
        touching, left = disc + radius, spread(b, blocker_at, REACH) + (KEPT_M + FADE_M) - away
        # a little more than where the discs touch, so that rounding never leaves a pixel out
        close = touching * touching * 1.0001 - off2
        with b.if_then(_any_positive(b, away, left, close)):
            off, per_radius, per_disc = off2.unary("sqrt"), spread(b, blocker_at, PER_RADIUS), disc.reciprocal()
            step = ((touching - off) * (per_disc.maximum(per_radius) * 0.5)).maximum(0.0).minimum(1.0)
            # the smooth step 3 s^2 - 2 s^3
            overlap = step * step * (-(step * 2.0 - 3.0))
            wide = (spread(b, blocker_at, WIDTH) * per_disc).minimum(1.0)
            most = (radius * per_disc * wide).minimum(1.0)
            onset = (away * (per_radius * 2.0)).maximum(0.0).minimum(1.0)
            fade = (left * (1 / FADE_M)).maximum(0.0).minimum(1.0)
            _take(b, most * overlap * onset * fade, blocker_at, owners_at, scratch_at, DIRECTED)
        return context.get_dummy_value()

    return types.void(_p, _p, _p), codegen


@intrinsic
def end_group_block(typing_context, blocker_at, strip_at, row_bytes, scratch_at):
    """Multiply LEFT by the share that a group of capsules leaves, and reset DIRECTED and AMBIENT to 1.

    ``blocker_at`` is any capsule of the group.
    """

    def codegen(context, b, signature, arguments):
        blocker_at, strip_at, row_bytes, scratch_at = arguments
        taken = [-(_row(b, scratch_at, row) - 1.0) for row in (DIRECTED, AMBIENT)]
        with b.if_then(_any_positive(b, taken[0].maximum(taken[1]))):
            normal, light = _normal(b, strip_at, row_bytes), _triple(b, blocker_at, LIGHT)
            share = spread(b, blocker_at, SHARE)
            directed = share * _dot(normal, light).maximum(0.0)
            other = (-(share - 1.0)) * 0.25
            directed = directed.divided_by((directed + other).maximum(1e-6))
            lost = directed * taken[0]
            lost = lost + (-(directed - 1.0)) * taken[1]
            _keep(b, _row(b, scratch_at, LEFT) * (-(lost * (1 - DARKEST) - 1.0)), scratch_at, LEFT)
            for row in (DIRECTED, AMBIENT):
                _keep(b, _constant(b, 1.0), scratch_at, row)
        return context.get_dummy_value()

    return types.void(_p, _p, _p, _p), codegen


@intrinsic
def dim_levels_block(typing_context, near_at, strip_at, row_bytes, scratch_at):
    """Multiply the levels of 8 pixels that see something (1/z > 0) by LEFT."""

    def codegen(context, b, signature, arguments):
        near_at, strip_at, row_bytes, scratch_at = arguments
        some = _row(b, scratch_at, LEFT)
        with b.if_then(_any_positive(b, -(some - 1.0))):
            left = some.where(Vec(b, load(b, near_at)).compare(">", 0.0), 1.0)
            for _ in range(3):
                level = Vec(b, b.sitofp(load(b, strip_at, 0, INT8), FLOAT8))
                store(b, b.fptosi((level * left).value, INT8), strip_at)
                strip_at = b.add(strip_at, row_bytes)
        return context.get_dummy_value()

    return types.void(_p, _p, _p, _p), codegen
