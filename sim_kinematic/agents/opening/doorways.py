"""Doors on the way: the floor of a home whose doors and drawers move, and which door to open first to get somewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import joints_of
from h3data.scene.freespace.passages import outlines, passable, passages

SNAP_M = 2.0
"""Ends of a way are at most so far from the floor."""
DETOUR_M = 4.0
"""Agents rather walk so much farther than open a door."""
OPEN_SHARE = 0.95
"""Doors that are open by this share of their range are not in the way."""


@dataclass(frozen=True, eq=False)
class Doorways:
    """The doors between the rooms of a home, and its floor with all of them open."""

    scene: Scene
    """With the doors as they are at rest."""
    open_scene: Scene
    """With all of them open; the same record where none is closed."""
    open_floor: FreeSpace
    joints: tuple[int, ...]
    """Numbers of their joints."""

    @staticmethod
    def of(scene: Scene, free: FreeSpace) -> Doorways:
        """The doors of a home with the floor ``free`` as it is at rest."""
        there = passable(scene, free)
        return Doorways(scene, there, free if there is scene else free.as_in(there), passages(scene, free))

    def crossed(self, path: Array, positions: Array, radius_m: float) -> list[int]:
        """The doors, not open with the joints of the home at ``positions`` [J], by which a path [N, 2] leads, in its order."""
        shares = joints_of(self.scene).shares(positions)
        if len(path) < 2:
            return []
        line, found = shapely.LineString(path), []
        for k in self.joints:
            if shares[k] > OPEN_SHARE:
                continue
            for outline in outlines(self.scene, k, positions):
                if line.distance(outline) < radius_m:
                    found.append((line.project(shapely.Point(shapely.shortest_line(line, outline).coords[0])), k))
                    break
        return [k for _, k in sorted(found)]

    def first(self, ways: Sequence[tuple[Array, Array]], floor: FreeSpace, positions: Array) -> int:
        """The first door on some ways, each from a floor point [2] to another, that has to be opened; -1: none.

        Args:
            ways: The ways, in the order in which they are taken.
            floor: The floor with the joints of the home at ``positions`` [J].
            positions: Of all joints.
        """
        if not self.joints:
            return -1
        for a, b in ways:
            direct = float(self.open_floor.geodesic(a, b, max_snap_m=SNAP_M))
            if float(floor.geodesic(a, b, max_snap_m=SNAP_M)) <= direct + DETOUR_M:
                continue
            doors = self.crossed(self.open_floor.path(a, b, max_snap_m=SNAP_M), positions, self.open_floor.radius_m)
            if doors:
                return doors[0]
        return -1

    def middle(self, k: int) -> NDArray[np.float64]:
        """The floor point [2] in the middle of a doorway."""
        closed = joints_of(self.scene).rest.copy()
        closed[k] = joints_of(self.scene).closed[k]
        return shapely.get_coordinates(shapely.union_all(outlines(self.scene, k, closed)).centroid)[0]
