"""Texels as PNG and back, exactly; grey ones take one channel, opaque ones no opacity."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

MAX_PX = 1 << 26
"""Larger images (8192 x 8192) are refused, before anything is decoded."""


def png_bytes(pixels: NDArray[np.uint8], *, gray: bool = True) -> bytes:
    """The PNG of texels [H, W, 4]; the same texels give the same bytes. Raises `ValueError` above `MAX_PX`.

    Without ``gray`` there are three colour channels also where they are equal, as some programs show a single one as red.
    """
    from PIL import Image

    if pixels[..., 0].size > MAX_PX:
        raise ValueError(f"an image of {pixels.shape[1]} x {pixels.shape[0]} texels, the most are {MAX_PX}")
    gray = gray and bool((pixels[..., :1] == pixels[..., 1:3]).all())
    opaque = bool((pixels[..., 3] == 255).all())
    channels = ([0] if gray else [0, 1, 2]) + ([] if opaque else [3])
    kept = np.ascontiguousarray(pixels[..., channels[0]] if len(channels) == 1 else pixels[..., channels])
    file = io.BytesIO()
    Image.fromarray(kept).save(file, format="PNG", compress_level=3)
    return file.getvalue()


def png_pixels(data: bytes | memoryview) -> NDArray[np.uint8]:
    """The texels [H, W, 4] of a PNG. Raises `ValueError` if it is damaged, none, or larger than `MAX_PX`."""
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(data), formats=("PNG",))
        width, height = picture.size
        if not 0 < width * height <= MAX_PX:
            raise ValueError(f"it has {width} x {height} texels, the most are {MAX_PX}")
        return np.array(picture.convert("RGBA"))
    except Exception as fault:  # whatever its readers raise
        raise ValueError(f"a PNG that cannot be read ({type(fault).__name__}: {fault})") from None
