"""Scenes and moving bodies in FCL: broad phase over convex primitives, contacts, distances.

FCL is what says whether things touch; the inner loop of walking and driving reads `FreeSpace` instead. The rules that keep
python-fcl right (each reproduced, research/navigation-and-stepping.md 1.4): primitives and convex hulls only, never triangle
meshes; one geometry per object, since contacts name geometries; a broad phase is told about every move.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import pose_to_matrix
from h3data.scene.records import Scene, Shape
from sim_kinematic.contact.shapes import fcl_geometry

if TYPE_CHECKING:
    import fcl

CONTACTS_MAX = 1000
"""Contacts that one query returns at most."""


class Contact(NamedTuple):
    """Where a shape of ``a`` and a shape of ``b`` overlap."""

    index_a: int
    """Index of the shape in ``a`` (for a scene: into ``names``)."""
    index_b: int
    depth_m: float
    """How far they overlap along ``normal``, positive [m]. Exact between boxes and balls; FCL's iterations for capsules,
    cylinders and hulls never give less than the least depth, but up to a few centimetres more when it is deep."""
    point: NDArray[np.float64]
    """A point in the overlap, world, shape [3] [m]."""
    normal: NDArray[np.float64]
    """Unit direction from a to b, shape [3]: moving b along it by ``depth_m`` parts them."""


class _Objects:
    """Collision objects with their broad phase; what `FclScene` and `MovingShapes` share."""

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
    """The static instances of a scene. Their shapes stay primitives; object k belongs to instance ``names[k]``."""

    def __init__(self, scene: Scene) -> None:
        geometries, matrices, names = [], [], []
        for instance in scene.static_instances:
            rigid = pose_to_matrix(np.asarray(instance.pose, np.float64))
            for shape in scene.assets[instance.asset].shapes:
                geometry, local = fcl_geometry(shape, instance.scale)
                geometries.append(geometry)
                matrices.append(rigid @ local)
                names.append(instance.name)
        self.names: tuple[str, ...] = tuple(names)
        super().__init__(geometries, matrices)

    def __repr__(self) -> str:
        return f"FclScene({len(self)} convex parts of {len(set(self.names))} instances)"


class MovingShapes(_Objects):
    """Convex shapes that are moved by one transform each: links of a robot, capsules of a person, a held object."""

    def __init__(self, shapes: Sequence[Shape], scale: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
        pairs = [fcl_geometry(s, scale) for s in shapes]
        self.shapes = tuple(shapes)
        self._local = np.stack([m for _, m in pairs]) if pairs else np.zeros((0, 4, 4))
        super().__init__([g for g, _ in pairs], list(self._local))

    def set_transforms(self, transforms: ArrayLike) -> None:
        """Moves every shape: ``transforms`` [n, 4, 4] are the world frames in which the shapes are given, rigid."""
        t = np.asarray(transforms, np.float64)
        if t.shape != (len(self), 4, 4):
            raise InputError(f"Expected one 4x4 transform for each of {len(self)} shapes, got shape {list(t.shape)}.")
        if not np.isfinite(t).all():
            raise InputError(
                "Transforms of collision shapes must be finite. Hint: leave out bodies that are not there."
            )
        world = t @ self._local
        for k, one in enumerate(self.objects):
            one.setTransform(_transform(world[k]))
        self.manager.update()  # without it the broad phase still sees the old places and misses contacts

    def __repr__(self) -> str:
        return f"MovingShapes({len(self)} shapes)"


def collide(a: _Objects, b: _Objects) -> bool:
    """Whether anything of a overlaps anything of b; touching within rounding counts either way."""
    import fcl

    if not len(a) or not len(b):
        return False
    data = fcl.CollisionData()
    a.manager.collide(b.manager, data, fcl.defaultCollisionCallback)
    return bool(data.result.is_collision)


def contacts(a: _Objects, b: _Objects) -> list[Contact]:
    """Overlaps between the shapes of a and those of b, deepest first, one or more for each pair that overlaps."""
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
    """Smallest distance between a and b [m]; when they overlap, minus `Contact.depth_m` of the deepest contact, with its
    error; inf if one is empty."""
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
