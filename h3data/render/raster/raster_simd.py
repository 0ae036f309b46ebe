"""The rasteriser's inner steps as 8-wide numba intrinsics: set-up of 8 triangles, 8 pixels, minimum of an 8x8 tile."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from h3data.kernels.vectors import (
    INT,
    INT8,
    LANES,
    Vec,
    fetch,
    fma,
    intrinsic,
    lanes,
    load,
    opaque,
    splat,
    spread,
    store,
)

NEAR_M = 0.02
"""Depth below which triangles are filled by exact homogeneous edge functions [m]; it is not a near plane."""

# Rows of the table that `setup_triangles` writes, 8 lanes each.
E0, E1, E2, INV_Z = 0, 1, 2, 3  # edge values and nearness at the first pixel centre of the box
E0_DX, E1_DX, E2_DX, INV_Z_DX = 4, 5, 6, 7  # their increments per pixel to the right
E0_DY, E1_DY, E2_DY, INV_Z_DY = 8, 9, 10, 11  # their increments per pixel downwards
X0, X1, Y0, Y1 = 12, 13, 14, 15  # the box, inclusive; int32 in the same words
INV_Z_MAX = 16  # nearness of the nearest vertex
SETUP_ROWS = 17
# Float32 words shared by all packets of an image.
CENTER_X, CENTER_Y, SCREEN_WIDTH, SCREEN_HEIGHT = range(4)
SCREEN_WORDS = 4


@intrinsic
def count_trailing_zeros(typing_context, bits):
    """Return the index of the lowest set bit of a non-zero int32."""

    def codegen(context, builder, signature, arguments):
        # 1: undefined for zero, for which some processors would need a second instruction
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int32(types.int32), codegen


@intrinsic
def tile_minimum(typing_context, address, row_bytes):
    """Return the smallest float32 in the 8x8 block at ``address``."""

    def codegen(context, builder, signature, arguments):
        address, row_bytes = arguments
        smallest = Vec(builder, load(builder, address))
        for _ in range(7):
            address = builder.add(address, row_bytes)
            smallest = smallest.minimum(Vec(builder, load(builder, address)))
        # halves, quarters and eighths folded onto each other, after which each lane holds the minimum of all
        for shift in (4, 2, 1):
            order = ir.Constant(INT8, [(i + shift) % LANES for i in range(LANES)])
            turned = builder.shuffle_vector(smallest.value, smallest.value, order)
            smallest = smallest.minimum(Vec(builder, turned))
        return builder.extract_element(smallest.value, ir.Constant(INT, 0))

    return types.float32(types.uintp, types.uintp), codegen


_f, _p, _i = types.float32, types.uintp, types.int32


@intrinsic
def blend_block(typing_context, inv_z_at, word_at, e0, e1, e2, inv_z, e0_dx, e1_dx, e2_dx, inv_z_dx, word):
    """Write nearness and word of 8 pixels in a row where no edge value is negative and nearness exceeds the buffer's."""

    def codegen(context, builder, signature, arguments):
        inv_z_at, word_at, *values, word = arguments
        starts = [Vec(builder, splat(builder, v)) for v in values[:4]]
        steps = [Vec(builder, splat(builder, v)) for v in values[4:]]
        lane = lanes(builder)
        edge0, edge1, edge2, nearness = (fma(step, lane, start) for start, step in zip(starts, steps, strict=True))
        old = Vec(builder, load(builder, inv_z_at))
        old_words = load(builder, word_at, 0, INT8)
        inside = edge0.minimum(edge1).minimum(edge2).compare(">=", 0.0)
        keep = (inside & nearness.compare(">", old)).value
        store(builder, opaque(builder, builder.select(keep, nearness.value, old.value)), inv_z_at)
        store(builder, opaque(builder, builder.select(keep, splat(builder, word, INT8), old_words)), word_at)
        return context.get_dummy_value()

    return types.void(_p, _p, _f, _f, _f, _f, _f, _f, _f, _f, _i), codegen


@intrinsic
def fetch_ahead(typing_context, address):
    """Prefetch the cache line at ``address``, which may be any address."""

    def codegen(context, builder, signature, arguments):
        fetch(builder, arguments[0])
        return context.get_dummy_value()

    return types.void(_p), codegen


def _smallest(v: list[Vec]) -> Vec:
    return v[0].minimum(v[1]).minimum(v[2])


def _largest(v: list[Vec]) -> Vec:
    return v[0].maximum(v[1]).maximum(v[2])


def _emit_setup(b: Any, packet_at: Any, matrix_at: Any, screen_at: Any, table_at: Any, *, parallel: bool) -> Any:
    """Emit the code of a set-up, as `setup_triangles` describes."""
    m = [spread(b, matrix_at, k) for k in range(12)]
    screen = [spread(b, screen_at, k) for k in range(SCREEN_WORDS)]
    center_x, center_y, width, height = screen
    x: list[Vec] = []
    y: list[Vec] = []
    z: list[Vec] = []
    w: list[Vec] = []  # nearness: 1/z, or reach - z
    for vertex in range(3):
        px, py, pz = (Vec(b, load(b, packet_at, 32 * (3 * vertex + axis))) for axis in range(3))
        qx, qy, qz = (fma(m[4 * r], px, fma(m[4 * r + 1], py, fma(m[4 * r + 2], pz, m[4 * r + 3]))) for r in range(3))
        if parallel:  # the matrix maps to pixels and nearness directly
            x.append(qx + center_x)
            y.append(qy + center_y)
            w.append(qz)
        else:
            inverse = qz.reciprocal()
            x.append(fma(qx, inverse, center_x))
            y.append(fma(qy, inverse, center_y))
            z.append(qz)
            w.append(inverse)

    # Pixel centres inside the bounding box; x1 < x0 if there is none.
    x0 = (_smallest(x).maximum(0.0) - 0.5).unary("ceil")
    x1 = (_largest(x).minimum(width) - 0.5).unary("floor")
    y0 = (_smallest(y).maximum(0.0) - 0.5).unary("ceil")
    y1 = (_largest(y).minimum(height) - 0.5).unary("floor")

    # Barycentrics of vertices 1 and 2 and nearness, as linear functions of the pixel.
    ax, ay, bx, by = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    area = ax * by - bx * ay  # twice the signed area
    inv_area = area.reciprocal()
    e1_dx, e1_dy = by * inv_area + 0.0, -(bx * inv_area)  # + 0.0: no -0.0 may reach the span division
    e2_dx, e2_dy = -(ay * inv_area) + 0.0, ax * inv_area
    e0_dx, e0_dy = -(e1_dx + e2_dx), -(e1_dy + e2_dy)
    px, py = x0 + 0.5 - x[0], y0 + 0.5 - y[0]
    e1 = fma(e1_dx, px, e1_dy * py)
    e2 = fma(e2_dx, px, e2_dy * py)
    e0 = -(e1 + e2 - 1.0)
    w1, w2 = w[1] - w[0], w[2] - w[0]
    inv_z = fma(e1, w1, fma(e2, w2, w[0]))
    inv_z_dx, inv_z_dy = fma(e1_dx, w1, e2_dx * w2), fma(e1_dy, w1, e2_dy * w2)

    # The inside test is slightly enlarged against cracks: by 1e-6, and by more for slivers, whose rounding is worse.
    length2 = fma(ax, ax, fma(ay, ay, fma(bx, bx, by * by)))
    sliverness = length2 * inv_area.unary("fabs")
    tolerance = fma(sliverness, 2e-7, 1e-6)
    e0, e1, e2 = e0 + tolerance, e1 + tolerance, e2 + tolerance

    across, down = x1 - x0, y1 - y0
    one_pixel = (across + down).compare("==", 0.0)
    hit = e0.minimum(e1).minimum(e2).compare(">=", 0.0)
    drawn = across.compare(">=", 0.0) & down.compare(">=", 0.0) & (~one_pixel | hit) & area.compare("!=", 0.0)
    small = across.compare("<", 8.0) & down.compare("<", 32.0)
    # float32 suffices for triangles with mild perspective that are neither slivers nor too large
    fine = sliverness.compare("<", 64.0)
    if not parallel:
        fine = fine & _largest(w).compare("<", _smallest(w) * 4.0)
    # largest width and height of pixel boxes on the float32 span path
    medium_px = 64
    fine = fine & across.compare("<", float(medium_px)) & down.compare("<", float(medium_px))

    steps = (e0_dx, e1_dx, e2_dx, inv_z_dx, e0_dy, e1_dy, e2_dy, inv_z_dy)
    for row, value in enumerate((e0, e1, e2, inv_z, *steps)):
        store(b, value.value, table_at, 32 * row)
    for row, value in ((X0, x0), (X1, x1), (Y0, y0), (Y1, y1)):
        store(b, b.fptosi(value.value, INT8), table_at, 32 * row)
    store(b, _largest(w).value, table_at, 32 * INV_Z_MAX)

    if parallel:
        is_large = drawn & ~fine
    else:
        near, in_front = _smallest(z).compare("<", NEAR_M), _largest(z).compare(">", 0.0)
        drawn = drawn & ~near
        is_large = (drawn & ~fine) | (near & in_front)
    is_small = drawn & fine & small
    is_medium = drawn & fine & ~small
    return b.or_(is_small.bits(0), b.or_(is_large.bits(8), is_medium.bits(16)))


@intrinsic
def setup_triangles(typing_context, packet_at, matrix_at, screen_at, table_at):
    """Transform, project, cull and set up the 8 triangles of one packet.

    The arguments are the addresses of the packet (9 rows x 8 lanes: x y z of three vertices), the 3x4 matrix to camera
    space with its first two rows times the focal lengths, the words of the screen, and the output table [SETUP_ROWS,
    8]. Returns three masks of the remaining triangles: bits 0-7 small; 8-15 large, sliver or near the eye; 16-23
    medium.
    """

    def codegen(context, builder, signature, arguments):
        return _emit_setup(builder, *arguments, parallel=False)

    return types.int32(_p, _p, _p, _p), codegen


@intrinsic
def setup_parallel_triangles(typing_context, packet_at, matrix_at, screen_at, table_at):
    """Set up the 8 triangles of one packet for an orthographic camera; the last row of the matrix maps to nearness."""

    def codegen(context, builder, signature, arguments):
        return _emit_setup(builder, *arguments, parallel=True)

    return types.int32(_p, _p, _p, _p), codegen
