"""Lights for habitat-sim with which its pictures of h3data's homes resemble those of h3data.

habitat-sim's ``material`` shader has no ambient light, so that surfaces without a light in front of them are black,
especially ceilings. Therefore there is one directional light in both directions of each axis, as strong as the light of
h3data's renderer on a surface that faces it. The shader works on sRGB values as they are (``map_mat_txtr_to_linear``
and ``map_output_to_srgb`` are off by default), h3data's renderer on linear light, so that colours are raised to a
power. Occlusion and the camera's headlight have no counterpart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized
from h3data.render.shade.shading import Light

SHADER = "material"
"""Value of ``shader_type`` in exports, which selects glTF's materials. ``phong`` has no counterpart of roughness and
gives highlights.
"""
_GAMMA = 2.2
_AXES = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]


def axis_lights() -> list[tuple[list[float], list[float]]]:
    """Return the direction in which each light travels, and its sRGB colour multiplied by its intensity."""
    return [([float(-v) for v in axis], color) for axis, color in zip(_AXES, _colors().round(4).tolist(), strict=True)]


def _colors() -> NDArray[np.float64]:
    """Return sRGB light [6, 3] of our renderer on surfaces that face along `_AXES`."""
    light, normals = Light(), np.array(_AXES, np.float64)
    # light of sky and ground, mixed by how much the surface faces either
    up = (normals[:, 1:2] + 1) / 2
    linear = up * np.array(light.sky) + (1 - up) * np.array(light.ground)
    for color, direction in ((light.sun, light.sun_direction), (light.fill, light.fill_direction)):
        facing = np.maximum(normals @ normalized(np.array(direction, np.float64)), 0)
        linear = linear + facing[:, None] * np.array(color)
    return np.clip(linear, 0, 1) ** (1 / _GAMMA)


def light_setup() -> dict[str, Any]:
    """Return the content of a ``*.lighting_config.json``."""
    return {
        "lights": {
            str(k): {"type": "directional", "direction": direction, "intensity": 1.0, "color": color}
            for k, (direction, color) in enumerate(axis_lights())
        }
    }


def replay_lights() -> list[dict[str, Any]]:
    """Return the lights of a scene as the ``lights`` of a gfx-replay keyframe."""
    # a fourth number of 0 marks a direction
    return [{"vector": [*direction, 0.0], "color": color, "model": "global"} for direction, color in axis_lights()]
