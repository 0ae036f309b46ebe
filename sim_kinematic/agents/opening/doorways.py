"""Closed doors on paths: floors of homes whose doors and drawers move, and the first door to open on a path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
import shapely

from h3data.geometry import Array
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import joints_of
from h3data.scene.passages import outlines, passable, passages
from sim_kinematic.agents.stands import nearest_stand

DETOUR_M = 4.0
"""Additional distance that agents prefer to walking through a closed door [m]."""


@dataclass(frozen=True, eq=False)
class RoomDoors:
    """The doors between the rooms of a home, and its floor with all of them open."""

    open_share: ClassVar[float] = 0.95
    """Share of a door's range above which an open door does not block a path."""
    scene: Scene
    """Home with the doors at rest."""
    open_scene: Scene
    """Home with all doors open; the same record if none is closed."""
    open_floor: FreeSpace
    joints: tuple[int, ...]
    """Numbers of the doors' joints."""

    @staticmethod
    @lru_cache(maxsize=16)
    def of(scene: Scene, free: FreeSpace) -> RoomDoors:
        """Return the doors of a home whose floor at rest is ``free``; they are searched once per home."""
        there = passable(scene, free)
        return RoomDoors(scene, there, free if there is scene else free.as_in(there), passages(scene, free))

    def sides(self, k: int, stands: Array) -> tuple[bool, bool]:
        """Return, for each side of a closed door, whether one of the stands ``(x, z, heading)`` [N, 3] is on it."""
        closed = joints_of(self.scene).rest.copy()
        closed[k] = joints_of(self.scene).closed[k]
        box = shapely.union_all(outlines(self.scene, k, closed)).minimum_rotated_rectangle
        corners = shapely.get_coordinates(box)
        # a closed door is a thin box, whose long edge parts the two sides
        longest = max(np.diff(corners[:3], axis=0), key=lambda edge: float(np.hypot(*edge)))
        off = stands[:, :2] - corners[:4].mean(0)
        side = off[:, 0] * longest[1] - off[:, 1] * longest[0]
        return bool((side > 0).any()), bool((side < 0).any())

    def crossed(self, path: Array, positions: Array, radius_m: float) -> list[int]:
        """Return the doors on a path [N, 2], in order, that are closed with the joints at ``positions`` [J]."""
        shares = joints_of(self.scene).shares(positions)
        if len(path) < 2:
            return []
        line, found = shapely.LineString(path), []
        for k in self.joints:
            if shares[k] > self.open_share:
                continue
            for outline in outlines(self.scene, k, positions):
                if line.distance(outline) < radius_m:
                    found.append((line.project(shapely.Point(shapely.shortest_line(line, outline).coords[0])), k))
                    break
        return [k for _, k in sorted(found)]

    def any_closed(self, positions: Array) -> bool:
        """Return whether one of the doors is closed with the joints of the home at ``positions`` [J]."""
        return bool((joints_of(self.scene).shares(positions)[list(self.joints)] <= self.open_share).any())

    def first(
        self,
        start: Array,
        stands: Callable[[FreeSpace], Array],
        floor: FreeSpace,
        positions: Array,
        *,
        detour_m: float = DETOUR_M,
    ) -> int:
        """Return the first door to open on the path from a floor point [2] to a place to stand, or -1 if there is none.

        Args:
            start: The floor point.
            stands: Function that returns the places to stand ``(x, z, heading)`` [N, 3] on a floor.
            floor: The floor with the joints of the home at ``positions`` [J].
            positions: Positions of all joints [J] [rad or m].
            detour_m: Additional length of a path without closed doors that is still preferred [m].
        """
        # the floor as it is first: half of the searches where no door is in the way
        around = nearest_stand(floor, stands(floor), start)[1]
        if np.isfinite(around) and around <= detour_m:
            return -1
        wanted = stands(self.open_floor)
        k, direct = nearest_stand(self.open_floor, wanted, start)
        if k < 0 or (np.isfinite(around) and around <= direct + detour_m):
            return -1
        path = self.open_floor.path(start, wanted[k, :2])
        # largest distance from a closed door of a place where nobody can stand because of it [m]
        beside_m = 1.0
        # a path that crosses none may end so close to a closed door that nobody can stand there yet
        doors = self.crossed(path, positions, self.open_floor.radius_m) or self.crossed(path[-2:], positions, beside_m)
        return doors[0] if doors else -1
