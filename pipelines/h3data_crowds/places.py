"""Places for scenarios, which are frames on the free floor of a home, or small floor plans if none fits."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import IDENTITY_POSE, Array
from h3data.mesh.primitives import box_mesh
from h3data.scene import Asset, Box, FreeSpace, Instance, Room, Scene
from h3data_crowds.cards import Layout, PlaceKind

POINTS, DIRECTIONS = 4000, 8
"""Numbers of positions and of directions on the floor that are tried as frames."""
ROOM_M, START_M = 0.36, 0.5
"""Free space around the lines on which people and the robot move, and around the robot's start and goal [m]."""
WALL_M, WALL_HEIGHT_M = 0.15, 2.5


class Frame(NamedTuple):
    """Frame (along, right) on the floor in which a layout is placed."""

    origin: Array
    """Origin of the frame in the world (x, z) [2] [m]."""
    heading: float
    """Direction of the axis ``along`` in the world [rad]."""

    def to_world(self, points: Array) -> Array:
        """Return points (along, right) [..., 2] [m] as world points (x, z) [..., 2] [m]."""
        return np.asarray(self.origin + points @ axes_of(np.array(self.heading)))


def axes_of(heading: Array) -> Array:
    """Return the unit vectors (x, z) along an axis and to the right of it [..., 2, 2]."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def lines_of(layout: Layout, kind: PlaceKind) -> Array:
    """Return points (along, right) [N, 2], 0.25 m apart, on the straight lines of the agents of a layout."""
    tracks = [layout.robot, *(np.vstack([s, p]) for s, p in zip(layout.starts, layout.paths, strict=True))]
    if kind in ("corner", "route", "door", "cabin"):  # all who change sides go through the origin
        tracks = [np.vstack([t[:1], np.zeros((1, 2)), t[1:]]) if len(t) > 1 else t for t in tracks]
    points = [tracks[0][:1]]
    for track in tracks:
        points.append(track[:1])
        for a, b in pairwise(track):
            pieces = max(int(np.hypot(*(b - a)) / 0.25), 1)
            points.append(a + (b - a) * np.linspace(0.0, 1.0, pieces + 1)[:, None])
    return np.concatenate(points)


def find_frame(free: FreeSpace, layout: Layout, kind: PlaceKind, rng: np.random.Generator) -> Frame | None:
    """Return a frame on a floor in which a layout fits; None if no frame that was tried fits.

    The straight lines of all agents must be free. In addition, a corridor has walls 0.7 to 1.3 m from its axis, and a
    hallway has walls within 0.75 m. A door is narrower than the floor in front of and behind it. The two sides of a
    corner are not visible from each other.
    """
    if kind == "cabin":
        return None
    origins = free.sample(rng, POINTS)
    narrow = free.signed_distance(origins)
    if kind == "door":
        origins = origins[(narrow > 0.38) & (narrow < 0.65)]
    elif kind == "corridor":
        origins = origins[(narrow > 0.5) & (narrow < 1.3)]
    elif kind == "hallway":
        origins = origins[(narrow > 0.42) & (narrow < 0.7)]
    else:
        origins = origins[narrow > START_M]
    headings = rng.uniform(0.0, np.pi / 4) * (kind in ("open", "hall")) + np.arange(DIRECTIONS) * np.pi / 4
    at = np.repeat(origins, DIRECTIONS, axis=0)
    turned = np.tile(headings, len(origins))

    def room(points: Array, rows: NDArray[np.intp]) -> Array:
        """Return the distance to obstacles [n, N] of points [N, 2] in the frames ``rows`` [n]."""
        placed = at[rows][:, None] + np.einsum("pk,nkx->npx", points, axes_of(turned[rows]))
        return free.signed_distance(placed)

    rows = np.arange(len(at))
    for points, least in ((layout.robot, START_M), (layout.starts, ROOM_M), (lines_of(layout, kind), ROOM_M)):
        if len(rows):
            rows = rows[(room(points, rows) >= least).all(1)]
    if len(rows) and kind in ("corridor", "hallway"):
        line = np.stack([np.arange(-2.0, 2.1, 0.5), np.zeros(9)], 1)
        aside, (least, most) = room(line, rows), (0.7, 1.3) if kind == "corridor" else (0.0, 0.75)
        rows = rows[((aside >= least) & (aside <= most)).all(1)]
    if len(rows) and kind == "door":
        probe = np.array([[0.0, 0.0], [-0.9, 0.0], [0.9, 0.0], [0.0, -0.75], [0.0, 0.75]])
        clear = room(probe, rows)
        rows = rows[(clear[:, 1:3] > clear[:, :1] + 0.1).all(1) & (clear[:, 3:] < 0.05).all(1)]
    if len(rows) and kind == "corner":
        ends = np.stack([layout.robot[0] * t + layout.robot[1] * (1 - t) for t in np.linspace(0.0, 1.0, 30)])
        rows = rows[(room(ends, rows) < 0.0).any(1)]
    rows = rows[:1]
    return Frame(at[rows[0]], float(turned[rows[0]])) if len(rows) else None


_PLANS: dict[PlaceKind, tuple[tuple[float, float, float, float], ...]] = {
    "corridor": ((-5.0, -1.1, 5.0, 1.1),),
    "hallway": ((-5.0, -0.7, 5.0, 0.7),),
    "door": ((-4.0, -2.5, -0.1, 2.5), (-0.1, -0.5, 0.1, 0.5), (0.1, -2.5, 4.0, 2.5)),
    "cabin": ((-4.0, -2.5, -0.1, 2.5), (-0.1, -0.6, 0.1, 0.6), (0.1, -1.2, 2.4, 1.2)),
    "corner": ((-5.0, -1.0, 1.0, 1.0), (-1.0, -5.0, 1.0, -1.0), (-1.0, 1.0, 1.0, 5.0)),
    "route": ((-5.0, -1.1, 1.1, 1.1), (-1.1, -5.0, 1.1, -1.1), (-1.1, 1.1, 1.1, 5.0)),
    "crossing": ((-5.0, -1.1, 5.0, 1.1), (-1.1, -5.0, 1.1, -1.1), (-1.1, 1.1, 1.1, 5.0)),
    "open": ((-4.5, -2.5, 4.5, 2.5),),
    "hall": ((-5.0, -3.5, 5.0, 3.5),),
}
"""Rectangles of floor (x0, z0, x1, z1) [m] of the plan of each kind of place, whose frame is the world's."""


@lru_cache(maxsize=16)
def build_plan(kind: PlaceKind) -> Scene:
    """Return a scene that consists of one place, with floors and walls around them."""
    floors = np.array(_PLANS[kind])
    blocks = [("floor", (x0, -0.1, z0), (x1, 0.0, z1)) for x0, z0, x1, z1 in floors]
    xs, zs = (
        np.unique(
            np.concatenate(
                [floors[:, k], floors[:, k + 2], [floors[:, k].min() - WALL_M, floors[:, k + 2].max() + WALL_M]]
            )
        )
        for k in (0, 1)
    )
    for x0, x1 in pairwise(xs):
        for z0, z1 in pairwise(zs):
            x, z = (x0 + x1) / 2, (z0 + z1) / 2
            inside = (floors[:, 0] < x) & (x < floors[:, 2]) & (floors[:, 1] < z) & (z < floors[:, 3])
            if not inside.any():
                blocks.append(("wall", (x0, 0.0, z0), (x1, WALL_HEIGHT_M, z1)))
    assets, instances = {}, []
    for n, (category, low, high) in enumerate(blocks):
        centre, half = (np.array(high) + low) / 2, (np.array(high) - low) / 2
        name = f"{category}_{n}"
        shape = Box(pose=np.concatenate([centre, IDENTITY_POSE[3:]]), half_extents=half)
        mesh = box_mesh(half, center=centre, color=(200, 195, 185) if category == "floor" else (225, 225, 220))
        assets[name] = Asset(name=name, mesh=mesh, category=category, shapes=() if category == "floor" else (shape,))
        instances.append(Instance(name=name, asset=name, pose=IDENTITY_POSE.copy(), motion="static"))
    rooms = (Room(name=kind, category="hallway", rectangles=floors),)
    return Scene(name=f"scenario_{kind}", assets=assets, instances=tuple(instances), rooms=rooms)
