"""Colour maps for depth and ids, and depth normalised as in Habitat's observations."""

from __future__ import annotations

import colorsys
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.kernels import kernel

MISS_COLOR = (18, 18, 22)
"""Colour of pixels without a surface."""
_PALETTE_SIZE = 1024


def normalize_depth(depth: ArrayLike, min_m: float, max_m: float) -> NDArray[np.float32]:
    """Clip depth to ``min_m..max_m`` and scale it to 0..1, like Habitat's depth sensor (spec/habitat.md 1.5).

    A miss has depth 0 and becomes 0, as in Habitat.
    """
    _check_range(min_m, max_m)
    d = np.clip(np.asarray(depth, np.float32), np.float32(min_m), np.float32(max_m))
    return ((d - np.float32(min_m)) / np.float32(max_m - min_m)).astype(np.float32)


def depth_to_rgb(depth: ArrayLike, near: float, far: float) -> NDArray[np.uint8]:
    """Color depth [H, W] [m] by viridis, [H, W, 3]: yellow up to ``near``, violet from ``far``, misses `MISS_COLOR`."""
    _check_range(near, far)
    d = np.ascontiguousarray(depth, np.float32)
    out = np.empty((*d.shape, 3), np.uint8)
    _paint_depth(d.ravel(), np.float32(near), np.float32(far), _depth_palette(), out.reshape(-1, 3))
    return out


def instance_to_rgb(ids: ArrayLike) -> NDArray[np.uint8]:
    """Color ids [...] distinctly, [..., 3]: equal ids always get equal colours; negative ids get `MISS_COLOR`."""
    i = np.ascontiguousarray(ids)
    if i.dtype.kind not in "iu":
        raise InputError(f"Ids must be integers, got {i.dtype}.", code="H3-RENDER-010")
    out = np.empty((*np.shape(ids), 3), np.uint8)
    _paint_ids(i.ravel(), _palette(), out.reshape(-1, 3))
    return out


@kernel(boundscheck=False)
def _paint_depth(depth, near, far, palette, out):
    scale = np.float32(255) / (far - near)
    for k in range(len(depth)):
        d = depth[k]
        level = 256
        # false for NaN too, which is coloured as a miss
        if d > 0:
            level = 255 - int((min(max(d, near), far) - near) * scale + np.float32(0.5))
        out[k, 0], out[k, 1], out[k, 2] = palette[level, 0], palette[level, 1], palette[level, 2]


@kernel(boundscheck=False)
def _paint_ids(ids, palette, out):
    for k in range(len(ids)):
        place = ids[k] % _PALETTE_SIZE if ids[k] >= 0 else _PALETTE_SIZE
        out[k, 0], out[k, 1], out[k, 2] = palette[place, 0], palette[place, 1], palette[place, 2]


@lru_cache(maxsize=1)
def _depth_palette() -> NDArray[np.uint8]:
    """Return the palette viridis from far to near, followed by `MISS_COLOR`, shape [257, 3]."""
    import cv2

    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    return np.concatenate([np.asarray(bgr, np.uint8)[:, 0, ::-1], np.array([MISS_COLOR], np.uint8)])


@lru_cache(maxsize=1)
def _palette() -> NDArray[np.uint8]:
    """Return colours by id, followed by `MISS_COLOR`, shape [1025, 3].

    Hues advance in steps of the golden ratio with alternating saturation and brightness, so that neighbouring ids
    differ clearly.
    """
    colors = [
        colorsys.hsv_to_rgb((0.13 + 0.6180339887 * k) % 1, (0.55, 0.8, 0.4)[k % 3], (0.95, 0.8, 0.65, 0.9)[k % 4])
        for k in range(_PALETTE_SIZE)
    ]
    return np.concatenate([np.rint(255 * np.array(colors)), np.array([MISS_COLOR])]).astype(np.uint8)


def _check_range(near: float, far: float) -> None:
    if not (np.isfinite(near) and np.isfinite(far) and near < far):
        raise InputError(f"Expected a depth range with near < far, got {near!r} and {far!r}.", code="H3-RENDER-011")
