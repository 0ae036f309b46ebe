"""Depth and ids as pictures, and depth as Habitat's observation."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError

MISS_COLOR = (18, 18, 22)
_PALETTE_SIZE = 1024


def normalize_depth(depth: ArrayLike, min_m: float, max_m: float) -> NDArray[np.float32]:
    """Depth clipped to ``min_m..max_m`` and scaled to 0..1, as Habitat's depth sensor (spec/habitat.md 1.5).

    A miss has depth 0 and therefore becomes 0, as there.
    """
    _check_range(min_m, max_m)
    d = np.clip(np.asarray(depth, np.float32), np.float32(min_m), np.float32(max_m))
    return ((d - np.float32(min_m)) / np.float32(max_m - min_m)).astype(np.float32)


def depth_to_rgb(depth: ArrayLike, near: float, far: float) -> NDArray[np.uint8]:
    """Depth [H, W] [m] as colours [H, W, 3] (viridis): ``near`` and less is yellow, ``far`` violet, a miss nearly black."""
    import cv2

    d = np.asarray(depth, np.float32)
    _check_range(near, far)
    levels = np.rint(255 * (1 - normalize_depth(d, near, far))).astype(np.uint8)
    bgr = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), np.uint8)
    rgb = np.ascontiguousarray(bgr[..., ::-1])
    rgb[~(d > 0)] = MISS_COLOR
    return rgb


def instance_to_rgb(ids: ArrayLike) -> NDArray[np.uint8]:
    """Distinct colours [..., 3] of ids [...]: the same id always has the same colour; negative ids are nearly black."""
    i = np.asarray(ids)
    if i.dtype.kind not in "iu":
        raise InputError(f"Ids must be integers, got {i.dtype}.")
    return np.where((i < 0)[..., None], np.array(MISS_COLOR, np.uint8), _palette()[i % _PALETTE_SIZE]).astype(np.uint8)


def _palette() -> NDArray[np.uint8]:
    """Hues by steps of the golden ratio, with saturation and brightness in turns, shape [1024, 3]."""
    colors = [
        colorsys.hsv_to_rgb((0.13 + 0.6180339887 * k) % 1, (0.55, 0.8, 0.4)[k % 3], (0.95, 0.8, 0.65, 0.9)[k % 4])
        for k in range(_PALETTE_SIZE)
    ]
    return np.rint(255 * np.array(colors)).astype(np.uint8)


def _check_range(near: float, far: float) -> None:
    if not (np.isfinite(near) and np.isfinite(far) and near < far):
        raise InputError(f"Expected a depth range with near < far, got {near!r} and {far!r}.")
