"""Memories of the things that agents in one home have seen, and of places where things may lie.

Walls and furniture are known from the start. A thing becomes known when a ray from an agent's eyes hits it. It stays
known at the place where it was last seen, until that place is seen without it. A place has been looked at when a ray
hits its middle; a closed place has to be open for that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_to_matrix
from h3data.kernels import kernel
from h3data.scene import Scene, instance_matrix
from h3data.scene.articulation import joints_of
from h3data.scene.shape_bounds import shape_bounds
from sim_kinematic.contact.frames import Body
from sim_kinematic.motion.state import NOBODY

Flags = NDArray[np.bool_]
HALF_VIEW = math.radians(55.0)
"""Largest angle on the floor plane between an agent's heading and the things that it sees [rad]."""
THING_M, PLACE_M = 8.0, 5.0
"""Largest distances at which things and places are recognized [m]."""
NEAR_M = 1.2
"""Distance within which an agent sees in all directions, because it turns its head [m]."""
LOOK_STEPS = 6
"""Number of steps between two looks."""
MARGIN_M = 0.04
"""Distance from a point within which furniture does not hide it, because the thing stands on or lies in that furniture
[m]."""
MOVED_M, ABOVE_M = 0.1, 0.08
"""Distance of a thing from where it was seen beyond which it has been moved [m]; height above the surface of a place at which
agents look at it [m]; height of a person's eyes as a share of their stature (Drillis and Contini 1966)."""


class Places(NamedTuple):
    """Surfaces on which things may lie, as one agent knows them."""

    points: NDArray[np.float64]
    """Centre of each surface, [S, 3] [m]."""
    looked: Flags
    """True for each surface that the agent has already checked, [S]."""
    shut: NDArray[np.int64]
    """Number of the door or drawer that has to be opened before each surface can be seen, [S]; -1: none."""


class Boxes(NamedTuple):
    """Walls and furniture that hide things, as boxes."""

    turned: NDArray[np.float64]
    """Rotation matrix from the world to the axes of each box, [B, 3, 3]."""
    centers: NDArray[np.float64]
    """Centre of each box [B, 3] [m]."""
    halves: NDArray[np.float64]
    """Half of the size of each box, [B, 3] [m]."""
    bounds: NDArray[np.float64]
    """Bounds of the furniture that each box belongs to, or of the box itself, relative to the middle of the box, [B, 2,
    3] [m]."""


class Sight:
    """Memories of all agents of one world."""

    def __init__(self, scene: Scene, bodies: Sequence[Body], things: int, floor_y: float) -> None:
        joints, boxes = joints_of(scene), []
        bases = {thing.base for thing in scene.articulations}
        for instance in scene.instances:
            if instance.motion != "static" or instance.name in joints.owner:
                continue
            asset, matrix = scene.assets[instance.asset], pose_to_matrix(np.asarray(instance.pose, np.float64))
            # sorted again, as a negative scale swaps the least and the largest bound
            own = [np.sort(np.array(shape_bounds(s, np.eye(4))) * instance.scale, axis=0) for s in asset.shapes]
            if own:
                whole = np.array([np.min(own, axis=(0, 1)), np.max(own, axis=(0, 1))])
                holds = bool(asset.receptacles) or instance.name in bases
                boxes += [(matrix, box.mean(0), whole if holds else box, np.ptp(box, axis=0) / 2) for box in own]
        self.boxes = Boxes(
            np.array([m[:3, :3].T for m, *_ in boxes]).reshape(-1, 3, 3),
            np.array([m[:3, :3] @ c + m[:3, 3] for m, c, *_ in boxes]).reshape(-1, 3),
            np.array([h for *_, h in boxes]).reshape(-1, 3),
            np.array([w - c for _, c, w, _ in boxes]).reshape(-1, 2, 3),
        )
        surfaces = list(scene.receptacles())
        self.names = surface_names(scene)
        points = [(instance_matrix(i) @ np.append(r.center, 1.0))[:3] for i, r in surfaces]
        self.points = np.array(points, np.float64).reshape(-1, 3) + np.array([0.0, ABOVE_M, 0.0])
        self._joints = [joints.enclosing.get(name, ()) for name in self.names]
        self._eyes = np.array([floor_y + body.eye_height_m for body in bodies])
        self.known = np.zeros((len(bodies), things), np.bool_)
        """True if an agent knows the place of a thing, [A, K]."""
        self.where = np.full((len(bodies), things, 3), np.nan)
        """Last known position of each thing for each agent, [A, K, 3] [m]."""
        self.held = np.full((len(bodies), things), NOBODY)
        """Last known holder of each thing for each agent, [A, K]."""
        self.looked = np.zeros((len(bodies), len(surfaces)), np.bool_)
        self.shut = np.full(len(surfaces), -1)
        """First door or drawer that has to be opened to look at each place, [S]; -1: none."""
        self.hidden = np.zeros(things, np.bool_)
        """True for things that are behind a closed door or in a closed drawer, [K]."""

    def open(self, is_open: Flags) -> None:
        """Store which doors and drawers are open, given as bool [J]."""
        first = (next((k for k in needed if not is_open[k]), -1) for needed in self._joints)
        self.shut = np.fromiter(first, np.int64, len(self._joints))

    def look(
        self, places: NDArray[np.float64], positions: NDArray[np.float64], held_by: NDArray[np.integer]
    ) -> list[tuple[int, int, bool]]:
        """Update the memories of all agents with the things and places that they see now.

        Args:
            places: ``(x, z, heading)`` of each agent [A, 3].
            positions: positions of the things [K, 3] [m].
            held_by: number of the agent that holds each thing, [K].

        Returns:
            Agent, thing, and True if it has become known, or False if it is not where it was, for each change.
        """
        changes = []
        for a, (x, z, heading) in enumerate(places.tolist()):
            eye, left = np.array([x, self._eyes[a], z]), np.flatnonzero(~self.looked[a] & (self.shut < 0))
            count = len(positions)
            seen = self.sees(eye, heading, np.concatenate([positions, self.where[a], self.points[left]]), count)
            # what an agent holds it knows, wherever it looks
            now, before = seen[:count] & ~self.hidden | (held_by == a), seen[count : 2 * count]
            # places that it does not know are NaN, and nothing has moved away from them
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
        """Return whether an eye [3] that looks along a heading [rad] sees each point [N, 3], as bool [N].

        The first ``things`` points are things; the others are places, which are seen from farther away."""
        seen = np.empty(len(points), np.bool_)
        _see(eye, float(heading), points, things, *self.boxes, seen)
        return seen


@kernel(error_model="numpy")
def _see(eye, heading, points, things, turned, centers, halves, bounds, seen):
    """Write which points [N, 3] an eye [3] sees into ``seen`` [N]; the first ``things`` are things.

    A point is hidden if the ray to it passes through one of the `Boxes`, unless it is in or at the furniture of that box.
    """
    ahead_x, ahead_z, least = math.cos(heading), -math.sin(heading), math.cos(HALF_VIEW)
    # the eye in the axes of each box, once for all points
    start = np.empty((len(centers), 3))
    for b in range(len(centers)):
        for i in range(3):
            start[b, i] = 0.0
            for j in range(3):
                start[b, i] += turned[b, i, j] * (eye[j] - centers[b, j])
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - eye[0], points[n, 1] - eye[1], points[n, 2] - eye[2]
        flat = math.sqrt(dx * dx + dz * dz)
        farthest = THING_M if n < things else PLACE_M
        seen[n] = flat < NEAR_M or (flat <= farthest and dx * ahead_x + dz * ahead_z > least * flat)  # NaN: neither
        if not seen[n]:
            continue
        length = dx * dx + dy * dy + dz * dz
        for b in range(len(centers)):
            # most boxes are farther from the ray than their corners are from their middle
            cx, cy, cz = centers[b, 0] - eye[0], centers[b, 1] - eye[1], centers[b, 2] - eye[2]
            along = min(max((cx * dx + cy * dy + cz * dz) / max(length, 1e-12), 0.0), 1.0)
            cx, cy, cz = cx - along * dx, cy - along * dy, cz - along * dz
            if cx * cx + cy * cy + cz * cz > halves[b, 0] ** 2 + halves[b, 1] ** 2 + halves[b, 2] ** 2:
                continue
            # slabs (Kay and Kajiya 1986): a ray is inside a box from its last entry to its first exit
            enters, leaves, about = 0.0, 1.0, True
            for i in range(3):
                step = turned[b, i, 0] * dx + turned[b, i, 1] * dy + turned[b, i, 2] * dz
                end = start[b, i] + step
                about = about and bounds[b, 0, i] - MARGIN_M <= end <= bounds[b, 1, i] + MARGIN_M
                # a ray parallel to a face would divide by 0
                step = step if abs(step) >= 1e-9 else 1e-9
                first, last = (-halves[b, i] - start[b, i]) / step, (halves[b, i] - start[b, i]) / step
                enters, leaves = max(enters, min(first, last)), min(leaves, max(first, last))
            if enters < leaves and not about:
                seen[n] = False
                break


def surface_names(scene: Scene) -> tuple[str, ...]:
    """Return the names ``instance|receptacle`` of the surfaces of a home, in the order of their numbers in `SEARCH`."""
    return tuple(f"{instance.name}|{receptacle.name}" for instance, receptacle in scene.receptacles())
