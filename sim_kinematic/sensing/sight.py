"""Memories of what agents in one home have seen: things, and places where things may lie.

Walls and furniture are known from the start. A thing is known once a ray from an agent's eyes meets it, and stays known where
it was last seen, until that place is seen without it. A place has been looked at once a ray meets its middle; one that is shut
has to be open for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_to_matrix
from h3data.scene import Scene, instance_matrix
from h3data.scene.articulation import joints_of
from h3data.scene.shape_bounds import shape_bounds
from sim_kinematic.motion.state import NOBODY

Flags = NDArray[np.bool_]
EYE_M = {"robot": 1.2, "human": 1.55}
"""Height of the eyes over the floor, by kind [m]."""
HALF_VIEW = np.radians(55.0)
"""Largest angle on the floor plane between where an agent faces and what it sees [rad]."""
THING_M, PLACE_M = 8.0, 5.0
"""Largest distances at which things and places are recognized [m]."""
NEAR_M = 1.2
"""Distance within which an agent sees in all directions [m]: it turns its head."""
LOOK_STEPS = 6
"""Steps from one look to the next."""
MARGIN_M = 0.04
"""Furniture that reaches this near to a point does not hide it: it stands on it or lies in it [m]."""
MOVED_M = 0.1
"""A thing farther than this from where it was seen has been moved [m]."""
ABOVE_M = 0.08
"""A place is looked at so far above its surface [m]."""


class Places(NamedTuple):
    """Surfaces on which things may lie, as one agent knows them."""

    points: NDArray[np.float64]
    """Middle of each [S, 3] [m]."""
    looked: Flags
    """True if the agent has looked at it, [S]."""
    shut: NDArray[np.int64]
    """Number of the door or drawer that has to be opened first, [S]; -1: none."""


class Sight:
    """The memories of all agents of one world."""

    def __init__(self, scene: Scene, kinds: Sequence[str], things: int, floor_y: float) -> None:
        joints, boxes = joints_of(scene), []
        bases = {thing.base for thing in scene.articulations}
        for instance in scene.instances:
            if instance.motion != "static" or instance.name in joints.owner:
                continue
            asset, matrix = scene.assets[instance.asset], pose_to_matrix(np.asarray(instance.pose, np.float64))
            own = [np.sort(np.array(shape_bounds(s, np.eye(4))) * instance.scale, axis=0) for s in asset.shapes]
            if own:
                whole = np.array([np.min(own, axis=(0, 1)), np.max(own, axis=(0, 1))])
                holds = bool(asset.receptacles) or instance.name in bases
                boxes += [(matrix, box.mean(0), whole if holds else box, np.ptp(box, axis=0) / 2) for box in own]
        self._turned = np.array([m[:3, :3].T for m, *_ in boxes]).reshape(-1, 3, 3)
        self._centers = np.array([m[:3, :3] @ c + m[:3, 3] for m, c, *_ in boxes]).reshape(-1, 3)
        self._halves = np.array([h for *_, h in boxes]).reshape(-1, 3)
        self._bounds = np.array([w - c for _, c, w, _ in boxes]).reshape(-1, 2, 3)
        """Bounds of the furniture of each box, or of the box itself, from the middle of the box [B, 2, 3] [m]."""
        self._reach = np.linalg.norm(self._halves, axis=1)
        surfaces = list(scene.receptacles())
        self.names = surface_names(scene)
        points = [(instance_matrix(i) @ np.append(r.center, 1.0))[:3] for i, r in surfaces]
        self.points = np.array(points, np.float64).reshape(-1, 3) + np.array([0.0, ABOVE_M, 0.0])
        self._joints = [joints.enclosing.get(name, ()) for name in self.names]
        self._eyes = np.array([floor_y + EYE_M[kind] for kind in kinds])
        self.known = np.zeros((len(kinds), things), np.bool_)
        """True if an agent knows where a thing is, [A, K]."""
        self.where = np.full((len(kinds), things, 3), np.nan)
        """Last known position of each thing [A, K, 3] [m]."""
        self.held = np.full((len(kinds), things), NOBODY)
        """Last known holder of each thing [A, K]."""
        self.looked = np.zeros((len(kinds), len(surfaces)), np.bool_)
        self.shut = np.full(len(surfaces), -1)
        """The first door or drawer [S] that has to be opened to look at each place; -1: none."""
        self.hidden = np.zeros(things, np.bool_)
        """Things that are behind something closed, [K]."""

    def open(self, is_open: Flags) -> None:
        """Take down which doors and drawers are open, [J]."""
        first = (next((k for k in needed if not is_open[k]), -1) for needed in self._joints)
        self.shut = np.fromiter(first, np.int64, len(self._joints))

    def look(
        self, places: NDArray[np.float64], positions: NDArray[np.float64], held_by: NDArray[np.integer]
    ) -> list[tuple[int, int, bool]]:
        """Take in what all agents see now.

        Args:
            places: ``(x, z, heading)`` of each agent [A, 3].
            positions: positions of the things [K, 3] [m].
            held_by: who holds each, [K].

        Returns:
            Agent, thing, and True if it has become known, or False if it is not where it was, for each change.
        """
        changes = []
        for a, (x, z, heading) in enumerate(places.tolist()):
            eye, left = np.array([x, self._eyes[a], z]), np.flatnonzero(~self.looked[a] & (self.shut < 0))
            count = len(positions)
            seen = self.sees(eye, heading, np.concatenate([positions, self.where[a], self.points[left]]), count)
            now, before = seen[:count] & ~self.hidden | (held_by == a), seen[count : 2 * count]
            with np.errstate(invalid="ignore"):
                moved = np.linalg.norm(self.where[a] - positions, axis=1) > MOVED_M
            gone = self.known[a] & ~now & before & moved
            changes += [(a, k, True) for k in np.flatnonzero(now & ~self.known[a]).tolist()]
            changes += [(a, k, False) for k in np.flatnonzero(gone).tolist()]
            self.known[a] = (self.known[a] | now) & ~gone
            self.where[a, now], self.where[a, gone] = positions[now], np.nan
            self.held[a, now], self.held[a, gone] = held_by[now], NOBODY
            self.looked[a, left] = seen[2 * count :]
            if self.looked[a].all() and not self.known[a].all():  # somebody has moved it: begin again
                self.looked[a] = False
        return changes

    def sees(self, eye: NDArray[np.float64], heading: float, points: NDArray[np.float64], things: int) -> Flags:
        """Which world points [N, 3] an eye [3] of an agent that faces a heading [rad] sees; the first ``things`` are things."""
        apart = points - eye
        flat = np.hypot(apart[:, 0], apart[:, 2])
        ahead = np.cos(heading) * apart[:, 0] - np.sin(heading) * apart[:, 2]
        with np.errstate(invalid="ignore"):
            seen = (flat < NEAR_M) | ((ahead > np.cos(HALF_VIEW) * flat) & (flat <= PLACE_M))
            seen[:things] |= (ahead[:things] > np.cos(HALF_VIEW) * flat[:things]) & (flat[:things] <= THING_M)
        some = np.flatnonzero(seen)
        if len(some):
            within = float(flat[some].max()) + 1.0
            near = np.hypot(*(self._centers - eye)[:, [0, 2]].T) - self._reach < within
            seen[some] = self._open(eye, points[some], near)
        return seen

    def _open(self, eye: NDArray[np.float64], points: NDArray[np.float64], near: Flags) -> Flags:
        """Points [N, 3] that none of some boxes hides from an eye [3]: slabs in the frame of each box."""
        turned, halves, (low, high) = self._turned[near], self._halves[near], self._bounds[near].transpose(1, 0, 2)
        start = np.einsum("bij,bj->bi", turned, eye - self._centers[near])[None]
        end = np.einsum("bij,nbj->nbi", turned, points[:, None] - self._centers[near])
        about = ((end >= low - MARGIN_M) & (end <= high + MARGIN_M)).all(-1)
        step = np.where(np.abs(end - start) < 1e-9, 1e-9, end - start)
        first, last = (-halves - start) / step, (halves - start) / step
        enters, leaves = np.minimum(first, last).max(-1), np.maximum(first, last).min(-1)
        return ~((np.maximum(enters, 0.0) < np.minimum(leaves, 1.0)) & ~about).any(1)


def surface_names(scene: Scene) -> tuple[str, ...]:
    """Names ``instance|receptacle`` of the surfaces of a home, as `SEARCH` numbers them."""
    return tuple(f"{instance.name}|{receptacle.name}" for instance, receptacle in scene.receptacles())
