"""Contact between any two agents of a world.

Capsules around their shapes are compared first. Only where two of them are near each other does FCL decide, on the exact
shapes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.kernels import kernel
from h3data.scene.records import Shape
from h3data.scene.shape_bounds import bounding_capsule
from sim_kinematic.contact.fcl_world import Contact, MovingShapes, collide, contacts, distance

NEAR_M = 1e-3
"""Distance between capsules below which FCL tests the exact shapes; FCL decides contact to about 1e-6 m [m]."""


class AgentContacts:
    """Contacts between agents, updated step by step.

    An agent is its collision shapes, one world transform each: those of a robot's links, or the capsules of a person's
    bones (`sim_kinematic.contact.frames.body_shapes`). `update` only stores poses: FCL receives them when two agents
    that are near each other are queried. The gate is conservative: the capsules contain every shape, so it hides no
    contact.
    """

    def __init__(self, *agents: Sequence[Shape]) -> None:
        """Create the contact test from the shapes of each agent, in their own frames."""
        self._bodies = tuple(_Body(shapes) for shapes in agents)

    def update(self, agent: int, frames: ArrayLike) -> None:
        """Set the world frames [n, 4, 4] of one agent's shapes."""
        self._bodies[agent].update(np.asarray(frames, np.float64))

    def touching(self) -> list[tuple[int, int]]:
        """Return all pairs (a < b) of agents that touch."""
        return [(a, b) for a, b in combinations(range(len(self._bodies)), 2) if self.collides(a, b)]

    def collides(self, a: int = 0, b: int = 1) -> bool:
        """Return whether two agents touch."""
        first, second = self._bodies[a], self._bodies[b]
        return first.is_near(second) and collide(first.posed(), second.posed())

    def contacts(self, a: int = 0, b: int = 1) -> list[Contact]:
        """Return the contacts of two agents, deepest first."""
        first, second = self._bodies[a], self._bodies[b]
        return contacts(first.posed(), second.posed()) if first.is_near(second) else []

    def distance(self, a: int = 0, b: int = 1) -> float:
        """Return the distance between two agents [m], negative where they overlap. FCL computes it at any distance."""
        return distance(self._bodies[a].posed(), self._bodies[b].posed())


class _Body:
    """Shapes of one agent: their world frames, capsules around them, and FCL's objects, which are posed when needed."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self._objects = MovingShapes(shapes)
        capsules = [bounding_capsule(s) for s in shapes]
        self._ends = np.array([ends for *ends, _ in capsules]).reshape(-1, 2, 3)
        self._radii = np.array([radius for *_, radius in capsules])
        self._frames = np.tile(np.eye(4), (len(capsules), 1, 1))
        self._stale = True

    def update(self, frames: NDArray[np.float64]) -> None:
        # posing FCL's objects costs far more than storing frames, and in most steps nobody is near
        self._frames, self._stale = frames, True

    def is_near(self, other: _Body) -> bool:
        """Return whether a capsule of this body is within `NEAR_M` of one of the other's."""
        return any_near(
            _world(self._frames, self._ends), self._radii, _world(other._frames, other._ends), other._radii, NEAR_M
        )

    def posed(self) -> MovingShapes:
        """Return FCL's objects at the frames of the last `update`."""
        if self._stale:
            self._objects.set_transforms(self._frames)
            self._stale = False
        return self._objects


@kernel(error_model="numpy")
def _world(frames, ends):
    """Return ends of axes [n, 2, 3] in the world, of those in frames [n, 4, 4]."""
    out = np.empty_like(ends)
    for n in range(len(ends)):
        for k in range(2):
            for i in range(3):
                out[n, k, i] = frames[n, i, 3]
                for j in range(3):
                    out[n, k, i] += frames[n, i, j] * ends[n, k, j]
    return out


@kernel(error_model="numpy")
def any_near(ends_a, radii_a, ends_b, radii_b, margin):
    """Return whether a capsule with ends [n, 2, 3] and radii [n] is within ``margin`` of another one [m]."""
    # balls around the other's capsules: they rule out most pairs, without the distance of two segments
    spheres = np.empty((len(radii_b), 4))
    for b in range(len(radii_b)):
        half = 0.0
        for i in range(3):
            spheres[b, i] = (ends_b[b, 0, i] + ends_b[b, 1, i]) / 2
            half += (ends_b[b, 1, i] - spheres[b, i]) ** 2
        spheres[b, 3] = math.sqrt(half) + radii_b[b] + margin
    for a in range(len(radii_a)):
        x, y, z = (
            ends_a[a, 0, 0] + ends_a[a, 1, 0],
            ends_a[a, 0, 1] + ends_a[a, 1, 1],
            ends_a[a, 0, 2] + ends_a[a, 1, 2],
        )
        x, y, z = x / 2, y / 2, z / 2
        half = math.sqrt((ends_a[a, 1, 0] - x) ** 2 + (ends_a[a, 1, 1] - y) ** 2 + (ends_a[a, 1, 2] - z) ** 2)
        # the balls must not be smaller than the capsules by rounding, or a contact would be missed
        around = half + radii_a[a] + 1e-9
        for b in range(len(radii_b)):
            apart = around + spheres[b, 3]
            if (spheres[b, 0] - x) ** 2 + (spheres[b, 1] - y) ** 2 + (spheres[b, 2] - z) ** 2 > apart * apart:
                continue
            reach = radii_a[a] + radii_b[b] + margin
            if segment_square(ends_a[a, 0], ends_a[a, 1], ends_b[b, 0], ends_b[b, 1]) <= reach * reach:
                return True
    return False


@kernel(error_model="numpy")
def segment_square(p, q, r, s):
    """Return the square of the distance between the segments p-q and r-s in space [m2].

    Source: Ericson, Real-Time Collision Detection, 5.1.9.
    """
    a = b = c = d = e = 0.0
    for i in range(3):
        u, v, w = q[i] - p[i], s[i] - r[i], p[i] - r[i]
        a, b, c, d, e = a + u * u, b + u * v, c + v * v, d + u * w, e + v * w
    # of parallel segments every point is as good as another: the first end of p-q is taken
    det = a * c - b * b
    at = min(max((b * e - c * d) / det, 0.0), 1.0) if det > 1e-12 * a * c else 0.0
    # the point on r-s nearest to that on p-q, still to be divided by c; outside of r-s, its end decides on p-q anew
    on = b * at + e
    if on <= 0.0 or c == 0.0:
        on, at = 0.0, min(max(-d / a, 0.0), 1.0) if a > 0.0 else 0.0
    elif on >= c:
        on, at = 1.0, min(max((b - d) / a, 0.0), 1.0) if a > 0.0 else 0.0
    else:
        on /= c
    square = 0.0
    for i in range(3):
        gap = p[i] + at * (q[i] - p[i]) - r[i] - on * (s[i] - r[i])
        square += gap * gap
    return square
