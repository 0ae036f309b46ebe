"""Predicates of PARTNR that state which things are at which places, over all rows of a recording at once.

By default a thing is at a place if its centre is over the place, the thing stands on it, and nobody holds the thing.
With ``bugs``, the predicates are those of PARTNR's code as far as boxes and rectangles determine them: a thing is on
all furniture below any of its corners, at any height, even while an agent carries it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import quat_to_matrix
from h3data_language.evaluation.layout import FurnitureBox, Layout, Surface, ThingBox
from h3data_language.evaluation.records import NEXT_TO_M, STATES, Proposition

Flags = NDArray[np.bool_]
SINKS_M, RISES_M = 0.03, 0.12
"""Distances below and above a surface within which the lowest point of a thing on it must be [m]; a plate may lie
between them.
"""
FLOOR_M = 0.09
"""Largest height of the lowest point of a thing on the floor [m]."""
IN_ROOM = 0.25
"""Share of the corners and the center of a thing that must be in a room for the thing to be in it."""
PADDING_M = 0.1
"""Height that is added to things to decide whether their height ranges overlap, so that they are next to each other
[m].
"""
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)] + [[0, 0, 0]], np.float64)


@dataclass(eq=False)
class Rows:
    """Rows of a recording over which propositions are evaluated."""

    layout: Layout
    poses: NDArray[np.floating]
    """Pose (pose7) of each thing [T, K, 7]."""
    held: Flags
    """True if an agent holds the thing, bool [T, K]."""
    states: Mapping[str, Flags] = field(default_factory=dict)
    """States ``clean``, ``filled`` and ``powered`` of each thing [T, K]; missing ones are false throughout."""
    bugs: bool = False
    _boxes: dict[str, tuple[NDArray, NDArray]] = field(default_factory=dict, init=False)
    _pairs: dict[Any, Flags] = field(default_factory=dict, init=False)

    def distinct(self) -> tuple[Rows, NDArray[np.intp]]:
        """Return the rows in which something may become true or false, and which of them represents each row [T].

        A thing in an agent's hand is at no place, so that its poses are ignored until it is put down.
        """
        same = (self.poses[1:] == self.poses[:-1]).all(2)
        if not self.bugs:
            same |= self.held[1:] & self.held[:-1]
        for flags in (self.held, *self.states.values()):
            same &= flags[1:] == flags[:-1]
        new = np.concatenate([np.ones(min(len(self.poses), 1), np.bool_), ~same.all(1)])
        states = {name: flags[new] for name, flags in self.states.items()}
        return replace(self, poses=self.poses[new], held=self.held[new], states=states), np.cumsum(new) - 1

    def box(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centre and half extents [T or 1, 3] [m] of the box around a thing or furniture in world axes."""
        if name not in self._boxes:
            fixed = self.layout.furniture.get(name)
            if fixed is not None:
                self._boxes[name] = np.array([fixed.center]), np.array([fixed.half])
            else:
                thing, pose = self.thing(name), self.poses[:, self.number(name)].astype(np.float64)
                turned = quat_to_matrix(pose[:, 3:])
                center = pose[:, :3] + turned @ np.array(thing.center)
                self._boxes[name] = center, np.abs(turned) @ np.array(thing.half)
        return self._boxes[name]

    def corners(self, name: str) -> NDArray[np.float64]:
        """Return the corners and centre of a thing's box in the world [T, 9, 3] [m]."""
        center, half = self.box(name)
        return center[:, None] + _CORNERS * half[:, None]

    def thing(self, name: str) -> ThingBox:
        """Return the box of a thing in its own frame.

        Raises:
            InputError: there is no such thing.
        """
        self.layout.require(name, "things")
        return self.layout.things[name]

    def number(self, name: str) -> int:
        """Return the index of a thing along the second axis of the arrays."""
        self.thing(name)
        return list(self.layout.things).index(name)

    def loose(self, name: str) -> Flags:
        """Return the rows in which nobody holds a thing [T]."""
        if self.bugs or name in self.layout.furniture:
            return np.ones(len(self.poses), np.bool_)
        return ~self.held[:, self.number(name)]


def pairs_of(p: Proposition, rows: Rows) -> Flags:
    """Return which things of the first list are at things of the second list by a proposition, bool [T, A, B].

    B is 1 if there is no second list.

    Raises:
        InputError: a thing, a piece of furniture or a room does not exist.
    """
    name, (first, *rest) = p.function_name, p.things
    key = name, p.things, p.args.get("l2_threshold")
    if key in rows._pairs:  # of another count of the same things
        return rows._pairs[key]
    others: Sequence[str] = rest[0] if rest else ("",)
    test = np.zeros((len(rows.poses), len(first), len(others)), np.bool_)
    for k, a in enumerate(first):
        for n, b in enumerate(others):
            test[:, k, n] = _holds(p, name, rows, a, b)
    rows._pairs[key] = test
    return test


def _holds(p: Proposition, name: str, rows: Rows, a: str, b: str) -> Flags:
    if name in STATES:
        state, wanted = STATES[name]
        k = rows.number(a)
        return rows.states[state][:, k] == wanted if state in rows.states else np.full(len(rows.poses), not wanted)
    if name == "is_next_to":
        for each in (a, b):
            rows.layout.require(each, "things", "furniture")
        near = next_to(*rows.box(a), *rows.box(b), p.args.get("l2_threshold", NEXT_TO_M))
        return near & rows.loose(a) & rows.loose(b) & (a != b or rows.bugs)
    rows.layout.require(a, "things")
    if name == "is_on_floor":
        center, half = rows.box(a)
        return rows.loose(a) & (center[:, 1] - half[:, 1] - rows.layout.floor_y < FLOOR_M)
    if name == "is_in_room":
        rows.layout.require(b, "rooms")
        x, z = np.moveaxis(rows.corners(a)[..., [0, 2]], -1, 0)
        inside = np.zeros(x.shape, np.bool_)
        for x0, z0, x1, z1 in rows.layout.rooms[b]:
            inside |= (x0 <= x) & (x <= x1) & (z0 <= z) & (z <= z1)
        return rows.loose(a) & (inside.mean(-1) >= IN_ROOM)
    rows.layout.require(b, "furniture")
    return rows.loose(a) & _is_at(rows, a, rows.layout.furniture[b], inside=name == "is_inside")


def _is_at(rows: Rows, thing: str, furniture: FurnitureBox, *, inside: bool) -> Flags:
    points = rows.corners(thing) if rows.bugs and not inside else rows.box(thing)[0][:, None]
    center, half = rows.box(thing)
    low, test = center[:, 1] - half[:, 1], np.zeros(len(center), np.bool_)
    for surface in furniture.surfaces:
        if surface.inside != inside:
            continue
        over = _is_over(surface, points).any(-1)
        rises = low - surface.center[1]
        most = np.inf if rows.bugs and not inside else surface.clearance if inside else RISES_M
        test |= over & (rises >= -SINKS_M) & (rises <= most)
    return test


def _is_over(surface: Surface, points: NDArray[np.float64]) -> Flags:
    """Return whether points [..., 3] are over a rectangle."""
    dx, dz = points[..., 0] - surface.center[0], points[..., 2] - surface.center[2]
    c, s = np.cos(surface.heading), np.sin(surface.heading)
    return (np.abs(c * dx - s * dz) <= surface.half[0]) & (np.abs(s * dx + c * dz) <= surface.half[1])


def next_to(center: NDArray, half: NDArray, other: NDArray, other_half: NDArray, within_m: float) -> Flags:
    """Return rows in which two boxes, centers and half extents [T or 1, 3], overlap in height and are close [T]."""
    apart = other - center
    high = np.abs(apart[:, 1]) <= half[:, 1] + other_half[:, 1] + PADDING_M
    flat, sizes = apart[:, [0, 2]], (half + other_half)[:, [0, 2]]
    distance = np.hypot(*flat.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = np.nan_to_num(np.abs(flat) / distance[:, None])
    return high & (distance - (along * sizes).sum(1) <= within_m)


def members_of(p: Proposition) -> list[str]:
    """Return all N names in a proposition about a cluster of things."""
    return list(dict.fromkeys(name for group in p.things for name in group))


def clustered(p: Proposition, rows: Rows) -> tuple[Flags, Flags]:
    """Return rows [T] in which a group of neighbouring things has enough of each list, and the largest group [T, N].

    Raises:
        InputError: a thing does not exist.
    """
    groups = p.things
    names = members_of(p)
    counts = p.args.get("number", [1] * len(groups))
    counts = counts if isinstance(counts, list) else [counts] * len(groups)
    for name in names:
        rows.layout.require(name, "things", "furniture")
    reach = np.zeros((len(rows.poses), len(names), len(names)), np.bool_)
    for i, a in enumerate(names):
        reach[:, i, i] = rows.loose(a)
        for j in range(i):
            near = next_to(*rows.box(a), *rows.box(names[j]), p.args.get("l2_threshold", NEXT_TO_M))
            reach[:, i, j] = reach[:, j, i] = near & rows.loose(a) & rows.loose(names[j])
    for k in range(len(names)):
        reach |= reach[:, :, k, None] & reach[:, None, k, :]
    members = np.array([[name in group for name in names] for group in groups], np.int64)
    enough = (reach.astype(np.int64) @ members.T >= np.array(counts)).all(-1)
    largest = np.argmax(enough * reach.sum(-1), 1)
    return np.asarray(enough.any(-1)), reach[np.arange(len(reach)), largest]


def truth_of(p: Proposition, rows: Rows) -> tuple[Flags, Flags]:
    """Return rows in which a proposition is true [T], and the pairs (`pairs_of`) or cluster members behind it.

    Raises:
        InputError: a name in the proposition does not exist in the home.
    """
    if p.function_name == "is_clustered":
        return clustered(p, rows)
    pairs = pairs_of(p, rows)
    if p.is_same:
        return (pairs.sum(1) >= p.number).any(1), pairs
    # PARTNR counts pairs, so that one thing on two pieces of furniture counts as two
    return (pairs.sum((1, 2)) if rows.bugs else pairs.any(2).sum(1)) >= p.number, pairs


def check_names(propositions: Sequence[Proposition], layout: Layout) -> None:
    """Check that everything that propositions name exists.

    Raises:
        InputError: a name does not exist.
    """
    kinds = {"is_next_to": ("things", "furniture"), "is_clustered": ("things", "furniture")}
    second = {"is_in_room": ("rooms",), "is_on_top": ("furniture",), "is_inside": ("furniture",)}
    for p in propositions:
        for k, names in enumerate(p.things):
            for name in names:
                usual = second.get(p.function_name, ()) if k else ("things",)
                layout.require(name, *kinds.get(p.function_name, usual))
