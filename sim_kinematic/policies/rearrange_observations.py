"""Observations of learned policies of rearrangement, computed from a `RearrangeView` by the rows of the table of sensors.

They are the same for training environments and for policies from a file: `sim_kinematic.sensing.table.SENSES`. Pictures are
computed by `sim_kinematic.sensing.agent_pictures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_kinematic.agents.skills import choices
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.sensing.agent_pictures import Limits
from sim_kinematic.sensing.sensor import FAR_M, in_frame, path_points
from sim_kinematic.sensing.table import (
    AHEAD_M,
    HABITAT_SENSES,
    PAPER_SENSES,
    SENSES,
    STATE_SENSES,
    Ending,
    Pose,
    Sensor,
)

__all__ = ["HABITAT_SENSES", "PAPER_SENSES", "SENSES", "STATE_SENSES", "RearrangeContext", "exact", "limits", "observe"]
SNAP_M = 2.0
"""Largest distance of an object or a goal from the floor to which its end of a path is moved [m]."""
Floats = NDArray[np.floating]


class RearrangeContext:
    """View of rearrangement as a `sim_kinematic.sensing.table.Context` of one world."""

    xp = np

    def __init__(self, view: RearrangeView) -> None:
        self._view = view
        self.agent, self.arm, self.held_by, self.at_goal = view.agent, view.arm, view.held_by, view.at_goal
        self.objects, self.starts, self.goals = view.objects, view.starts, view.goals
        self.contact, self.touching, self.close = view.contact, view.collision, np.asarray(view.close)
        self.steps = np.asarray(view.step)
        self.now = Pose(view.xz, np.asarray(view.heading))
        self.before, self.start = (Pose(pose[:2], pose[2]) for pose in (view.before, view.start))
        # the newest place but one; at the start there is one place only, so the other has not moved
        self.other, self.other_before = Pose(view.other_xz, None), Pose(view.other_track[-2:][0], None)

    @property
    def is_alone(self) -> bool:
        """Return whether there is no other agent."""
        return not np.isfinite(self._view.other_xz).all()

    @cached_property
    def _hand(self) -> Floats:
        """Pose (pose7) of the hand in the world, computed at its first use, as few observations need it."""
        return self._view.hand()

    def floor_y(self) -> Floats:
        """Return the height of the floor where the agent is, [] [m]."""
        return self._view.free.height_at(self.now.xz)

    def in_hand(self, points: Floats) -> Floats:
        """Return world points [n, 3] in the frame of the hand."""
        return in_frame(self._hand, points)

    def from_start(self, points: Floats) -> Floats:
        """Return world points [n, 3] in the agent root frame of the start."""
        return in_frame(self._view.free.root_pose(self.start.xz, self.start.heading), points)

    def other_root(self) -> Floats:
        """Return the root of the other agent in the world [3] [m]."""
        return self._view.free.root_pose(self.other.xz, 0.0)[:3]

    def ways(self, end: Literal["objects", "goals"], *, other: bool, then: bool = False) -> Floats:
        """Return lengths of the shortest paths from the agent or the other to objects or goals, [K] [m].

        With ``then`` from the first position of the other's known track. Objects and goals lie on furniture, so the ends of the
        paths are moved to the free floor.
        """
        view, points = self._view, self.objects if end == "objects" else self.goals
        start = view.other_track[0] if then else view.other_xz if other else view.xz
        ends = np.broadcast_to(start, (len(points), 2)), points[:, [0, 2]]
        # no path is infinite, and a network takes finite numbers
        return np.minimum(view.free.geodesic(*ends, max_snap_m=SNAP_M), FAR_M)

    def ahead(self, *, other: bool) -> Floats:
        """Return points that an agent would reach after `AHEAD_M` on its path to each object, [K, n, 2] [m].

        For an object in its hand, the path leads to the object's goal. Paths to objects in another agent's hand are straight
        lines.
        """
        view, hands = self._view, self.held_by
        xz = view.other_xz if other else view.xz
        own = (hands != NOBODY) & (hands != view.agent) if other else hands == view.agent
        found = []
        for k in range(len(hands)):
            end = (view.goals if own[k] else view.objects)[k, 0:3:2]
            if own[k] or hands[k] == NOBODY:
                found.append(path_points(view.free, xz, end, AHEAD_M, max_snap_m=SNAP_M))
            else:
                gap = end - xz
                found.append(xz + gap * np.minimum(np.array(AHEAD_M) / max(np.hypot(*gap), 1e-9), 1.0)[:, None])
        return np.array(found)

    def ended(self, outcome: Ending) -> Floats:
        """Return the number for each of `choices`: 1 for the agent's last one, if it ended in this way, [C]."""
        view = self._view
        # only robots have joints of an arm to observe
        known = choices(len(view.objects), robot=len(view.arm) > 0)
        found = np.zeros(len(known))
        if view.last is not None and view.last.outcome == outcome and view.action in known:
            found[known.index(view.action)] = 1.0
        return found


def observe(view: RearrangeView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """Return the named observations, each [n] float32 and within its `limits`."""
    shown = {}
    for name, values in exact(view, names).items():
        low, high = (np.tile(side, len(values) // SENSES[name].width) for side in (SENSES[name].low, SENSES[name].high))
        shown[name] = values.clip(low, high).astype(np.float32)
    return shown


def exact(
    view: RearrangeView, names: Sequence[str], sensors: Mapping[str, Sensor] = SENSES
) -> dict[str, NDArray[np.float64]]:
    """Return the named observations as they are, each [n]; of the other agent zeros if there is none."""
    moment, lone = RearrangeContext(view), None
    found = {}
    for name in names:
        if sensors[name].of_other and moment.is_alone:
            # only their lengths are needed, of which the limits know
            lone = lone or limits(sensors, objects=len(view.objects), arm=len(view.arm))
            found[name] = np.zeros(lone[name].shape)
        else:
            found[name] = np.asarray(sensors[name].of(moment), np.float64)
    return found


def limits(sensors: Mapping[str, Sensor] = SENSES, *, objects: int, arm: int) -> dict[str, Limits]:
    """Return limits of all observations but pictures by name, for an agent with ``arm`` joints (0: a person)."""
    counts = {"once": 1, "objects": objects, "joints": arm, "choices": len(choices(objects, robot=arm > 0))}
    return {name: sensor.limits(counts[sensor.times]) for name, sensor in sensors.items() if counts[sensor.times]}
