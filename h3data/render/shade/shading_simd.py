"""Numba intrinsics that compute the lighting of 8 pixels at a time."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from h3data.kernels.vectors import (
    FLOAT8,
    INT,
    INT8,
    INT64,
    LANES,
    Vec,
    fma,
    intrinsic,
    lanes,
    load,
    pick,
    splat,
    spread,
    store,
)
from h3data.render.shade.textures_simd import level_of_detail, texel

TONE_SIZE = 8192
TONE_LIMIT = 2.0
"""Largest linear colour; colours are output as int32 levels, of which there are `TONE_SIZE` from 0 to `TONE_LIMIT`."""

# Float32 words of a triangle's attributes: colour and normal at vertex 0, and the differences of vertices 1 and 2.
COLOR, COLOR_1, COLOR_2, NORMAL, NORMAL_1, NORMAL_2 = 0, 3, 6, 9, 12, 15
# Texture coordinates likewise [repeats]; size of the finest level [texels]; increments per pixel, along x and along y, of 1/z
# and of the coordinates' differences from vertex 0 over z (with the planes' common factor); number of the coarsest level.
UV, UV_1, UV_2, TEXELS, NEARNESS_STEP, UV_STEP_X, UV_STEP_Y, LAST_LEVEL = 18, 20, 22, 24, 26, 28, 30, 32
# Light that a glossy surface mirrors from -x, +x, +y, -z and +z, likewise; and whether it is glossy.
MIRROR, GLOSS = 33, 48
MIRROR_SIDES = 5
ATTRIBUTES = 49
# Float32 words of the light: mean of sky and ground, half their difference, sun, fill, headlight, two directions, and the
# colours of the background.
MEAN, UP, SUN, FILL, HEADLIGHT, SUN_DIRECTION, FILL_DIRECTION, HORIZON, ZENITH = 0, 3, 6, 9, 12, 15, 18, 21, 24
# Float32 words of a block's rays and planes: value at its first pixel, then the increment per pixel.
NEARNESS, SECOND, THIRD, RAY = 0, 2, 4, 6
BLOCK_WORDS = 12
FACING_SHARE, GRAZING_SHARE = 0.04, 0.5
"""Shares of light that a glossy floor reflects at right angles, as all varnish and glaze do, and at grazing angles,
where it is 1 minus the roughness of 0.5 (Lagarde 2011, "Adopting a physically based shading model")."""
# Rows that `light_coordinates_block` outputs: texture coordinates [repeats] and level of detail.
S, T, LEVEL = 0, 1, 2


def _dot(a: list[Vec], b: list[Vec]) -> Vec:
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


def _words(b: Any, address: Any, first: int, count: int = 3) -> list[Vec]:
    """Return ``count`` words starting at ``first``, each broadcast to all lanes."""
    return [spread(b, address, first + a) for a in range(count)]


def _linear(b: Any, block_at: Any, first: int) -> Vec:
    """Return a quantity that is linear in x, at 8 pixels."""
    start, step = (spread(b, block_at, first + k) for k in range(2))
    return fma(step, lanes(b), start)


def _store_level(b: Any, color: Vec, strip_at: Any) -> None:
    level = (color * (TONE_SIZE / TONE_LIMIT)).maximum(0.0).minimum(TONE_SIZE - 1.0)
    store(b, b.fptosi(level.value, INT8), strip_at)


def _mix(b: Any, attributes_at: Any, first: int, second: Vec, third: Vec, count: int = 3) -> list[Vec]:
    """Return an attribute of ``count`` words, interpolated with the barycentrics of vertices 1 and 2."""
    corner, to_second, to_third = (_words(b, attributes_at, first + k * count, count) for k in range(3))
    return [fma(third, d3, fma(second, d2, c)) for c, d2, d3 in zip(corner, to_second, to_third, strict=True)]


def _store_coordinates(
    b: Any, attributes_at: Any, z: Vec, second: Vec, third: Vec, coordinates_at: Any, row_bytes: Any
) -> None:
    """Store S, T and LEVEL, which is chosen by the pixel's longer side on the texture (Williams 1983)."""
    corner, to_second, to_third = (_words(b, attributes_at, first, 2) for first in (UV, UV_1, UV_2))
    beyond = [fma(third, d3, second * d2) for d2, d3 in zip(to_second, to_third, strict=True)]
    size, nearness_step = _words(b, attributes_at, TEXELS, 2), _words(b, attributes_at, NEARNESS_STEP, 2)
    sides = []
    for step, first in zip(nearness_step, (UV_STEP_X, UV_STEP_Y), strict=True):
        # (s / w)' = (s' - (s / w) w') / w
        s, t = (
            (uv_step - place * step) * count
            for uv_step, place, count in zip(_words(b, attributes_at, first, 2), beyond, size, strict=True)
        )
        sides.append(fma(s, s, t * t))
    last = _words(b, attributes_at, LAST_LEVEL, 1)[0]
    level = level_of_detail(b, sides[0].maximum(sides[1]) * (z * z), last)
    for row in (*(start + offset for start, offset in zip(corner, beyond, strict=True)), level):
        store(b, row.value, coordinates_at)
        coordinates_at = b.add(coordinates_at, row_bytes)


def _emit_light(
    b: Any, block_at: Any, attributes_at: Any, light_at: Any, strip_at: Any, row_bytes: Any, coordinates: Any = None
) -> None:
    def mix(first: int) -> list[Vec]:
        return _mix(b, attributes_at, first, second, third)

    # perspective-correct barycentrics: (b / z) / (1 / z); clamped, because the inside test is slightly enlarged
    z = _linear(b, block_at, NEARNESS).reciprocal()
    second = (_linear(b, block_at, SECOND) * z).maximum(0.0).minimum(1.0)
    third = (_linear(b, block_at, THIRD) * z).maximum(0.0).minimum(1.0)

    if coordinates is not None:
        _store_coordinates(b, attributes_at, z, second, third, *coordinates)
    normal = mix(NORMAL)
    # normals of opposite directions may cancel out in the middle of a triangle
    squared = _dot(normal, normal).maximum(1e-20)
    scale = squared.unary("sqrt").reciprocal()
    normal = [n * scale for n in normal]
    ray = [_linear(b, block_at, RAY + 2 * a) for a in range(3)]
    facing = (-_dot(normal, ray)).maximum(0.0).divided_by(_dot(ray, ray).unary("sqrt"))
    sunny = _dot(normal, _words(b, light_at, SUN_DIRECTION)).maximum(0.0)
    filled = _dot(normal, _words(b, light_at, FILL_DIRECTION)).maximum(0.0)

    color = mix(COLOR)
    mean, up, sun, fill, head = (_words(b, light_at, k) for k in (MEAN, UP, SUN, FILL, HEADLIGHT))
    for a in range(3):
        light = fma(up[a], normal[1], fma(sun[a], sunny, fma(fill[a], filled, fma(head[a], facing, mean[a]))))
        if coordinates is None:
            _store_level(b, color[a] * light, strip_at)
        else:
            store(b, (color[a] * light).value, strip_at)
        strip_at = b.add(strip_at, row_bytes)
    for n in normal:
        store(b, n.value, strip_at)
        strip_at = b.add(strip_at, row_bytes)


@intrinsic
def light_block(typing_context, block_at, attributes_at, light_at, strip_at, row_bytes):
    """Light 8 neighbouring pixels of one triangle.

    The arguments are the addresses of the tables described in this module and of a strip of 6 rows: three receive
    linear levels (int32), three the unit normal (float32).
    """

    def codegen(context, builder, signature, arguments):
        _emit_light(builder, *arguments)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p), codegen


@intrinsic
def light_coordinates_block(
    typing_context, block_at, attributes_at, light_at, strip_at, row_bytes, coordinates_at, coordinates_bytes
):
    """Light 8 pixels of a textured triangle, without its texture, which `texture_block` applies.

    The strip receives float32 colours instead of levels; S, T and LEVEL go to separate rows.
    """

    def codegen(context, builder, signature, arguments):
        _emit_light(builder, *arguments[:5], coordinates=arguments[5:])
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p, p, p), codegen


@intrinsic
def texture_block(
    typing_context, strip_at, row_bytes, coordinates_at, coordinates_bytes, base, blended, levels_at, words_at
):
    """Multiply the colours of `light_coordinates_block` by the texture and convert them to levels.

    ``base`` and ``blended`` are the levels of detail, as in `textures_simd.texel`.
    """

    def codegen(context, b, signature, arguments):
        strip_at, row_bytes, coordinates_at, coordinates_bytes, base, blended, levels_at, words_at = arguments
        coordinates = [
            Vec(b, load(b, b.add(coordinates_at, b.mul(coordinates_bytes, INT64(row))))) for row in (S, T, LEVEL)
        ]
        for color in texel(b, coordinates, base, blended, levels_at, words_at):
            _store_level(b, color * Vec(b, load(b, strip_at)), strip_at)
            strip_at = b.add(strip_at, row_bytes)
        return context.get_dummy_value()

    p, i = types.uintp, types.int32
    return types.void(p, p, p, p, i, i, p, p), codegen


@intrinsic
def gloss_block(typing_context, block_at, attributes_at, strip_at, row_bytes):
    """Add reflected light to the levels of 8 pixels in a strip (`light_block`), approximated without ray tracing.

    The share is from Schlick ("An Inexpensive BRDF Model", 1994). The light is that of an ambient cube in the reflected
    direction (McTaggart 2004, "Half-Life 2 Source Shading").
    """

    def codegen(context, b, signature, arguments):
        block_at, attributes_at, strip_at, row_bytes = arguments
        z = _linear(b, block_at, NEARNESS).reciprocal()
        second = (_linear(b, block_at, SECOND) * z).maximum(0.0).minimum(1.0)
        third = (_linear(b, block_at, THIRD) * z).maximum(0.0).minimum(1.0)
        from_west, from_east, above, from_north, from_south = _mix(
            b, attributes_at, MIRROR, second, third, MIRROR_SIDES
        )
        at, normal = b.add(strip_at, b.mul(row_bytes, INT64(3))), []
        for _ in range(3):
            normal.append(Vec(b, load(b, at)))
            at = b.add(at, row_bytes)
        ray = [_linear(b, block_at, RAY + 2 * a) for a in range(3)]
        scale = _dot(ray, ray).unary("sqrt").reciprocal()
        ray = [r * scale for r in ray]
        facing = (-_dot(normal, ray)).maximum(0.0).minimum(1.0)
        # the ray mirrored at the surface: r - 2 (r . n) n
        x, y, side = (fma(facing * 2.0, n, r) for n, r in zip(normal, ray, strict=True))
        zero = x * 0.0
        sideways = from_east.where(x.compare(">", 0.0), from_west)
        forward = from_south.where(side.compare(">", 0.0), from_north)
        upward = above.where(y.compare(">", 0.0), zero)
        mirrored = fma(x * x, sideways, fma(y * y, upward, side * side * forward)).maximum(0.0)
        rest = -(facing - 1.0)
        fourth = rest * rest * rest * rest
        # Schlick: the fifth power of 1 - cosine
        share = fourth * rest * (GRAZING_SHARE - FACING_SHARE) + FACING_SHARE
        added, kept = mirrored * share * (TONE_SIZE / TONE_LIMIT), -(share - 1.0)
        for _ in range(3):
            level = Vec(b, b.sitofp(load(b, strip_at, 0, INT8), FLOAT8))
            level = fma(level, kept, added).maximum(0.0).minimum(TONE_SIZE - 1.0)
            store(b, b.fptosi(level.value, INT8), strip_at)
            strip_at = b.add(strip_at, row_bytes)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p), codegen


@intrinsic
def sky_block(typing_context, block_at, light_at, strip_at, row_bytes):
    """Fill 8 neighbouring background pixels, from horizon to zenith by the ray's elevation, in a strip as in `light_block`."""

    def codegen(context, b, signature, arguments):
        block_at, light_at, strip_at, row_bytes = arguments
        ray = [_linear(b, block_at, RAY + 2 * a) for a in range(3)]
        # the sine of the elevation; below the horizon all is as at the horizon
        height = ray[1].divided_by(_dot(ray, ray).unary("sqrt")).maximum(0.0).minimum(1.0)
        for horizon, zenith in zip(_words(b, light_at, HORIZON), _words(b, light_at, ZENITH), strict=True):
            _store_level(b, fma(zenith - horizon, height, horizon), strip_at)
            strip_at = b.add(strip_at, row_bytes)
        # no normal where nothing is seen
        for _ in range(3):
            store(b, (height * 0.0).value, strip_at)
            strip_at = b.add(strip_at, row_bytes)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p), codegen


@intrinsic
def equal_words(typing_context, address, word):
    """Count how many of the 8 int32 numbers at ``address`` equal ``word`` before the first one that does not."""

    def codegen(context, b, signature, arguments):
        address, word = arguments
        differ = b.icmp_signed("!=", load(b, address, 0, INT8), splat(b, word, INT8))
        bits = b.zext(b.bitcast(differ, ir.IntType(LANES)), INT)
        # a ninth bit, at which the count ends where all eight are equal
        return b.cttz(b.or_(bits, ir.Constant(INT, 1 << LANES)), ir.Constant(ir.IntType(1), 1))

    return types.int32(types.uintp, types.int32), codegen


@intrinsic
def even_nearness(typing_context, inv_z_at, words_at, word, instead, out_at):
    """Store every second of 16 float32 numbers, or ``instead`` where the int32 number at ``words_at`` is ``word``."""

    def codegen(context, b, signature, arguments):
        inv_z_at, words_at, word, instead, out_at = arguments
        even = pick(b, load(b, inv_z_at), load(b, inv_z_at, 4 * LANES), range(0, 2 * LANES, 2))
        replaced = b.icmp_signed("==", load(b, words_at, 0, INT8), splat(b, word, INT8))
        store(b, b.select(replaced, splat(b, instead), even), out_at)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, types.int32, types.float32, p), codegen


@intrinsic
def write_colors(typing_context, strip_at, row_bytes, bytes_at, rgb_at):
    """Write red, green and blue (uint8) of 8 pixels, looked up at ``bytes_at`` for the levels in a strip's first three rows."""

    def codegen(context, b, signature, arguments):
        strip_at, row_bytes, bytes_at, rgb_at = arguments
        byte = ir.IntType(8)
        for lane in range(LANES):
            at = b.add(strip_at, ir.Constant(INT64, 4 * lane))
            pixel: Any = None
            for channel in range(3):
                value = load(b, b.add(bytes_at, b.zext(load(b, at, 0, INT), INT64)), 0, byte)
                value = b.shl(b.zext(value, INT), ir.Constant(INT, 8 * channel))
                pixel = value if pixel is None else b.or_(pixel, value)
                at = b.add(at, row_bytes)
            # four bytes at once: the next pixel overwrites the fourth, and the last pixel does not write it
            target = b.add(rgb_at, ir.Constant(INT64, 3 * lane))
            parts = [(pixel, 0)]
            if lane == LANES - 1:
                parts = [(b.trunc(pixel, ir.IntType(16)), 0), (b.trunc(b.lshr(pixel, ir.Constant(INT, 16)), byte), 2)]
            for part, offset in parts:
                pointer = b.inttoptr(b.add(target, ir.Constant(INT64, offset)), part.type.as_pointer())
                b.store(part, pointer).align = 1
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p), codegen
