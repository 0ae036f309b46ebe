"""Textures of a scene packed in one array, with mip levels averaged in linear light and one word per texel.

A word holds the square roots of linear red, green and blue in 11, 11 and 10 bits: finer than sRGB bytes everywhere, and
squaring restores linear light. In transparent textures, averages are weighted by opacity, and fully transparent texels
take their colour from coarser levels, so that the colour stored under them never shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Texture
from h3data.render.shade.textures_simd import FOLLOWING, HEIGHT, LEVEL_WORDS, OFFSET, WIDTH
from h3data.srgb import bytes_to_linear

BITS = (11, 11, 10)
SHIFTS = (21, 10, 0)
WORD_SCALE = tuple((1 + 1e-6) / (2**bits - 1) ** 2 for bits in BITS)
"""Factor from squared steps of each channel to linear light, slightly enlarged so that rounding never darkens white."""


class Textures(NamedTuple):
    """Packed textures of a scene."""

    words: NDArray[np.uint32]
    """All levels of all textures, row by row, shape [N]. Each level repeats its first column and row at the end, so that
    neighbouring texels are adjacent in memory."""
    levels: NDArray[np.int32]
    """Levels of all textures, finest first within each; columns as in `textures_simd`, shape [L, 4]."""
    first_level: NDArray[np.int32]
    """Row of each texture's finest level, shape [T]."""


def pack_textures(textures: Sequence[Texture]) -> Textures:
    """Pack textures with all their levels, down to a single texel."""
    words, levels, first = [np.zeros(0, np.uint32)], [], []
    offset = 0
    for texture in textures:
        pyramid = mip_levels(texture.pixels)
        first.append(len(levels))
        for k, linear in enumerate(pyramid):
            row = np.zeros(LEVEL_WORDS, np.int32)
            row[OFFSET], row[HEIGHT], row[WIDTH] = offset, *linear.shape[:2]
            row[FOLLOWING] = len(pyramid) - 1 - k
            levels.append(row)
            # linear colours as words
            steps = np.array([2**bits - 1 for bits in BITS], np.float32)
            channels = np.rint(np.sqrt(np.clip(linear, 0, 1)) * steps).astype(np.uint32)
            words.append(
                np.pad(
                    np.bitwise_or.reduce(channels << np.array(SHIFTS, np.uint32), axis=2), ((0, 1), (0, 1)), mode="wrap"
                ).ravel()
            )
            offset += words[-1].size
    return Textures(
        np.concatenate(words),
        np.array(levels, np.int32).reshape(-1, LEVEL_WORDS),
        np.array(first, np.int32),
    )


def mip_levels(pixels: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """Compute linear colours of a texture [H, W, 4] at successively halved sizes.

    The first level has full size, the last one texel; each is [h, w, 3].

    Each level averages boxes of two texels per axis (two and a fraction for odd sizes), weighted by opacity.
    """
    # a table of 256 entries, because the exact curve takes a power per value
    linear_of_byte = bytes_to_linear(np.arange(256)).astype(np.float32)
    colors, opacity = linear_of_byte[pixels[..., :3]], pixels[..., 3:].astype(np.float32)
    # where all is transparent, opacity would be no weight, and its colours are as good as any
    opaque = bool((opacity == 255).all()) or not opacity.any()
    levels = [colors if opaque else np.concatenate([colors * opacity, opacity], axis=2)]
    while levels[-1].size > levels[-1].shape[2]:
        levels.append(_halved(_halved(levels[-1], 0), 1))
    if opaque:
        return levels
    # from the coarsest level down, so that texels without opacity find a colour in the level that was made before
    coarser = levels[-1][..., :3] / levels[-1][..., 3:]
    pyramid = [coarser]
    for level in levels[-2::-1]:
        rows, columns = (np.arange(n) * m // n for n, m in zip(level.shape[:2], coarser.shape[:2], strict=True))
        weight = level[..., 3:]
        mean = level[..., :3] / np.maximum(weight, 1e-30)
        coarser = np.where(weight > 0, mean, coarser[rows[:, None], columns])
        pyramid.append(coarser)
    return pyramid[::-1]


def _halved(image: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the image with half as many rows (axis 0) or columns (axis 1), at least one."""
    count = image.shape[axis]
    half = count // 2
    if half == 0:
        return image
    image = np.moveaxis(image, axis, 0)
    even, odd = image[0 : 2 * half : 2], image[1 : 2 * half : 2]
    if count % 2 == 0:
        result = (even + odd) / 2
    else:
        k = np.arange(half, dtype=np.float32).reshape(-1, 1, 1)
        # three source texels for two, weighted so that each of them keeps the same share of the whole (a polyphase box filter)
        result = ((half - k) * even + half * odd + (k + 1) * image[2::2]) / count
    return np.ascontiguousarray(np.moveaxis(result.astype(np.float32), 0, axis))
