"""Skills at doors and drawers, for robots and people.

The module has the preconditions of these skills, the places to stand, and the motion of a part that a hand leads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from sim_kinematic.agents.opening.openables import ArticulatedParts, stands_clear
from sim_kinematic.agents.skills import Action

PATIENCE_STEPS, FRONT_M, AT_END = 45, 0.05, 0.02
"""Number of steps for which a part waits until an agent no longer blocks its movement; least distance in front of a handle from
which an agent opens its part, on the side to which the part comes [m]; share of its range within which a part counts as being
at an end."""


def why_not(openables: ArticulatedParts | None, agent: int, action: Action) -> str:
    """Return the reason why no agent could open or close a part now; empty if one could.

    Whether a hand reaches the handle is tested separately.
    """
    if openables is None or not 0 <= action.target < len(openables):
        return "no_joint"
    k, opens = action.target, action.skill == "open"
    share = float(openables.joints.shares(openables.positions)[k])
    if opens and share > 1 - AT_END:
        return "already_open"
    if not opens and share < AT_END:
        return "already_closed"
    hit = openables.hits_agent(k, openables.travel(k, opens=opens))
    if hit >= 0:
        return "too_near" if hit == agent else "blocked"
    return "obstructed" if openables.obstacle(k, opens=opens) else ""


def handle_path(openables: ArticulatedParts, k: int, way: NDArray[np.float64]) -> Array:
    """Return the world points [T, 3] of a handle with its joint at positions [T]."""
    positions = np.tile(openables.positions, (len(way), 1))
    positions[:, k] = way
    return openables.handles(positions)[:, k]


def full_travel(openables: ArticulatedParts, k: int) -> NDArray[np.float64]:
    """Return the positions of a joint from its present one to the farther end of its range."""
    share = float(openables.joints.shares(openables.positions)[k])
    return openables.travel(k, opens=share < 0.5)


def stands_before(
    openables: ArticulatedParts, k: int, stands: Array, offsets: Sequence[float], radius_m: float
) -> NDArray[np.bool_]:
    """Return whether each pose ``(x, z, heading)`` [N, 3] at a handle is suitable for moving its part, as bool [N].

    Suitable poses are in front of the part, on either side of a door, and out of the sweep of this part and of other
    parts that are open.
    """
    joint = openables.joints.parts[k][1].joint
    ends = handle_path(openables, k, np.array([joint.closed, joint.opened]))
    outward = (ends[1] - ends[0])[[0, 2]]
    outward /= max(float(np.hypot(*outward)), 1e-9)
    before = np.full(len(stands), k in openables.doors)
    before |= (stands[:, :2] - ends[0, [0, 2]]) @ outward > FRONT_M
    swept = openables.points(k, np.linspace(joint.closed, joint.opened, 12))[:, [0, 2]]
    points = np.concatenate([swept, openables.open_points()])
    return before & stands_clear(stands, points, offsets, radius_m)


class Leading:
    """Joint that a hand moves along its range step by step, and that waits for agents in its path."""

    def __init__(self, openables: ArticulatedParts, k: int, *, opens: bool) -> None:
        self.openables, self.k = openables, k
        self.way = openables.travel(k, opens=opens)
        self.handles = handle_path(openables, k, self.way)
        """Positions of the handle while the part moves, [T, 3]."""
        self._waited = 0

    @property
    def gave_up(self) -> bool:
        """Return whether an agent has blocked the part for too long."""
        return self._waited > PATIENCE_STEPS

    def advance(self, step: int) -> bool:
        """Move the part by one step; return False if an agent is in its path, so that it has not moved."""
        if self.openables.hits_agent(self.k, self.way[step : step + 1]) >= 0:
            self._waited += 1
            return False
        # counted in a row: whoever gets in the way later is waited for anew
        self._waited = 0
        self.openables.move(self.k, float(self.way[step]))
        return True
