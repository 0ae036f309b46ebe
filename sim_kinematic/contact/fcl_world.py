"""Scenes and moving bodies in FCL, with a broad phase over convex primitives, contacts and distances.

FCL decides whether shapes touch; the inner loop of walking and driving reads `FreeSpace` instead. Three rules keep the
answers of python-fcl right: only primitives and convex hulls, never triangle meshes; one geometry per object, since
contacts name geometries; and the broad phase is informed of every move.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import pose_to_matrix, transform_points
from h3data.kernels import kernel
from h3data.scene.records import Capsule, Scene, Shape
from h3data.scene.shape_bounds import bounding_capsule, shape_bounds
from sim_kinematic.contact.shapes import fcl_geometry

if TYPE_CHECKING:
    import fcl

CONTACTS_MAX = 1000
"""Largest number of contacts that one query returns."""


class Contact(NamedTuple):
    """Overlap of a shape of ``a`` with a shape of ``b``."""

    index_a: int
    """Index of the shape in ``a``, or into ``names`` if ``a`` is a scene."""
    index_b: int
    depth_m: float
    """Depth of the overlap along ``normal``, positive [m]. The depth is exact between boxes and balls. For capsules,
    cylinders and hulls, FCL's iterations never give less than the least depth, but up to a few centimetres more for
    deep overlaps."""
    point: NDArray[np.float64]
    """A point in the overlap, in the world, shape [3] [m]."""
    normal: NDArray[np.float64]
    """Unit direction from ``a`` to ``b`` in the world, shape [3]: moving ``b`` along it by ``depth_m`` separates
    them."""


class _Objects:
    """Collision objects with their broad phase, the common base of `FclScene` and `MovingShapes`."""

    def __init__(self, geometries: Sequence[fcl.CollisionGeometry], matrices: Sequence[NDArray[np.float64]]) -> None:
        import fcl

        self.objects = [fcl.CollisionObject(g, _transform(m)) for g, m in zip(geometries, matrices, strict=True)]
        self.index = {id(g): k for k, g in enumerate(geometries)}
        self._geometries = tuple(geometries)  # kept: the ids above must not be given to anything else
        self.manager = fcl.DynamicAABBTreeCollisionManager()
        self.manager.registerObjects(self.objects)
        self.manager.setup()

    def __len__(self) -> int:
        return len(self.objects)


class FclScene(_Objects):
    """Static instances of a scene; collision object k is a convex part of the instance ``names[k]``."""

    def __init__(self, scene: Scene) -> None:
        geometries, matrices, names, bounds = [], [], [], []
        for instance in scene.static_instances:
            rigid = pose_to_matrix(np.asarray(instance.pose, np.float64))
            for shape in scene.assets[instance.asset].shapes:
                geometry, local = fcl_geometry(shape, instance.scale)
                geometries.append(geometry)
                matrices.append(rigid @ local)
                names.append(instance.name)
                bounds.append(_bounds(shape, rigid.astype(np.float64), instance.scale))
        self.names: tuple[str, ...] = tuple(names)
        self.bounds: NDArray[np.float64] = np.array(bounds).reshape(-1, 2, 3)
        """Lower and upper corner of a box around each part in the world, [n, 2, 3] [m]."""
        super().__init__(geometries, matrices)

    def is_near(self, start: ArrayLike, end: ArrayLike, radius_m: float) -> bool:
        """Return whether the bounding box of a capsule between ``start`` and ``end`` [n, 3] overlaps that of a part.

        This first test is 50 times as fast as FCL's exact one.
        """
        # one more axis, as the kernel compares capsules in several poses
        start, end = (np.asarray(ends, np.float64)[None] for ends in (start, end))
        return len(_near_pairs(start, end, np.full(start.shape[1], radius_m), self.bounds)) > 0

    def __repr__(self) -> str:
        return f"FclScene({len(self)} convex parts of {len(set(self.names))} instances)"


class MovingShapes(_Objects):
    """Convex shapes that are moved by one transform each, such as links of a robot, bones of a person or a held object."""

    def __init__(self, shapes: Sequence[Shape], scale: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
        pairs = [fcl_geometry(s, scale) for s in shapes]
        self.shapes, self._scale = tuple(shapes), tuple(float(one) for one in scale)
        self._local = np.stack([m for _, m in pairs]) if pairs else np.zeros((0, 4, 4))
        super().__init__([g for g, _ in pairs], list(self._local))

    def set_transforms(self, transforms: ArrayLike) -> None:
        """Move every shape to its rigid world frame; ``transforms`` [n, 4, 4] are of the frames that define shapes."""
        t = np.asarray(transforms, np.float64)
        if t.shape != (len(self), 4, 4):
            raise InputError(
                f"Expected one 4x4 transform for each of {len(self)} shapes, got shape {list(t.shape)}.",
                code="H3-SIM-026",
            )
        if not np.isfinite(t).all():
            raise InputError(
                "Transforms of collision shapes must be finite. Hint: leave out bodies that are not there.",
                code="H3-SIM-027",
            )
        world = t @ self._local
        for k, one in enumerate(self.objects):
            one.setTransform(_transform(world[k]))
        self.manager.update()  # without it the broad phase still sees the old places and misses contacts

    def touches_along(self, scene: FclScene, transforms: ArrayLike, *, except_for: Collection[str] = ()) -> bool:
        """Return whether a shape overlaps a part of the scene in any of T poses, tested from the last one back.

        The answer is that of `set_transforms` and `collide` (`contacts` with ``except_for``) for each pose in turn, which
        takes four times as long: here only pairs whose bounding boxes overlap are moved and tested.

        Args:
            scene: The static scene.
            transforms: Transforms as in `set_transforms`, for each pose, [T, n, 4, 4].
            except_for: Names of instances that may be touched.
        """
        import fcl

        frames = np.asarray(transforms, np.float64)[::-1]
        pairs = _near_moved(np.ascontiguousarray(frames), *self._capsules, scene.bounds)
        request = fcl.CollisionRequest(num_max_contacts=CONTACTS_MAX, enable_contact=True)
        # without exceptions the first contact of a pair decides, and FCL may stop there
        if not except_for:
            request = fcl.CollisionRequest()
        # pairs come sorted by pose and shape, so each shape is moved once per pose
        moved = (-1, -1)
        for pose, k, part in pairs.tolist():
            if except_for and scene.names[part] in except_for:
                continue
            if moved != (pose, k):
                self.objects[k].setTransform(_transform(frames[pose, k] @ self._local[k]))
                moved = pose, k
            if fcl.collide(scene.objects[part], self.objects[k], request, fcl.CollisionResult()):
                return True
        return False

    @cached_property
    def _capsules(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return ends [n, 3] and radii [n] [m] of capsules around the shapes, in the frames that are moved."""
        ends = [bounding_capsule(shape) for shape in self.shapes]
        scale = np.array(self._scale)
        start, end = (np.array([one[side] for one in ends]).reshape(-1, 3) * scale for side in (0, 1))
        return start, end, np.array([one[2] for one in ends]) * np.abs(scale).max()

    def __repr__(self) -> str:
        return f"MovingShapes({len(self)} shapes)"


def _bounds(shape: Shape, rigid: NDArray[np.float64], scale: ArrayLike) -> NDArray[np.float64]:
    """Return the corners [2, 3] [m] of a world box around a shape, capsules with the radius that `fcl_geometry` gives them."""
    scale = np.asarray(scale, np.float64)
    if not isinstance(shape, Capsule):
        return shape_bounds(shape, rigid @ np.diag([*scale, 1.0]))
    ends = transform_points(rigid, np.stack([shape.start, shape.end]) * scale)
    margin = shape.radius * float(np.abs(scale).max())
    return np.stack([ends.min(0) - margin, ends.max(0) + margin])


MARGIN_M = 1e-6
"""Distance below which bounding boxes count as overlapping, so that FCL decides on shapes that touch within rounding
[m]."""


@kernel()
def _near_pairs(start, end, radius, bounds):
    """Return poses, shapes and parts [N, 3] of overlapping boxes, of capsules [T, n, 3] and boxes [m, 2, 3]."""
    found = np.empty((64, 3), np.int64)
    count = 0
    for t in range(start.shape[0]):
        for k in range(start.shape[1]):
            r = radius[k] + MARGIN_M
            x0, x1 = min(start[t, k, 0], end[t, k, 0]) - r, max(start[t, k, 0], end[t, k, 0]) + r
            y0, y1 = min(start[t, k, 1], end[t, k, 1]) - r, max(start[t, k, 1], end[t, k, 1]) + r
            z0, z1 = min(start[t, k, 2], end[t, k, 2]) - r, max(start[t, k, 2], end[t, k, 2]) + r
            for m in range(bounds.shape[0]):
                if bounds[m, 0, 0] > x1 or bounds[m, 1, 0] < x0 or bounds[m, 0, 2] > z1 or bounds[m, 1, 2] < z0:
                    continue
                if bounds[m, 0, 1] > y1 or bounds[m, 1, 1] < y0:
                    continue
                if count == len(found):
                    more = np.empty((2 * count, 3), np.int64)
                    more[:count] = found
                    found = more
                found[count, 0], found[count, 1], found[count, 2] = t, k, m
                count += 1
    return found[:count]


@kernel()
def _near_moved(frames, start, end, radius, bounds):
    """Return `_near_pairs` of capsules [n, 3] that are given in frames [T, n, 4, 4]."""
    moved = np.empty((2, frames.shape[0], frames.shape[1], 3))
    for t in range(frames.shape[0]):
        for k in range(frames.shape[1]):
            for i in range(3):
                moved[0, t, k, i] = moved[1, t, k, i] = frames[t, k, i, 3]
                for j in range(3):
                    moved[0, t, k, i] += frames[t, k, i, j] * start[k, j]
                    moved[1, t, k, i] += frames[t, k, i, j] * end[k, j]
    return _near_pairs(moved[0], moved[1], radius, bounds)


def collide(a: _Objects, b: _Objects) -> bool:
    """Return whether any object of ``a`` overlaps any of ``b``; contact within rounding errors may count either way."""
    import fcl

    if not len(a) or not len(b):
        return False
    data = fcl.CollisionData()
    a.manager.collide(b.manager, data, fcl.defaultCollisionCallback)
    return bool(data.result.is_collision)


def contacts(a: _Objects, b: _Objects) -> list[Contact]:
    """Return the overlaps of the shapes of ``a`` with those of ``b``, deepest first, one or more for each pair."""
    import fcl

    if not len(a) or not len(b):
        return []
    data = fcl.CollisionData(request=fcl.CollisionRequest(num_max_contacts=CONTACTS_MAX, enable_contact=True))
    a.manager.collide(b.manager, data, fcl.defaultCollisionCallback)
    found = []
    for c in data.result.contacts:
        first, second = id(c.o1), id(c.o2)
        normal = np.array(c.normal, np.float64)
        if first in b.index and second in a.index:  # FCL may swap the two sides
            first, second, normal = second, first, -normal
        depth = abs(float(c.penetration_depth))
        found.append(Contact(a.index[first], b.index[second], depth, np.array(c.pos, np.float64), normal))
    return sorted(found, key=lambda c: -c.depth_m)


def distance(a: _Objects, b: _Objects) -> float:
    """Return the smallest distance between two sets of objects [m], infinite if one is empty.

    If they overlap, the result is minus `Contact.depth_m` of the deepest contact, with the error described there.
    """
    import fcl

    if not len(a) or not len(b):
        return float("inf")
    data = fcl.DistanceData()
    a.manager.distance(b.manager, data, fcl.defaultDistanceCallback)
    if data.result.min_distance > 0:
        return float(data.result.min_distance)
    touching = contacts(a, b)  # FCL stops at the first overlapping pair, which need not be the deepest
    return -touching[0].depth_m if touching else 0.0


def _transform(matrix: NDArray[np.float64]) -> fcl.Transform:
    import fcl

    return fcl.Transform(matrix[:3, :3], matrix[:3, 3])
