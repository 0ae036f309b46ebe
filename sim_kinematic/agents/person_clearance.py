"""Room to reach: tests whether a standing person can bring a hand to a point with the body clear of walls and furniture.

The collision capsules are posed along the hand's path (`Person.hand_path`), and FCL tests them against the static
scene. The capsules are thinner by `TOLERANCE_M`, so only deeper overlaps count as contact.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.reach import Hand
from h3data.geometry import IDENTITY_POSE, Array, ground_pose, pose_inverse, pose_multiply, pose_to_matrix
from h3data.scene import Scene
from h3data.scene.floor_heights import floor_heights, room_heights
from sim_kinematic.agents.person import Person
from sim_kinematic.contact import MovingShapes, capsule_transforms, shapes_from_capsules
from sim_kinematic.contact.clearance import scenery_of, supports

TOLERANCE_M = 0.02
"""Depth to which a capsule may enter an obstacle [m]: bodies are softer, and a little thinner, than capsules."""
WAYS_KEPT, ANSWERS_KEPT = 1000, 10_000
"""Number of cached paths of a body's hand (30 kB each), and of cached results (300 bytes each). A home has about 500
paths: one for each height of its surfaces and each distance of a stand. With 200 of them, half of the time of
`is_clear` went into computing paths again."""
REACHING_PARTS: dict[Hand, tuple[str, str]] = {
    "right": ("right_forearm", "right_hand"),
    "left": ("left_forearm", "left_hand"),
}
"""Parts of the body that may be inside the furniture that holds the object, since an object on a shelf is taken from
inside the shelf."""


class _Part(NamedTuple):
    """Some of the capsules."""

    rows: NDArray[np.intp]
    shapes: MovingShapes


class BodyClearance:
    """Test of the room that a reaching person needs, for one scene and one person."""

    def __init__(self, scene: Scene, body: Humanoid, floor_y: float) -> None:
        self._scenery, self._body = scenery_of(scene), body
        self._floor_y, self._heights = floor_y, room_heights(scene.rooms)
        start, end, radius = body.capsules_world(np.tile(np.eye(4), (1, 55, 1, 1)))
        # capsules thinner than the tolerance would have no radius left
        thinner = shapes_from_capsules(start[0], end[0], np.maximum(radius - TOLERANCE_M, 0.25 * radius))
        self._parts: dict[Hand, tuple[_Part, _Part]] = {}
        for hand, names in REACHING_PARTS.items():
            reaches = np.array([capsule.name in names for capsule in body.capsules])
            trunk, arm = (
                _Part(rows, MovingShapes([thinner[k] for k in rows]))
                for rows in map(np.flatnonzero, (~reaches, reaches))
            )
            self._parts[hand] = trunk, arm
        self._person = Person(body, IDENTITY_POSE)
        self._ways = _hand_paths(body)
        self._answers: dict[tuple[bytes, bytes, Hand], bool] = {}

    def is_clear(self, stand: Array, point: Array, hand: Hand = "right") -> bool:
        """Return whether a person at a stand ``(x, z, heading)`` [3] can move a hand to a point [3] and back."""
        stand, point = np.asarray(stand, np.float64), np.asarray(point, np.float64)
        asked = stand.tobytes(), point.tobytes(), hand
        if asked not in self._answers:
            if len(self._answers) >= ANSWERS_KEPT:
                self._answers.clear()
            self._answers[asked] = self._is_clear(stand, point, hand)
        return self._answers[asked]

    def _is_clear(self, stand: Array, point: Array, hand: Hand) -> bool:
        floor_y = float(floor_heights(self._heights, self._floor_y, stand[:2]))
        base = ground_pose(stand[:2], float(stand[2]), floor_y)
        frames = pose_to_matrix(base) @ self._capsules(base, point, hand)
        trunk, arm = self._parts[hand]
        if trunk.shapes.touches_along(self._scenery, frames[:, trunk.rows]):
            return False
        return not arm.shapes.touches_along(
            self._scenery, frames[:, arm.rows], except_for=supports(self._scenery, point)
        )

    def _capsules(self, base: Array, point: Array, hand: Hand) -> NDArray[np.floating]:
        """Return frames of the capsules on a hand's ways, empty and full, in the root frame, [T, C, 4, 4].

        Stands on one ring round the point share them.
        """
        local = pose_multiply(pose_inverse(base), np.append(point, [0, 0, 0, 1.0]))[:3]
        # rounded: seen from stands of one ring the point differs by rounding alone
        seen = hand, tuple(np.round(local, 4).tolist())
        # spacing of the frames of the hand's path that are checked; the last one always is
        every = 4
        if seen not in self._ways:
            if len(self._ways) >= WAYS_KEPT:
                self._ways.pop(next(iter(self._ways)))
            quats, pelvis = [], []
            for full in (False, True):
                way = self._person.hand_path(np.array(seen[1]), hand, full=full)
                rows = np.unique(np.append(np.arange(0, len(way.quats), every), len(way.quats) - 1))
                quats.append(way.quats[rows])
                pelvis.append(way.pelvis[rows])
            joints = self._body.joint_matrices(IDENTITY_POSE[None], np.concatenate(quats), np.concatenate(pelvis))
            start, end, _ = self._body.capsules_world(joints)
            self._ways[seen] = capsule_transforms(start, end)
        return self._ways[seen]


@lru_cache(maxsize=8)
def _hand_paths(body: Humanoid) -> dict[tuple[Hand, tuple[float, ...]], Array]:
    """Return the cache of the paths of a body's hands for `BodyClearance._capsules`, shared by all homes."""
    # only the key of the cache
    return {}


@lru_cache(maxsize=8)
def reach_room(scene: Scene, body: Humanoid, floor_y: float) -> BodyClearance:
    """Return the clearance of a body in a scene, cached for each scene and body."""
    return BodyClearance(scene, body, floor_y)
