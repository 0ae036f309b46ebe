"""Predicates on states, as pure functions on arrays with any leading axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim_kinematic.motion.spec import SocialNavSpec


def is_object_at(position: Any, goal: Any, *, distance_m: float = 0.3, xp: Any = np) -> Any:
    """Return whether objects [..., 3] are within a distance [m] of goals [..., 3], as Habitat's ``object_at``.

    Positions are arrays, or tensors if ``xp`` is torch.
    """
    if xp is np:
        position, goal = np.asarray(position, np.float64), np.asarray(goal, np.float64)
    gap = position - goal
    # strictly nearer, in three dimensions, as Habitat's object_at
    return xp.sqrt((gap * gap).sum(-1)) < distance_m


def is_found(geodesic_m: Any, facing_dot: Any, spec: SocialNavSpec) -> Any:
    """Return whether the robot faces the person at the right distance (paper section 4.1), arrays or tensors [...]."""
    # both bounds are in, as in Habitat's statistics; its reward and success leave out the upper one
    return (geodesic_m >= spec.near_m) & (geodesic_m <= spec.far_m) & (facing_dot > spec.facing_dot)
