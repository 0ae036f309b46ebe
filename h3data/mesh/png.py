"""Lossless conversion of texels to PNG and back; grey images take one channel, and opaque images no alpha channel."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

MAX_PX = 1 << 26
"""Limit of texels (8192 x 8192); larger images are refused before anything is decoded."""


def png_bytes(pixels: NDArray[np.uint8], *, gray: bool = True) -> bytes:
    """Return the PNG of texels [H, W, 4]; the same texels give the same bytes. Raises `ValueError` above `MAX_PX`.

    If ``gray`` is False, grey images have three channels too, because some programs display a single channel as red.
    """
    from PIL import Image

    if pixels[..., 0].size > MAX_PX:
        raise ValueError(f"an image of {pixels.shape[1]} x {pixels.shape[0]} texels, the limit is {MAX_PX}")
    gray = gray and bool((pixels[..., :1] == pixels[..., 1:3]).all())
    opaque = bool((pixels[..., 3] == 255).all())
    channels = ([0] if gray else [0, 1, 2]) + ([] if opaque else [3])
    # Pillow knows an image of one channel by its two axes
    kept = np.ascontiguousarray(pixels[..., channels[0]] if len(channels) == 1 else pixels[..., channels])
    file = io.BytesIO()
    Image.fromarray(kept).save(file, format="PNG", compress_level=3)
    return file.getvalue()


def png_pixels(data: bytes | memoryview) -> NDArray[np.uint8]:
    """Return the texels [H, W, 4] of a PNG.

    Raises `ValueError` if it is not a PNG, damaged, or larger than `MAX_PX`.
    """
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(data), formats=("PNG",))
        width, height = picture.size
        if not 0 < width * height <= MAX_PX:
            raise ValueError(f"it has {width} x {height} texels, the limit is {MAX_PX}")
        return np.array(picture.convert("RGBA"))
    except Exception as fault:  # Pillow's readers raise many types
        raise ValueError(f"a PNG that cannot be read ({type(fault).__name__}: {fault})") from None
