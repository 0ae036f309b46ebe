"""Conversion of irradiance to displayed colours, by a curve that keeps dark corners readable and bright ones in range."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.render.shade.blockers_simd import DARKEST
from h3data.render.shade.shading import Light

_MEAN = 0.56
"""Light on a surface of mean brightness, about that of the flat light."""
_EXPONENT, _SHOULDER, _BRIGHTEST = 0.8, 1.05, 1.75
"""Exponent of the curve that maps light to brightness in pictures, where it bends, and its limit, in units of
`_MEAN`."""
_TINT = 0.55
"""Share of the light's own colour; eyes and cameras adapt to the rest."""


def shown_light(irradiance: Any, mean: Any, xp: Any = np) -> Any:
    """Return the displayed colour of a white surface under irradiance [..., 3], linear RGB [..., 3].

    ``mean`` is the mean irradiance of the home. ``xp`` is the namespace of the arrays: NumPy or PyTorch.
    """
    amount = irradiance.mean(-1, keepdims=True)
    tint = 1 + _TINT * (irradiance / amount.clip(1e-9) - 1)
    curve = DARKEST + (1 - DARKEST) * (amount / mean) ** _EXPONENT
    above, room = (curve - _SHOULDER).clip(0), _BRIGHTEST - _SHOULDER
    curve = curve.clip(None, _SHOULDER) + room * (1 - xp.exp(-above / room))
    return _MEAN * curve * tint


def flat_light(light: Light, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the flat light on surfaces with world normals [V, 3], without the camera light, linear RGB [V, 3]."""
    sky, ground = np.array(light.sky), np.array(light.ground)
    sun, fill = (normals @ normalized(np.array(d)) for d in (light.sun_direction, light.fill_direction))
    out = (sky + ground) / 2 + (sky - ground) / 2 * normals[:, 1:2]
    return out + np.maximum(sun, 0)[:, None] * light.sun + np.maximum(fill, 0)[:, None] * light.fill
