"""Contact between the agents of a world, any pair of them: bounding circles on the floor first, then FCL on the exact
shapes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import transform_points
from h3data.scene.records import Shape
from sim_kinematic.collision.fcl_world import Contact, MovingShapes, collide, contacts, distance
from sim_kinematic.collision.shapes import bounding_sphere


class AgentContacts:
    """Which agents touch, step after step.

    An agent is its collision shapes, one world transform each: those of a robot's links, or the capsules of a person's
    bones (`sim_kinematic.contact.body_shapes`). Poses are only stored by `update`: FCL is touched when somebody asks and
    two agents are near each other. The gate is conservative: the circles hold every shape, so it never hides a contact.
    """

    def __init__(self, *agents: Sequence[Shape]) -> None:
        """The shapes of each agent, in their own frames."""
        self._bodies = tuple(_Body(shapes) for shapes in agents)

    def update(self, agent: int, frames: ArrayLike) -> None:
        """New world frames [n, 4, 4] of one agent's shapes."""
        self._bodies[agent].update(np.asarray(frames, np.float64))

    def touching(self) -> list[tuple[int, int]]:
        """All pairs (a < b) that touch."""
        return [(a, b) for a, b in combinations(range(len(self._bodies)), 2) if self.collides(a, b)]

    def collides(self, a: int = 0, b: int = 1) -> bool:
        """Whether two agents touch."""
        first, second = self._bodies[a], self._bodies[b]
        return first.is_near(second) and collide(first.posed(), second.posed())

    def contacts(self, a: int = 0, b: int = 1) -> list[Contact]:
        """Where two agents touch, deepest first."""
        first, second = self._bodies[a], self._bodies[b]
        return contacts(first.posed(), second.posed()) if first.is_near(second) else []

    def distance(self, a: int = 0, b: int = 1) -> float:
        """Distance between two agents [m], negative when they overlap. Always exact: not gated."""
        return distance(self._bodies[a].posed(), self._bodies[b].posed())


class _Body:
    """One agent's shapes: where they are, the circle round them, and FCL's objects, which follow when they are needed."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self._objects = MovingShapes(shapes)
        spheres = [bounding_sphere(s) for s in shapes]
        self._centers = np.array([c for c, _ in spheres]).reshape(-1, 3)
        self._radii = np.array([r for _, r in spheres])
        self._frames = np.tile(np.eye(4), (len(spheres), 1, 1))
        self._circle: tuple[NDArray[np.float64], float] | None = None
        self._stale = True

    def update(self, frames: NDArray[np.float64]) -> None:
        self._frames, self._circle, self._stale = frames, None, True

    def is_near(self, other: _Body) -> bool:
        """Whether the circles round the two bodies, seen from above, touch."""
        if not len(self._radii) or not len(other._radii):
            return False
        (a, reach_a), (b, reach_b) = self._seen_from_above(), other._seen_from_above()
        return float(np.hypot(*(a - b))) <= reach_a + reach_b

    def _seen_from_above(self) -> tuple[NDArray[np.float64], float]:
        """Centre (x, z) [2] and radius [m] of a circle round the body."""
        if self._circle is None:
            floor = transform_points(self._frames, self._centers[:, None])[:, 0, [0, 2]].astype(np.float64)
            center = (floor.min(0) + floor.max(0)) / 2
            self._circle = center, float((np.linalg.norm(floor - center, axis=1) + self._radii).max())
        return self._circle

    def posed(self) -> MovingShapes:
        if self._stale:
            self._objects.set_transforms(self._frames)
            self._stale = False
        return self._objects
