"""Observations of learned policies of rearrangement, computed from a `RearrangeView` by the rows of the table of sensors.

The observations are the same for training environments and for policies from a file
(`sim_kinematic.sensing.table.SENSES`). Pictures are computed by `sim_kinematic.sensing.agent_pictures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
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


class RearrangeContext:
    """Views of one agent in W worlds of rearrangement, as a `sim_kinematic.sensing.table.Context`."""

    xp = np

    def __init__(self, views: Sequence[RearrangeView]) -> None:
        self._views, self.agent = views, views[0].agent
        self.arm, self.held_by, self.at_goal = self._all("arm"), self._all("held_by"), self._all("at_goal")
        self.objects, self.starts, self.goals = self._all("objects"), self._all("starts"), self._all("goals")
        self.contact, self.touching, self.close = self._all("contact"), self._all("collision"), self._all("close")
        self.open_parts, self.handles = self._all("open_parts"), self._all("handles")
        self.steps, before, start = self._all("step"), self._all("before"), self._all("start")
        self.now = Pose(self._all("xz"), self._all("heading"))
        self.before, self.start = (Pose(pose[:, :2], pose[:, 2]) for pose in (before, start))
        # the newest place but one; at the start there is one place only, so the other has not moved
        was = np.array([view.other_track[-2:][0] for view in views])
        self.other, self.other_before = Pose(self._all("other_xz"), None), Pose(was, None)

    def _all(self, field: str) -> NDArray:
        """Return a field of all views, [W, ...]; that of a single view is no copy, which takes a third of the time."""
        if len(self._views) == 1:
            return np.asarray(getattr(self._views[0], field))[None]
        return np.array([getattr(view, field) for view in self._views])

    @property
    def is_alone(self) -> bool:
        """Return whether there are no other agents."""
        return not np.isfinite(self._views[0].other_xz[0])

    @cached_property
    def _hand(self) -> Array:
        """Poses (pose7) of the hands in the world, computed at the first use, as few observations need them, [W, 7]."""
        return np.array([view.hand() for view in self._views])

    def floor_y(self) -> Array:
        """Return the height of the floor where the agent is, [W] [m]."""
        return np.array([view.free.height_at(view.xz) for view in self._views])

    def in_hand(self, points: Array) -> Array:
        """Return world points [W, n, 3] in the frames of the hands."""
        return in_frame(self._hand, points)

    def from_start(self, points: Array) -> Array:
        """Return world points [W, n, 3] in the agent root frames of the starts."""
        return in_frame(np.array([v.free.root_pose(v.start[:2], v.start[2]) for v in self._views]), points)

    def other_root(self) -> Array:
        """Return the roots of the other agents in the world [W, 3] [m]."""
        return np.array([view.free.root_pose(view.other_xz, 0.0)[:3] for view in self._views])

    def ways(self, end: Literal["objects", "goals"], *, other: bool, then: bool = False) -> Array:
        """Return the lengths of the shortest paths from the agent or the other agent to objects or goals, [W, K] [m].

        With ``then``, paths start at the first position of the other agent's known track. Objects and goals lie on
        furniture, so the ends of the paths are moved to the free floor.
        """
        found = []
        for view in self._views:
            points = view.objects if end == "objects" else view.goals
            start = view.other_track[0] if then else view.other_xz if other else view.xz
            ends = np.broadcast_to(start, (len(points), 2)), points[:, [0, 2]]
            found.append(view.free.geodesic(*ends, max_snap_m=SNAP_M))
        # no path is infinite, and a network takes finite numbers
        return np.minimum(np.array(found), FAR_M)

    def ahead(self, *, other: bool) -> Array:
        """Return the points that an agent would reach after `AHEAD_M` on its path to each object, [W, K, n, 2] [m].

        For an object in its hand, the path leads to the object's goal. Paths to objects in another agent's hand are straight
        lines.
        """
        found = []
        for view in self._views:
            xz, hands = view.other_xz if other else view.xz, view.held_by
            own = (hands != NOBODY) & (hands != view.agent) if other else hands == view.agent
            for k in range(len(hands)):
                end = (view.goals if own[k] else view.objects)[k, 0:3:2]
                if own[k] or hands[k] == NOBODY:
                    found.append(path_points(view.free, xz, end, AHEAD_M, max_snap_m=SNAP_M))
                else:
                    gap = end - xz
                    found.append(xz + gap * np.minimum(np.array(AHEAD_M) / max(np.hypot(*gap), 1e-9), 1.0)[:, None])
        return np.array(found).reshape((*self.held_by.shape, len(AHEAD_M), 2))

    def ended(self, outcome: Ending) -> Array:
        """Return a number for each of `choices`: 1 for the agent's last one, if it ended with this outcome, [W, C]."""
        # only robots have joints of an arm to observe
        robot, objects = self.arm.shape[1] > 0, self.objects.shape[1]
        found = np.zeros((len(self._views), len(choices(objects, robot=robot, parts=self._views[0].parts))))
        for own, view in zip(found, self._views, strict=True):
            known = choices(objects, robot=robot, parts=view.parts)
            if view.last is not None and view.last.outcome == outcome and view.action in known:
                own[known.index(view.action)] = 1.0
        return found


def observe(view: RearrangeView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """Return the named observations, each [n] float32 and within its `limits`."""
    shown = {}
    for name, (values,) in exact([view], names).items():
        low, high = (np.tile(side, len(values) // SENSES[name].width) for side in (SENSES[name].low, SENSES[name].high))
        shown[name] = values.clip(low, high).astype(np.float32)
    return shown


def exact(
    views: Sequence[RearrangeView], names: Sequence[str], sensors: Mapping[str, Sensor] = SENSES
) -> dict[str, Array]:
    """Return the exact values of the named observations in W worlds, each [W, n]; those of a missing agent are 0."""
    moment, lone = RearrangeContext(views), None
    found = {}
    for name in names:
        if sensors[name].of_other and moment.is_alone:
            # only their lengths are needed, of which the limits know
            lone = lone or limits(
                sensors, objects=moment.objects.shape[1], arm=moment.arm.shape[1], parts=moment.open_parts.shape[1]
            )
            found[name] = np.zeros((len(views), *lone[name].shape))
        else:
            # a copy, as the moment may hold the agent's own arrays
            found[name] = np.array(sensors[name].of(moment), np.float64)
    return found


def limits(sensors: Mapping[str, Sensor] = SENSES, *, objects: int, arm: int, parts: int = 0) -> dict[str, Limits]:
    """Return the limits of all observations except pictures by name, for an agent with ``arm`` joints (people: 0)."""
    known = choices(objects, robot=arm > 0, parts=tuple(range(parts)))
    counts = {"once": 1, "objects": objects, "joints": arm, "choices": len(known), "parts": parts}
    return {name: sensor.limits(counts[sensor.times]) for name, sensor in sensors.items() if counts[sensor.times]}
