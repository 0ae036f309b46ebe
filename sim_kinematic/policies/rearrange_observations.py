"""Observations of learned policies of rearrangement, as named numbers computed from a `RearrangeView`.

They are the same for training environments and for policies from a file. Places are (distance [m], angle [rad],
positive to the RIGHT) from the agent's base; ``(x, y, z)`` [m] in the frame of its hand, as Habitat's sensors of the
same names (spec/habitat.md 2.5); or in the agent root frame at the start. Pictures are computed by
`sim_kinematic.sensing.agent_pictures`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_kinematic.agents.skills import choices
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.sensing.agent_pictures import Limits
from sim_kinematic.sensing.sensor import (
    FAR_M,
    FAST,
    egomotion,
    gps_compass,
    humanoid_velocity,
    in_frame,
    localization,
    localization_in_start_frame,
    other_agent_gps,
    path_points,
)

SNAP_M = 2.0
"""The floor is at most this far from an object or a goal."""
NEARER_M = 3.0
"""Nobody gets nearer to anything by more than this in a second."""
AHEAD_M = (1.0, 2.5)
"""``path_ahead`` tells where the shortest path is after so much of it: what a hurrying agent walks in 0.4 s and in a second."""
Floats = NDArray[np.floating]
Times = Literal["once", "objects", "joints", "choices"]


class Sense(NamedTuple):
    """A named observation."""

    of: Callable[[RearrangeView], Floats]
    low: tuple[float, ...]
    """Least values of one unit of it, so many numbers,"""
    high: tuple[float, ...]
    """and the greatest ones."""
    times: Times
    """How often the unit is repeated."""


def _gps(points: Callable[[RearrangeView], Floats]) -> Sense:
    return Sense(
        lambda view: gps_compass(view.xz, view.heading, points(view)[:, 0:3:2]),
        (0.0, -np.pi),
        (FAR_M, np.pi),
        "objects",
    )


def _in_hand(points: Callable[[RearrangeView], Floats]) -> Sense:
    return Sense(lambda view: in_frame(view.hand(), points(view)), (-FAR_M,) * 3, (FAR_M,) * 3, "objects")


def _from_start(points: Callable[[RearrangeView], Floats]) -> Sense:
    return Sense(lambda view: in_frame(_start_pose(view), points(view)), (-FAR_M,) * 3, (FAR_M,) * 3, "objects")


def _start_pose(view: RearrangeView) -> Floats:
    return view.free.root_pose(view.start[:2], view.start[2])


def _other_from_start(view: RearrangeView) -> Floats:
    return in_frame(_start_pose(view), view.free.root_pose(view.other_xz, 0.0)[None, :3])


def _flags(of: Callable[[RearrangeView], NDArray], times: Times = "objects") -> Sense:
    return Sense(lambda view: np.asarray(of(view), np.float64), (0.0,), (1.0,), times)


def _other(of: Callable[[RearrangeView], Floats], low: tuple[float, ...], high: tuple[float, ...]) -> Sense:
    """Observation of the other agent; zeros if there is none."""
    return Sense(lambda v: of(v) if np.isfinite(v.other_xz).all() else np.zeros(len(low)), low, high, "once")


def _one_of_choices(outcome: str) -> Callable[[RearrangeView], Floats]:
    """One of `choices` is 1: what it has done last, if that ended so."""

    def seen(view: RearrangeView) -> Floats:
        known = choices(len(view.objects), robot=len(view.arm) > 0)
        found = np.zeros(len(known))
        if view.last is not None and view.last.outcome == outcome and view.action in known:
            found[known.index(view.action)] = 1.0
        return found

    return seen


def _ways(start: NDArray, points: NDArray, view: RearrangeView) -> Floats:
    """Lengths of the shortest paths from ``start`` [2] to points [K, 3] [m].

    Points lie on furniture, so the ends of the paths are moved to the free floor.
    """
    ways = view.free.geodesic(np.broadcast_to(start, (len(points), 2)), points[:, [0, 2]], max_snap_m=SNAP_M)
    return np.minimum(ways, FAR_M)


def _of_other(of: Callable[[RearrangeView], Floats]) -> Callable[[RearrangeView], Floats]:
    """Observation of the other agent for each object; zeros if there is none."""
    return lambda view: of(view) if np.isfinite(view.other_xz).all() else np.zeros(len(view.objects))


def _approach(view: RearrangeView) -> Floats:
    """How much shorter the other's way to each object has become over their known track, a second [K] [m]."""
    before, now = (_ways(xz, view.objects, view) for xz in (view.other_track[0], view.other_xz))
    return np.clip(before - now, -NEARER_M, NEARER_M)


def _path_ahead(view: RearrangeView, *, of_other: bool) -> Floats:
    """Points that an agent would reach after `AHEAD_M` on its path to each object, [K, 4].

    For an object in its hand, the path leads to the object's goal. Each point is (distance, angle) as the observing
    agent sees it. Paths to objects in another agent's hand are straight lines.
    """
    xz, hands = (view.other_xz if of_other else view.xz), view.held_by
    own = (hands == view.agent) if not of_other else (hands != NOBODY) & (hands != view.agent)
    found = []
    for k in range(len(hands)):
        end = (view.goals if own[k] else view.objects)[k, 0:3:2]
        if own[k] or hands[k] == NOBODY:
            found.append(path_points(view.free, xz, end, AHEAD_M, max_snap_m=SNAP_M))
        else:
            gap = end - xz
            found.append(xz + gap * np.minimum(np.array(AHEAD_M) / max(np.hypot(*gap), 1e-9), 1.0)[:, None])
    return gps_compass(view.xz, view.heading, np.array(found)).reshape(len(hands), -1)


_WAYS = ((0.0,), (FAR_M,), "objects")
_POINTS = ((0.0, -np.pi) * len(AHEAD_M), (FAR_M, np.pi) * len(AHEAD_M), "objects")
_OTHER_GPS = _other(lambda v: gps_compass(v.xz, v.heading, v.other_xz), (0.0, -np.pi), (FAR_M, np.pi))
SENSES: Mapping[str, Sense] = {
    "is_holding": _flags(lambda v: np.array([(v.held_by == v.agent).any()]), "once"),
    "obj_start_gps_compass": _gps(lambda v: v.starts),
    "obj_goal_gps_compass": _gps(lambda v: v.goals),
    "obj_start_sensor": _in_hand(lambda v: v.starts),
    "obj_goal_sensor": _in_hand(lambda v: v.goals),
    "other_agent_gps": _other(lambda v: other_agent_gps(v.xz, v.other_xz), (-FAR_M,) * 2, (FAR_M,) * 2),
    "obj_gps_compass": _gps(lambda v: v.objects),
    "obj_sensor": _in_hand(lambda v: v.objects),
    "holds": _flags(lambda v: v.held_by == v.agent),
    "held_by_other": _flags(lambda v: (v.held_by != v.agent) & (v.held_by != NOBODY)),
    "at_goal": _flags(lambda v: v.at_goal),
    "other_gps_compass": _OTHER_GPS,
    "humanoid_gps": _OTHER_GPS,
    "close": _flags(lambda v: np.array([v.close]), "once"),
    "localization": Sense(
        lambda v: localization(v.xz, v.heading, v.free.height_at(v.xz)), (-FAR_M,) * 3 + (-np.pi,),
        (FAR_M,) * 3 + (np.pi,), "once",
    ),
    "localization_in_start_frame": Sense(
        lambda v: localization_in_start_frame(v.start[:2], v.start[2], v.xz, v.heading), (-FAR_M,) * 3 + (-np.pi,),
        (FAR_M,) * 3 + (np.pi,), "once",
    ),
    "humanoid_in_start_frame": _other(_other_from_start, (-FAR_M,) * 3, (FAR_M,) * 3),
    "obj_start_in_start_frame": _from_start(lambda v: v.starts),
    "obj_goal_in_start_frame": _from_start(lambda v: v.goals),
    "obj_in_start_frame": _from_start(lambda v: v.objects),
    "egomotion": Sense(
        lambda v: egomotion(v.before[:2], v.before[2], v.xz, v.heading), (-FAST,) * 3, (FAST,) * 3, "once"
    ),
    "collision": Sense(lambda v: np.array([v.contact, v.collision], np.float64), (0.0,) * 2, (1.0,) * 2, "once"),
    "arm_joints": Sense(lambda v: v.arm, (-10.0,), (10.0,), "joints"),
    "last_done": Sense(_one_of_choices("done"), (0.0,), (1.0,), "choices"),
    "interrupted": Sense(_one_of_choices("aborted"), (0.0,), (1.0,), "choices"),
    "last_failed": Sense(_one_of_choices("failed"), (0.0,), (1.0,), "choices"),
    "way_to_objects": Sense(lambda v: _ways(v.xz, v.objects, v), *_WAYS),
    "way_to_goals": Sense(lambda v: _ways(v.xz, v.goals, v), *_WAYS),
    "other_way_to_objects": Sense(_of_other(lambda v: _ways(v.other_xz, v.objects, v)), *_WAYS),
    "other_way_to_goals": Sense(_of_other(lambda v: _ways(v.other_xz, v.goals, v)), *_WAYS),
    "other_approach": Sense(_of_other(_approach), (-NEARER_M,), (NEARER_M,), "objects"),
    "path_ahead": Sense(partial(_path_ahead, of_other=False), *_POINTS),
    "other_path_ahead": Sense(
        lambda v: _path_ahead(v, of_other=True) if np.isfinite(v.other_xz).all() else np.zeros(4 * len(v.objects)), *_POINTS
    ),
    "other_velocity": _other(
        lambda v: humanoid_velocity(v.heading, v.other_track[-2:][0], v.other_xz), (-FAST,) * 2, (FAST,) * 2
    ),
    "elapsed_s": Sense(lambda v: np.array([v.step * STEP_S]), (0.0,), (FAR_M,), "once"),
}  # fmt: skip
HABITAT_SENSES = (
    "arm_depth", "is_holding", "obj_start_gps_compass", "obj_goal_gps_compass", "other_agent_gps", "obj_start_sensor",
    "obj_goal_sensor",
)  # fmt: skip
"""What Habitat's configuration shows the upper layer (spec/habitat.md 2.5). Needs a picture in every step."""
PAPER_SENSES = (
    *(name for name in HABITAT_SENSES if name != "other_agent_gps"),
    "humanoid_gps",
    "arm_joints",
    "egomotion",
)
"""What the paper says that the robot has (section 4.2): depth, arm joints, egomotion, the person's distance and direction; and
of the task what Habitat shows. Needs a picture in every step."""
STATE_SENSES = (
    "obj_gps_compass", "obj_goal_gps_compass", "holds", "held_by_other", "at_goal", "other_gps_compass", "last_done",
    "interrupted",
)  # fmt: skip
"""All that a policy without memory needs to do the task."""


def observe(view: RearrangeView, names: Sequence[str]) -> dict[str, NDArray[np.float32]]:
    """The named observations, each [n] float32 and within its `limits`."""
    shown = {}
    for name, values in exact(view, names).items():
        low, high = (np.tile(side, len(values) // len(side)) for side in (SENSES[name].low, SENSES[name].high))
        shown[name] = values.clip(low, high).astype(np.float32)
    return shown


def exact(view: RearrangeView, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """The named observations as they are, each [n]."""
    view = view._replace(hand=_once(view.hand))  # several sensors ask for it
    return {name: np.asarray(SENSES[name].of(view), np.float64).ravel() for name in names}


def _once(ask: Callable[[], Floats]) -> Callable[[], Floats]:
    """Remembers the answer; `functools.cache` takes longer to set up than most sensors to answer."""
    answers: list[Floats] = []

    def answer() -> Floats:
        if not answers:
            answers.append(ask())
        return answers[0]

    return answer


def limits(*, objects: int, arm: int) -> dict[str, Limits]:
    """The spaces of all that an agent with ``arm`` joints (0: a person) can be shown beside pictures."""
    counts = {"once": 1, "objects": objects, "joints": arm, "choices": len(choices(objects, robot=arm > 0))}
    found = {}
    for name, sense in SENSES.items():
        count = counts[sense.times]
        if count:
            low, high = (np.tile(np.array(side, np.float32), count) for side in (sense.low, sense.high))
            found[name] = Limits(low, high, low.shape, np.float32)
    return found
