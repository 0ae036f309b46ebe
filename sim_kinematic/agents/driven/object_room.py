"""Room for putting down an object: free space, support, and the place to which the object falls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from h3data.geometry import Array, pose_to_matrix
from h3data.scene import Instance, Scene
from h3data.scene.floor_heights import floor_heights, room_heights
from sim_kinematic.contact import MovingShapes, collide, contacts
from sim_kinematic.contact.clearance import scenery_of


@dataclass(frozen=True)
class ObjectRoomSpec:
    """Tolerances that decide whether an object can be put down at a place."""

    sunk_m: float = 0.01
    """Depth to which an object may be put into its support [m]. Recorded goals float 1 mm above a surface, and a hand
    errs by 1 cm."""
    inside_m: float = 0.025
    """Largest depth of an object in neighbouring things [m]. Sampled goals lie on their surface but may overlap its
    raised edges (by 2.1 cm at 1 of 16 goals in small homes)."""
    upright: float = 0.7
    """Vertical component of a contact's normal below which the contact counts as lateral."""
    support_m: float = 0.05
    """Largest distance of an object from the surface below that carries it [m]."""
    apart_m: float = 0.01
    """Least gap between the bounding circles of two objects that stand side by side, as in sampled episodes [m]."""
    fall_step_m: float = 0.02
    """Length of the steps in which the surface below an object is searched [m]."""
    fall_halvings: int = 6
    """Number of times that the last step of the search for the surface below an object is halved."""


ROOM = ObjectRoomSpec()


class ObjectRoom:
    """Static things and movable objects of a scene, for tests of free room."""

    def __init__(self, scene: Scene, names: Sequence[str], floor_y: float) -> None:
        """Create the tests for the objects of a task, whose ``names`` are in the order of their poses [K, 7]."""
        self._scenery, self._floor_y, self._heights = scenery_of(scene), floor_y, room_heights(scene.rooms)
        instances = {i.name: i for i in scene.instances}
        self._shapes = [
            MovingShapes(scene.assets[instances[n].asset].shapes, instances[n].scale.tolist()) for n in names
        ]
        self._extents = [object_extent(scene, instances[n]) for n in names]
        self._others = [
            (i.pose[:3].astype(np.float64), object_extent(scene, i))
            for i in scene.instances
            if i.motion == "kinematic" and i.name not in names
        ]

    def refusal(self, k: int, pose: Array, poses: Array) -> str:
        """Return the reason why object ``k`` cannot be put down at a pose7, among other objects at ``poses`` [K, 7].

        The reason is ``no_space`` or ``no_support``, or empty if the object can be put down.
        """
        floor_y = self._floor_below(pose)
        if pose[1] + self._extents[k][1] < floor_y - ROOM.sunk_m or self._is_inside(k, pose):
            return "no_space"
        things = [(poses[n, :3], self._extents[n]) for n in range(len(poses)) if n != k] + self._others
        radius, low, high = self._extents[k]
        for place, (other_radius, other_low, other_high) in things:
            beside = np.hypot(*(pose[:3] - place)[[0, 2]]) > radius + other_radius + ROOM.apart_m
            if not beside and pose[1] + low < place[1] + other_high and place[1] + other_low < pose[1] + high:
                return "no_space"
        on_floor = pose[1] + low - floor_y <= ROOM.support_m
        # lowered by this much, the object would touch what carries it
        return "" if on_floor or self._collides(k, pose, -ROOM.support_m) else "no_support"

    def _floor_below(self, pose: Array) -> float:
        # objects lie on the treads of stairs, over which people's floor is a ramp
        return float(floor_heights(self._heights, self._floor_y, pose[[0, 2]], treads=True))

    def fallen(self, k: int, pose: Array) -> Array:
        """Return the pose7 of object ``k`` after it has fallen straight down onto the surface below.

        An object that overlaps a static thing stays where it is.
        """
        lowest = self._floor_below(pose) - self._extents[k][1] - pose[1]
        down = 0.0
        if lowest >= 0 or self._collides(k, pose, 0.0):
            return pose.copy()
        while down > lowest and not self._collides(k, pose, max(down - ROOM.fall_step_m, lowest)):
            down = max(down - ROOM.fall_step_m, lowest)
        step = min(ROOM.fall_step_m, down - lowest)
        # bisection of the last step: 2 cm / 2^6, or 0.3 mm
        for _ in range(ROOM.fall_halvings):
            step /= 2
            if step and not self._collides(k, pose, down - step):
                down -= step
        result = pose.copy()
        result[1] += down
        return result

    def _is_inside(self, k: int, pose: Array) -> bool:
        """Return whether the object is in something static deeper than it may be."""
        # lifted, it touches only what is beside it; `contacts` takes the shapes where this test leaves them
        return self._collides(k, pose, ROOM.sunk_m) and any(
            contact.depth_m > ROOM.inside_m or abs(contact.normal[1]) > ROOM.upright
            for contact in contacts(self._scenery, self._shapes[k])
        )

    def _collides(self, k: int, pose: Array, lift_m: float) -> bool:
        """Return whether the object touches something static at a pose7 that is ``lift_m`` higher."""
        shapes = self._shapes[k]
        frame = pose_to_matrix(pose)
        frame[1, 3] += lift_m
        shapes.set_transforms(np.broadcast_to(frame, (len(shapes), 4, 4)))
        return collide(self._scenery, shapes)


def object_extent(scene: Scene, instance: Instance) -> tuple[float, float, float]:
    """Return an object's radius on the floor plane and its lowest and highest point relative to its origin [m]."""
    low, high = scene.assets[instance.asset].mesh.bounds.astype(np.float64) * instance.scale
    # the origin need not be in the middle of the thing
    return float(np.hypot(*np.maximum(-low, high)[[0, 2]])), float(low[1]), float(high[1])


def grip_radii(scene: Scene, names: Sequence[str]) -> dict[str, float]:
    """Return the grip radii [m] with which hands hold objects, by the name of the instance.

    A hand grips books and plates across their thinnest side, so the grip radius is half of that side. For cups and
    balls it is the radius of the object.
    """
    found = (i for i in scene.instances if i.name in names)
    return {i.name: float(np.ptp(scene.assets[i.asset].mesh.bounds * i.scale, axis=0).min()) / 2 for i in found}
