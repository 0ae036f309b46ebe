"""Conversion between sRGB and linear light (IEC 61966-2-1).

Colours are stored as sRGB; arithmetic uses linear light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def srgb_to_linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Convert sRGB values 0..1 to linear light 0..1; values outside are clipped."""
    x = np.clip(np.asarray(srgb, np.float64), 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: ArrayLike) -> NDArray[np.float64]:
    """Return sRGB values 0..1 of linear light 0..1; values outside are clipped."""
    x = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def bytes_to_linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Convert sRGB bytes to linear light 0..1."""
    return srgb_to_linear(np.asarray(srgb, np.float64) / 255)


def linear_to_bytes(linear: ArrayLike) -> NDArray[np.uint8]:
    """Return the sRGB bytes nearest to linear light 0..1."""
    # rounded, so that bytes survive the way to linear light and back
    return np.rint(255 * linear_to_srgb(linear)).astype(np.uint8)
