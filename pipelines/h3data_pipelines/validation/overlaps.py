"""Search by FCL for instances of a scene that overlap each other, for ``h3data scenes validate``."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import transform_points
from h3data.scene.records import Scene, instance_matrix
from h3data.scene.shape_bounds import bounding_sphere, shape_bounds
from sim_kinematic.contact.fcl_world import CONTACTS_MAX, FclScene


class Overlap(NamedTuple):
    """Pair of instances that overlap."""

    first: str
    second: str
    depth_m: float
    """Depth of the deepest overlap of two of their parts [m]. It is the smaller of FCL's depth, which is too large for
    round parts and deeply overlapping hulls, and of the shift along an axis that separates their bounds.
    """
    point: NDArray[np.float64]
    """Point in the overlap in the world frame, shape [3] [m]."""


def overlapping_instances(scene: Scene, *, tolerance_m: float = 0.01) -> list[Overlap]:
    """Return pairs of instances, static or not, whose collision parts overlap by more than ``tolerance_m``, deepest first.

    Instances without collision parts (rugs, lamp shades, a Habitat stage) are left out; parts of one instance may overlap.
    FCL tests each pair of parts whose bounding spheres meet, because python-fcl hides exceptions in callbacks of its
    managers.
    """
    import fcl

    # FclScene holds static instances only; here objects that may be moved are checked too
    world = FclScene(replace(scene, instances=tuple(replace(i, motion="static") for i in scene.instances)))
    bounds = [
        shape_bounds(shape, instance_matrix(i)) for i in scene.instances for shape in scene.assets[i.asset].shapes
    ]
    deepest: dict[tuple[str, str], Overlap] = {}
    for a, b in _near_pairs(scene, world.names):
        result = fcl.CollisionResult()
        request = fcl.CollisionRequest(num_max_contacts=CONTACTS_MAX, enable_contact=True)
        fcl.collide(world.objects[a], world.objects[b], request, result)
        names = world.names[a], world.names[b]
        (low_a, high_a), (low_b, high_b) = bounds[a], bounds[b]
        apart = float(np.minimum(high_a - low_b, high_b - low_a).min())
        for contact in result.contacts:
            depth = min(abs(float(contact.penetration_depth)), apart)
            if depth > tolerance_m and (names not in deepest or depth > deepest[names].depth_m):
                deepest[names] = Overlap(*names, depth, np.array(contact.pos, np.float64))
    return sorted(deepest.values(), key=lambda o: (-o.depth_m, o.first, o.second))


def _near_pairs(scene: Scene, names: tuple[str, ...]) -> list[tuple[int, int]]:
    """Return pairs (a < b) of parts of different instances whose bounding balls overlap."""
    centers, radii = np.zeros((len(names), 3)), np.zeros(len(names))
    # in the order in which `FclScene` numbers its objects
    k = 0
    for instance in scene.instances:
        matrix = instance_matrix(instance)
        largest = float(np.abs(instance.scale).max())
        for shape in scene.assets[instance.asset].shapes:
            center, radius = bounding_sphere(shape)
            centers[k] = transform_points(matrix, center[None])[0]
            radii[k] = radius * largest
            k += 1
    owner = np.unique(names, return_inverse=True)[1] if names else np.zeros(0, int)
    pairs = []
    for a in range(len(names)):
        apart = np.linalg.norm(centers[a + 1 :] - centers[a], axis=1)
        near = (apart < radii[a + 1 :] + radii[a]) & (owner[a + 1 :] != owner[a])
        pairs += [(a, int(b)) for b in a + 1 + np.flatnonzero(near)]
    return pairs
