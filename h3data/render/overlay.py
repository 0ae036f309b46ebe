"""Lines, dots and labels on an image at world points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera

Color = tuple[int, int, int]

_NEAR_M = 0.01
_SUBPIXEL_BITS = 4
_FAR_PX = 1 << 20
"""Distance from the origin at which lines are clipped, so that OpenCV's integers do not overflow [px]."""


def draw_polyline(
    image: NDArray[np.uint8], camera: Camera, points: ArrayLike, color: Color, thickness: int = 2
) -> None:
    """Draw the line through world points [N, 3] [m] onto ``image`` [H, W, 3]; NaN points interrupt it.

    The line is clipped behind the camera but not occluded by the scene.
    """
    import cv2

    _check(image, camera)
    p = camera.to_camera(points)
    if len(p) and np.isfinite(p).all() and p[:, 2].min() >= _NEAR_M:
        pixels = camera.to_pixels(p)
        if np.abs(pixels).max() < _FAR_PX:  # nothing to clip: one call draws the whole line
            line = [_fixed(pixels)[:, None]]
            cv2.polylines(image, line, False, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
            return
    for start, end in pairwise(p):
        if not (np.isfinite(start).all() and np.isfinite(end).all()) or max(start[2], end[2]) < _NEAR_M:
            continue
        # in space first: what is behind the eye has no pixel that a line on the screen could be cut at
        ends = np.stack([_clip_to_front(start, end), _clip_to_front(end, start)])
        pixels = _clip_to_square(camera.to_pixels(ends))
        if pixels is not None:
            a, b = ((int(x), int(y)) for x, y in _fixed(pixels))
            cv2.line(image, a, b, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _clip_to_front(point: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``point``, moved along the line to ``other`` until it is in front of the camera."""
    if point[2] >= _NEAR_M:
        return point
    return point + (other - point) * ((_NEAR_M - point[2]) / (other[2] - point[2]))


def _fixed(pixels: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return OpenCV's fixed-point coordinates, which count from the centre of the first pixel."""
    return np.rint((pixels - 0.5) * (1 << _SUBPIXEL_BITS)).astype(np.int32)


def _clip_to_square(pixels: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the part of a line [2, 2] within +-`_FAR_PX` (Liang & Barsky 1984); None if there is none."""
    start, step = pixels[0], pixels[1] - pixels[0]
    low, high = 0.0, 1.0
    for axis in range(2):
        for sign in (1.0, -1.0):
            distance, speed = _FAR_PX - sign * start[axis], sign * step[axis]
            # parallel to this side and beyond it
            if speed == 0 and distance < 0:
                return None
            if speed > 0:
                high = min(high, distance / speed)
            elif speed < 0:
                low = max(low, distance / speed)
    return np.stack([start + low * step, start + high * step]) if low < high else None


def pixel_of(image: NDArray[np.uint8], camera: Camera, point: ArrayLike) -> tuple[int, int] | None:
    """Return the pixel (column, row) of a world point [3] [m]; None if it is behind the camera or far outside of the image."""
    _check(image, camera)
    pixels, z = camera.project(np.asarray(point, np.float64).reshape(1, 3))
    # written so that NaN counts as behind the camera
    if not z[0] > _NEAR_M or not np.isfinite(pixels).all() or np.abs(pixels).max() > _FAR_PX:
        return None
    return int(np.floor(pixels[0, 0])), int(np.floor(pixels[0, 1]))


def _check(image: NDArray[np.uint8], camera: Camera) -> None:
    if image.shape != (camera.height, camera.width, 3) or image.dtype != np.uint8 or not image.flags.c_contiguous:
        raise InputError(
            f"Expected a contiguous uint8 image [{camera.height}, {camera.width}, 3] of this camera, "
            f"got {image.dtype} {list(image.shape)}.",
            code="H3-RENDER-049",
        )
