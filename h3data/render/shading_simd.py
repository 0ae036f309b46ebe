"""Lighting of 8 pixels at a time, as one numba intrinsic."""

from __future__ import annotations

from typing import Any

from numba import types

from h3data.render.vectors import FLOAT, INT8, Vec, fma, intrinsic, lanes, load, splat, store

TONE_SIZE = 8192
TONE_LIMIT = 2.0
"""Colours leave here as int32 linear levels: `TONE_SIZE` of them from 0 to `TONE_LIMIT`."""

# Float32 words of a triangle's attributes: colour and normal at vertex 0, and the differences of vertices 1 and 2.
COLOR, COLOR_1, COLOR_2, NORMAL, NORMAL_1, NORMAL_2 = 0, 3, 6, 9, 12, 15
ATTRIBUTES = 18
# Float32 words of the light: mean of sky and ground, half their difference, sun, fill, headlight, two directions, and the
# background's colours.
MEAN, UP, SUN, FILL, HEADLIGHT, SUN_DIRECTION, FILL_DIRECTION, HORIZON, ZENITH = 0, 3, 6, 9, 12, 15, 18, 21, 24
# Float32 words of a block's rays and planes: value at its first pixel, then the step to the next pixel.
NEARNESS, SECOND, THIRD, RAY = 0, 2, 4, 6
BLOCK_WORDS = 12


def _dot(a: list[Vec], b: list[Vec]) -> Vec:
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


def _words(b: Any, address: Any, first: int) -> list[Vec]:
    """Three words from ``first`` on, each in all lanes."""
    return [Vec(b, splat(b, load(b, address, 4 * (first + a), FLOAT))) for a in range(3)]


def _linear(b: Any, block_at: Any, first: int) -> Vec:
    """What goes from pixel to pixel in equal steps."""
    start, step = (Vec(b, splat(b, load(b, block_at, 4 * (first + k), FLOAT))) for k in range(2))
    return fma(step, lanes(b), start)


def _store_level(b: Any, color: Vec, strip_at: Any) -> None:
    level = (color * (TONE_SIZE / TONE_LIMIT)).maximum(0.0).minimum(TONE_SIZE - 1.0)
    store(b, b.fptosi(level.value, INT8), strip_at)


def _emit_light(b: Any, block_at: Any, attributes_at: Any, light_at: Any, strip_at: Any, row_bytes: Any) -> None:
    def mix(first: int) -> list[Vec]:
        corner, second_difference, third_difference = (_words(b, attributes_at, first + k) for k in (0, 3, 6))
        return [
            fma(third, d3, fma(second, d2, c))
            for c, d2, d3 in zip(corner, second_difference, third_difference, strict=True)
        ]

    # perspective-correct barycentrics: (b / z) / (1 / z); clamped, since the inside test is a little generous
    z = _linear(b, block_at, NEARNESS).reciprocal()
    second = (_linear(b, block_at, SECOND) * z).maximum(0.0).minimum(1.0)
    third = (_linear(b, block_at, THIRD) * z).maximum(0.0).minimum(1.0)

    normal = mix(NORMAL)
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
        _store_level(b, color[a] * light, strip_at)
        strip_at = b.add(strip_at, row_bytes)
    for n in normal:
        store(b, n.value, strip_at)
        strip_at = b.add(strip_at, row_bytes)


@intrinsic
def light_block(typing_context, block_at, attributes_at, light_at, strip_at, row_bytes):
    """Light 8 neighbouring pixels of one triangle.

    Addresses of the tables described above and of the strip: 6 rows, of which three get linear levels (int32) and three
    the unit normal (float32).
    """

    def codegen(context, builder, signature, arguments):
        _emit_light(builder, *arguments)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p), codegen


@intrinsic
def sky_block(typing_context, block_at, light_at, strip_at, row_bytes):
    """Write 8 neighbouring pixels of background, from horizon to zenith by the ray's elevation; as `light_block`."""

    def codegen(context, b, signature, arguments):
        block_at, light_at, strip_at, row_bytes = arguments
        ray = [_linear(b, block_at, RAY + 2 * a) for a in range(3)]
        height = ray[1].divided_by(_dot(ray, ray).unary("sqrt")).maximum(0.0).minimum(1.0)
        for horizon, zenith in zip(_words(b, light_at, HORIZON), _words(b, light_at, ZENITH), strict=True):
            _store_level(b, fma(zenith - horizon, height, horizon), strip_at)
            strip_at = b.add(strip_at, row_bytes)
        for _ in range(3):
            store(b, (height * 0.0).value, strip_at)
            strip_at = b.add(strip_at, row_bytes)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p), codegen
