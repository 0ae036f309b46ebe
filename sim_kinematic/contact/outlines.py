"""Outlines of people as a laser scanner near the floor measures them: two legs, each a circle."""

from __future__ import annotations

from typing import Any

import numpy as np

from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array

LEG_RADIUS_M, LEG_HEIGHT_M = 0.06, 0.3
"""Radius of a shin with trousers, and height of the plane in which legs are cut [m]. Scanners of mobile robots are 0.1
to 0.4 m high."""
_KNEES, _ANKLES = ([JOINT_INDEX[f"{side}_{joint}"] for side in ("left", "right")] for joint in ("knee", "ankle"))


def shins(joints: Array) -> Array:
    """Return the centres ``(x, z)`` of the left and the right leg 0.3 m above the floor, [T, 2, 2] [m].

    Args:
        joints: Frames of the joints in that of the root, [T, 55, 4, 4] (`Humanoid.joint_matrices`).
    """
    knee, ankle = joints[:, _KNEES][..., :3, 3], joints[:, _ANKLES][..., :3, 3]
    # a knee that is not above its ankle must not make the share infinite
    rise = np.maximum(knee[..., 1:2] - ankle[..., 1:2], 1e-6)
    share = np.clip((LEG_HEIGHT_M - ankle[..., 1:2]) / rise, 0.0, 1.0)
    return (ankle + share * (knee - ankle))[..., [0, 2]]


def legs_at(xp: Any, xz: Any, heading: Any, legs: Any) -> Any:
    """Return legs [W, 2, 2], given in the frames of roots, as circles ``(x, z, radius)`` in the world, [W, 2, 3] [m].

    ``xp`` is numpy or torch: scanners on the CPU and on a device share the formula.
    """
    cos, sin = xp.cos(heading)[:, None], xp.sin(heading)[:, None]
    x = xz[:, :1] + legs[..., 0] * cos + legs[..., 1] * sin
    z = xz[:, 1:] - legs[..., 0] * sin + legs[..., 1] * cos
    return xp.stack([x, z, xp.full_like(x, LEG_RADIUS_M)], -1)
