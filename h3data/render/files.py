"""Pictures in files."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.files import part_file

MAX_DEPTH_MM = 65535


def write_png(path: str | os.PathLike[str], image: NDArray) -> None:
    """Write RGB uint8 [H, W, 3] or grey uint8 / uint16 [H, W] as PNG."""
    import cv2

    is_rgb = image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8
    is_grey = image.ndim == 2 and image.dtype in (np.uint8, np.uint16)
    if not (is_rgb or is_grey) or image.size == 0:
        raise InputError(
            f"A PNG needs uint8 [H, W, 3] or uint8 / uint16 [H, W], got {image.dtype} {list(image.shape)}."
        )
    ok, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]) if is_rgb else image)
    if not ok:
        raise InputError(f"OpenCV could not encode an image of shape {list(image.shape)} as PNG.")
    with part_file(path) as part:
        part.write_bytes(data.tobytes())


def write_jpg(path: str | os.PathLike[str], image: NDArray[np.uint8], *, quality: int = 90) -> None:
    """Write RGB uint8 [H, W, 3] as JPEG."""
    import cv2

    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(f"A JPEG needs uint8 [H, W, 3], got {image.dtype} {list(image.shape)}.")
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise InputError(f"OpenCV could not encode an image of shape {list(image.shape)} as JPEG.")
    with part_file(path) as part:
        part.write_bytes(data.tobytes())


def write_depth_png(path: str | os.PathLike[str], depth: NDArray[np.floating]) -> None:
    """Write depth [H, W] [m] as 16-bit PNG in millimetres; 0 = nothing hit, 65535 = 65.5 m or more."""
    d = np.asarray(depth)
    if d.ndim != 2 or d.dtype.kind != "f":
        raise InputError(f"Expected depth as floats [H, W] in metres, got {d.dtype} {list(d.shape)}.")
    millimetres = np.clip(np.rint(np.nan_to_num(d.astype(np.float64)) * 1000), 0, MAX_DEPTH_MM)
    write_png(path, np.where((d > 0) & (millimetres == 0), 1, millimetres).astype(np.uint16))
