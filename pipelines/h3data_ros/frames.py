"""Exact conversion of poses between the frames of ROS (REP 103: x forward, y left, z up) and h3data (+Y up, z right).

The frames differ by 90 degrees about x, so numbers only change their order and signs, and no digit is lost.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import quat_from_axis_angle

FROM_WORLD = np.array([0, 0, 0, *quat_from_axis_angle([1.0, 0, 0], np.pi / 2)])
"""Pose [7] of h3data's world in the frame ``map``, and of an agent's root in ``base_footprint``: a rotation about x."""
_UNSAFE = re.compile(r"[^A-Za-z0-9_]+")


def pose_to_ros(pose: ArrayLike) -> NDArray[np.float64]:
    """Convert world poses [..., 7] to the frame ``map``: (x, y, z) becomes (x, -z, y), also for quaternions."""
    turned = np.asarray(pose, np.float64)[..., [0, 2, 1, 3, 5, 4, 6]]
    turned[..., [1, 4]] *= -1
    return turned


def pose_from_ros(pose: ArrayLike) -> NDArray[np.float64]:
    """Convert poses [..., 7] from the frame ``map`` to the world, the inverse of `pose_to_ros`."""
    turned = np.asarray(pose, np.float64)[..., [0, 2, 1, 3, 5, 4, 6]]
    turned[..., [2, 5]] *= -1
    return turned


def safe_names(names: Iterable[str], fallback: str) -> list[str]:
    """Return distinct names of letters, digits and underscores, for topics, frames and ids."""
    found: list[str] = []
    for name in names:
        base = _UNSAFE.sub("_", name).strip("_") or fallback
        unique, number = base, 1
        while unique in found:
            number += 1
            unique = f"{base}_{number}"
        found.append(unique)
    return found


def message_time(header: Any, t: int) -> int:
    """Return the stamp of a message [ns], or its time of recording ``t`` if it has none."""
    return (header.stamp.sec * 1_000_000_000 + header.stamp.nanosec) or t
