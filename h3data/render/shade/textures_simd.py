"""Texture look-up for 8 pixels at a time as LLVM IR: bilinear in linear light, blended between two mip levels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from h3data.kernels.vectors import FLOAT, FLOAT8, INT, INT8, INT64, LANES, Vec, fma, load, splat

OFFSET, WIDTH, HEIGHT, FOLLOWING = range(4)
"""Columns of a level (int32): its first word, its size in texels, and the number of coarser levels that follow."""
LEVEL_WORDS = 4
ONE_LEVEL = 0.25
"""Distance from an integer level of detail within which one level is used; otherwise two levels are blended."""


def level_of_detail(b: Any, squared: Vec, last: Vec) -> Vec:
    """Compute the level of detail at which a texel is as large as a pixel.

    The level is between 0 and ``last``, and follows from the squared number of texels per pixel.

    The logarithm is approximated linearly between powers of two, which is at most 0.05 levels too small.
    """
    # the bits of a float, read as an integer, are about 2^23 (127 + log2); half of the logarithm is that of the root
    bits = Vec(b, b.sitofp(b.bitcast(squared.value, INT8), FLOAT8))
    return fma(bits, 0.5 / 2**23, -63.5).maximum(0.0).minimum(last)


def texel(b: Any, coordinates: list[Vec], base: Any, blended: Any, levels_at: Any, words_at: Any) -> list[Vec]:
    """Look up red, green and blue, as squared steps (`textures.WORD_SCALE`).

    ``coordinates`` are s, t [repeats] and level of detail.

    All lanes use level ``base`` and, if ``blended`` is not 0, blend it with the next one according to their own level.
    ``levels_at`` is the texture's finest level.
    """
    s, t, level = coordinates
    beyond = level - Vec(b, splat(b, b.sitofp(base, FLOAT)))
    fraction = ((beyond - ONE_LEVEL) * (0.5 / ONE_LEVEL)).maximum(0.0).minimum(1.0)
    base_at = b.add(levels_at, b.mul(b.zext(base, INT64), ir.Constant(INT64, 4 * LEVEL_WORDS)))
    fine = _bilinear(b, s, t, base_at, words_at)
    before = b.block
    with b.if_then(b.icmp_signed("!=", blended, ir.Constant(INT, 0))):
        coarse = _bilinear(b, s, t, b.add(base_at, ir.Constant(INT64, 4 * LEVEL_WORDS)), words_at)
        blended = [fma(fraction, c - f, f) for f, c in zip(fine, coarse, strict=True)]
        inside = b.block
    colors = []
    for f, m in zip(fine, blended, strict=True):
        phi = b.phi(FLOAT8)
        phi.add_incoming(f.value, before)
        phi.add_incoming(m.value, inside)
        colors.append(Vec(b, phi))
    return colors


def _bilinear(b: Any, s: Vec, t: Vec, level_at: Any, words_at: Any) -> list[Vec]:
    """Return the squared steps of red, green and blue from one level."""
    offset, width, height = (load(b, level_at, 4 * k, INT) for k in (OFFSET, WIDTH, HEIGHT))
    stride = b.add(width, ir.Constant(INT, 1))
    column, right = _place(b, s, width)
    row, lower = _place(b, t, height)
    index = b.add(b.mul(row, splat(b, stride, INT8)), column)
    first_at = b.add(words_at, b.shl(b.sext(offset, INT64), ir.Constant(INT64, 2)))
    numbers = [b.zext(b.extract_element(index, ir.Constant(INT, k)), INT64) for k in range(LANES)]
    addresses = [b.add(first_at, b.shl(number, ir.Constant(INT64, 2))) for number in numbers]
    row_bytes = b.shl(b.sext(stride, INT64), ir.Constant(INT64, 2))
    upper_pairs = _pairs(b, addresses)
    lower_pairs = _pairs(b, [b.add(address, row_bytes) for address in addresses])
    both = right * lower
    # (1 - r)(1 - l), r (1 - l), (1 - r) l and r l, which share one product
    weights = (fma(right, -1.0, both - lower + 1.0), right - both, lower - both, both)
    colors: list[Vec] = []
    for words, weight in zip((*upper_pairs, *lower_pairs), weights, strict=True):
        roots = _roots(b, words)
        if not colors:
            colors = [weight * (root * root) for root in roots]
        else:
            colors = [fma(weight, root * root, color) for root, color in zip(roots, colors, strict=True)]
    return colors


def _place(b: Any, coordinate: Vec, size: Any) -> tuple[Any, Vec]:
    """Return texel whose centre lies just before a coordinate [repeats], int32 from 0, and the fraction beyond it."""
    count = Vec(b, splat(b, b.sitofp(size, FLOAT)))
    # texels have their centres at halves
    place = fma(coordinate - coordinate.unary("floor"), count, -0.5)
    place = (place + count).where(place.compare("<", 0.0), place)
    texel_before = place.unary("floor").maximum(0.0).minimum(count - 1.0)  # within the texture even for NaN
    return b.fptosi(texel_before.value, INT8), place - texel_before


def _pairs(b: Any, addresses: list[Any]) -> tuple[Any, Any]:
    """Return the words at eight addresses and the words after them, by one 64-bit load per pair."""
    halves = []
    for order in ((0, 1, 4, 5), (2, 3, 6, 7)):  # in this order, one shuffle within 128 bits sorts the lanes
        half = ir.Constant(ir.VectorType(INT64, 4), ir.Undefined)
        for k, lane in enumerate(order):
            half = b.insert_element(half, load(b, addresses[lane], 0, INT64), ir.Constant(INT, k))
        halves.append(b.bitcast(half, INT8))
    return tuple(
        b.shuffle_vector(*halves, ir.Constant(INT8, [k + odd for k in (0, 2, 8, 10, 4, 6, 12, 14)])) for odd in (0, 1)
    )  # type: ignore[return-value]


def _roots(b: Any, words: Any) -> list[Vec]:
    """Return the channels of packed words as floats."""

    def constant(value: int) -> Any:
        return ir.Constant(INT8, [value] * LANES)

    steps = (
        b.lshr(words, constant(21)),
        b.and_(b.lshr(words, constant(10)), constant(2047)),
        b.and_(words, constant(1023)),
    )
    return [Vec(b, b.sitofp(step, FLOAT8)) for step in steps]
