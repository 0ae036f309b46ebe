"""Seats of a home, found by category and geometry: their front edges, and the heading of a person who sits there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, heading_from_quat, pose_to_matrix, quat_from_heading, quat_multiply, quat_rotate
from h3data.scene.records import Asset, Box, Cylinder, Scene

SEAT_SIDES = {
    "armchair": "front",
    "bed": "sides",
    "bench": "front",
    "bunk_bed": "sides",
    "chair": "front",
    "couch": "front",
    "kids_chair": "front",
    "office_chair": "front",
    "rocking_chair": "front",
    "sofa": "front",
    "stool": "front",
}
"""Categories of furniture with seats, and the sides on which people sit down."""


HEIGHTS_M, LEAST_M, ABOVE_M, BED_STEP_M = (0.2, 0.7), 0.2, 0.05, 0.6
"""Range of the heights of seats above the floor under the furniture; smallest width and depth of a seat; height above a
seat from which shapes obstruct the back; distance between places along the side of a bed, and width of a place on a
sofa [m]."""


class Seat(NamedTuple):
    """Place on furniture where a person can sit."""

    name: str
    """Name of the instance; ``:k`` is appended if it has several places."""
    category: str
    edge: NDArray[np.float64]
    """Middle of the front edge at the height of the seat, in the world, shape [3] [m]."""
    heading: float
    """Heading of a person who sits there [rad]."""
    depth_m: float
    """Distance from the front edge to a backrest, or to the far side [m]."""
    height_m: float
    """Height above the floor on which the furniture stands [m]."""
    ends: tuple[float, float] = (0.0, 0.0)
    """Ends of the surface, at the head and the feet of a person who lies there, as distances to the left of a person
    who sits there, negative to the right [m]."""


def seats_of(scene: Scene) -> list[Seat]:
    """Return all places to sit in a home, in the order of its instances.

    The seat is the largest top of a collision shape at a height at which people sit; its front is the side that faces
    +Z in the model. People sit on both sides of beds, and sofas and benches have a place per 0.6 m.
    """
    seats = []
    for instance in scene.instances:
        asset = scene.assets[instance.asset]
        places = list(_places(asset, instance.scale)) if asset.category in SEAT_SIDES else []
        for k, (edge, turn, depth, ends) in enumerate(places):
            frame = pose_to_matrix(instance.pose)
            # a heading of 0 faces +x, a model faces +z
            heading = quat_multiply(instance.pose[3:], quat_from_heading(turn - np.pi / 2))
            seats.append(
                Seat(
                    name=instance.name if len(places) == 1 else f"{instance.name}:{k}",
                    category=asset.category,
                    edge=frame[:3, :3] @ edge + frame[:3, 3],
                    heading=float(heading_from_quat(heading)),
                    depth_m=depth,
                    height_m=float(edge[1]),
                    ends=ends,
                )
            )
    return seats


def _places(asset: Asset, scale: Array) -> Iterator[tuple[Array, float, float, tuple[float, float]]]:
    """Yield front edges [3] in the asset's frame, turns from the front [rad], depths [m], and `Seat.ends`."""
    # upright boxes and cylinders only: a hull has no flat top that could be found by its bounds
    boxes = np.array([box for shape in asset.shapes if (box := _box(shape, scale)) is not None]).reshape(-1, 2, 3)
    size = boxes[:, 1] - boxes[:, 0]
    top = boxes[:, 1, 1]
    seat = (top > HEIGHTS_M[0]) & (top < HEIGHTS_M[1]) & (size[:, [0, 2]].min(1, initial=np.inf) >= LEAST_M)
    if not seat.any():
        return
    # the largest, because armrests and legs may have tops at the height of a seat too
    k = int(np.argmax(np.where(seat, size[:, 0] * size[:, 2], 0.0)))
    (x0, _, z0), (x1, y, z1) = boxes[k]
    if SEAT_SIDES[asset.category] == "sides":
        # not at the ends of the bed, where its head and foot are
        count = max(int((z1 - z0) / BED_STEP_M) - 1, 1)
        for along in np.linspace(z0, z1, count + 2)[1:-1]:
            # the head of a bed is behind its front
            yield np.array([x1, y, along]), np.pi / 2, x1 - x0, (along - z0, along - z1)
            yield np.array([x0, y, along]), -np.pi / 2, x1 - x0, (z0 - along, z1 - along)
        return
    # backrests: what rises above the rear half of the seat
    above = (top > y + ABOVE_M) & (boxes[:, 0, 0] < x1) & (boxes[:, 1, 0] > x0) & (boxes[:, 1, 2] < (z0 + z1) / 2)
    # without a backrest, one sits as deep as the seat is
    back = float(boxes[above, 1, 2].max(initial=z0))
    count = max(int((x1 - x0) / BED_STEP_M), 1)
    for across in x0 + (np.arange(count) + 0.5) * (x1 - x0) / count:
        yield np.array([across, y, z1]), 0.0, z1 - back, (x1 - across, x0 - across)


def _box(shape: object, scale: Array) -> Array | None:
    """Return the lowest and highest corner [2, 3] of an upright shape; None for other shapes."""
    if isinstance(shape, Cylinder):
        half = np.array([shape.radius, shape.half_height, shape.radius])
    elif isinstance(shape, Box):
        half = np.asarray(shape.half_extents)
    else:
        return None
    # sorted, because a scale may mirror
    turned = np.abs([quat_rotate(shape.pose[3:], axis) for axis in np.diag(half)]).sum(0)
    return np.sort(np.stack([shape.pose[:3] - turned, shape.pose[:3] + turned]) * scale, axis=0)
