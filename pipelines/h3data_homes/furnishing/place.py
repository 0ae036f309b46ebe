"""Rules for placing furniture in one room such that agents can still walk everywhere.

Candidate positions come from `search`. A group is given in a frame with z = 0 at the wall behind it, +z into the room
and x = 0 at its centre. Side k of a room is the wall behind a piece turned by k quarters about +y: 0 = low z, 1 = low
x, 2 = high z, 3 = high x.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from h3data.geometry import add_up
from h3data_homes.furnishing.furniture import Furniture
from h3data_homes.layout import Layout, Opening, RoomPlan
from h3data_homes.zoning import Rect

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

WALK_RADIUS = 0.30
"""Radius of the disc for which free space is checked, that of Habitat's humanoid (spec/habitat.md) [m]."""
PLAN_RADIUS = 0.305
"""Radius used while placing furniture; the margin over `WALK_RADIUS` keeps passages clear of rounding [m]."""
GAP_BAND = (0.45, 0.60)
"""Widths of gaps to avoid [m]: 2 r - 5 cm to 2 r + 10 cm for r = 0.25 m (research/navigation-and-stepping.md 2.4)."""
CRUMB_M2 = 0.002
"""Area below which pieces of cut-off floor or pockets are rounding errors [m2]."""
_DOOR_DEPTH = 0.8
_OPEN_DEPTH, _OPEN_FROM = 0.36, 2.6
"""Free floor on both sides of openings wider than this in homes of the second generation [m]."""
_TALL = 0.88
"""Height above which furniture does not stand in front of windows [m]."""
_REACH = {"desk": 0.85, "dining_table": 0.65, "kitchen_island": 0.65, "kids_table": 0.6, "balcony_table": 0.65}
"""Greatest distance from walkable floor to furniture with chairs in between; 0.38 m for other furniture [m]."""
_FROM_ANYWHERE = (
    "dining_table",
    "coffee_table",
    "bed",
    "kitchen_island",
    "kids_table",
    "balcony_table",
    "side_table",
    "pouf",
    "ironing_board",
    "bunk_bed",
)
"""Furniture used from any side; all other furniture with a surface is used from its front."""


@dataclass(frozen=True, kw_only=True)
class Member:
    """Piece of a furniture group, in the group's frame."""

    piece: Furniture
    x: float = 0.0
    z: float = 0.0
    quarter: int = 0
    yaw: float = 0.0
    """Small additional rotation, for chairs that are not quite straight [rad]."""
    y: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Piece of furniture with its position in the world."""

    piece: Furniture
    room: str
    x: float
    z: float
    quarter: int
    yaw: float = 0.0
    y: float = 0.0
    layer: str = ""


@dataclass
class RoomState:
    """State of a room during furnishing: the furniture placed so far, and the constraints on further pieces."""

    room: RoomPlan
    doors: list[tuple[int, Opening]]
    """Pairs (side, opening) of doors and wide openings."""
    windows: list[tuple[int, Opening]]
    keep: list[Rect]
    """Rectangles of floor that stay free in front of doors."""
    placed: list[Placed] = field(default_factory=list)
    solids: list[Rect] = field(default_factory=list)
    fronts: list[Rect] = field(default_factory=list)
    rugs: list[Rect] = field(default_factory=list)
    goals: list[tuple[Rect, float]] = field(default_factory=list)
    """Edges (flat rectangles) that walkers must be able to approach, with the largest allowed distance [m]."""
    _free: BaseGeometry | None = None

    @property
    def interior(self) -> Rect:
        """Rectangle of the room inside its walls."""
        return self.room.interior

    @property
    def free(self) -> BaseGeometry:
        """Floor of the room minus obstacles, plus the doorways; it is not shrunk by the radius of an agent."""
        if self._free is None:
            self._free = _bare_floor(self)
        return self._free

    @free.setter
    def free(self, free: BaseGeometry) -> None:
        self._free = free


def room_state(layout: Layout, room: RoomPlan) -> RoomState:
    """Return the state of an empty room with its doors and windows."""
    doors, windows, keep = [], [], []
    for o in layout.openings:
        if room.name not in o.rooms:
            continue
        x0, z0 = room.rect[:2]
        side = (0 if abs(o.line - z0) < 1e-9 else 2) if o.axis == 0 else (1 if abs(o.line - x0) < 1e-9 else 3)
        if o.height[0] > 0:
            windows.append((side, o))
            continue
        low, high = o.span[0] - 0.05, o.span[1] + 0.05
        depth = _OPEN_DEPTH if layout.open_plan and high - low > _OPEN_FROM and len(o.rooms) == 2 else _DOOR_DEPTH
        keep.append(strip(room.interior, side, low, high, depth))
        doors.append((side, o))
    return RoomState(room=room, doors=doors, windows=windows, keep=keep)


def strip(interior: Rect, side: int, low: float, high: float, depth: float) -> Rect:
    """Return the rectangle along a part of a wall that extends ``depth`` [m] into the room."""
    x0, z0, x1, z1 = interior
    if side == 0:
        return low, z0, high, z0 + depth
    if side == 1:
        return x0, low, x0 + depth, high
    if side == 2:
        return low, z1 - depth, high, z1
    return x1 - depth, low, x1, high


def side_span(interior: Rect, side: int) -> tuple[float, float]:
    """Return the two ends of a wall along its axis."""
    return (interior[0], interior[2]) if side % 2 == 0 else (interior[1], interior[3])


def side_depth(interior: Rect, side: int) -> float:
    """Return the distance from a wall to the opposite wall [m]."""
    return interior[3] - interior[1] if side % 2 == 0 else interior[2] - interior[0]


def turned(quarter: int, x: float, z: float) -> tuple[float, float]:
    """Rotate (x, z) by quarter turns about +y, which take +z to +x."""
    return ((x, z), (z, -x), (-x, -z), (-z, x))[quarter % 4]


def wall_point(interior: Rect, side: int, u: float) -> tuple[float, float]:
    """Return the world point (x, z) of a group frame's origin at position ``u`` along a wall [m]."""
    return ((u, interior[1]), (interior[0], u), (u, interior[3]), (interior[2], u))[side]


def around(x: float, z: float, width: float, depth: float, quarter: int) -> Rect:
    """Return the plan rectangle of a piece by its centre, size and quarter turns."""
    a, b = (width / 2, depth / 2) if quarter % 2 == 0 else (depth / 2, width / 2)
    return x - a, z - b, x + a, z + b


def footprint(p: Placed) -> Rect:
    """Return the plan rectangle of a piece, ignoring its small additional yaw."""
    return around(p.x, p.z, p.piece.size[0], p.piece.size[2], p.quarter)


def front_strip(p: Placed, depth: float) -> Rect:
    """Return the plan rectangle of a given depth [m] in front of a piece."""
    dx, dz = turned(p.quarter, 0.0, p.piece.size[2] / 2 + depth / 2)
    return around(p.x + dx, p.z + dz, p.piece.size[0], depth, p.quarter)


def overlap(a: Rect, b: Rect, slack: float = 1e-6) -> bool:
    """Return whether two rectangles overlap by more than ``slack`` [m]."""
    return a[0] < b[2] - slack and b[0] < a[2] - slack and a[1] < b[3] - slack and b[1] < a[3] - slack


def _inside(a: Rect, b: Rect, slack: float = 1e-6) -> bool:
    return a[0] >= b[0] - slack and a[1] >= b[1] - slack and a[2] <= b[2] + slack and a[3] <= b[3] + slack


def gap(a: Rect, b: Rect) -> float:
    """Return the distance between two rectangles, 0 if they meet [m]."""
    dx = max(b[0] - a[2], a[0] - b[2], 0.0)
    dz = max(b[1] - a[3], a[1] - b[3], 0.0)
    return float(np.hypot(dx, dz))


def _gap_refused(value: float) -> bool:
    return GAP_BAND[0] < value < 2 * PLAN_RADIUS


def at(state: RoomState, members: Sequence[Member], origin: tuple[float, float], side: int) -> list[Placed]:
    """Return a group's pieces in the world, with the group frame at ``origin`` and rotated by ``side`` quarter turns."""
    out = []
    for m in members:
        dx, dz = turned(side, m.x, m.z)
        out.append(
            Placed(
                piece=m.piece,
                room=state.room.name,
                x=origin[0] + dx,
                z=origin[1] + dz,
                quarter=(side + m.quarter) % 4,
                yaw=m.yaw,
                y=m.y,
            )
        )
    return out


def fits(state: RoomState, group: Sequence[Placed]) -> bool:
    """Return whether a group passes the cheap tests of its position in the room.

    It must lie inside the room, clear of other furniture, doors and windows, and leave no gap of ambiguous width.
    """
    interior = state.interior
    for p in group:
        if not p.piece.solid:
            continue
        rect = footprint(p)
        if p.y + p.piece.size[1] > _TALL and any(overlap(rect, w) for w in _window_strips(state)):
            return False
        if p.y > 0:
            continue
        if not _inside(rect, interior):
            return False
        if any(overlap(rect, other) for other in (*state.solids, *state.fronts, *state.keep)):
            return False
        if any(_gap_refused(gap(rect, other)) for other in state.solids):
            return False
        if any(_gap_refused(abs(rect[i] - interior[i])) and not _filled(rect, interior, i, group) for i in range(4)):
            return False
        if p.piece.front_m > 0:
            front = front_strip(p, p.piece.front_m)
            if not _inside(front, interior) or any(overlap(front, other) for other in state.solids):
                return False
    return True


def _filled(rect: Rect, interior: Rect, end: int, group: Sequence[Placed]) -> bool:
    """Return whether another piece of the group stands between a rectangle and one wall, as a desk does for its chair."""
    between = list(rect)
    between[(end + 2) % 4], between[end] = rect[end], interior[end]
    strip = (between[0], between[1], between[2], between[3])
    return any(p.piece.solid and p.y == 0 and overlap(footprint(p), strip) for p in group)


def _window_strips(state: RoomState) -> list[Rect]:
    return [strip(state.interior, side, o.span[0] - 0.05, o.span[1] + 0.05, 0.35) for side, o in state.windows]


def reach_m(category: str) -> float:
    """Return the largest allowed distance of walkers from the edge at which furniture is used [m]."""
    return _REACH.get(category, PLAN_RADIUS + 0.075)


def used_from_front(category: str) -> bool:
    """Return whether furniture is used from its front only."""
    return category not in _FROM_ANYWHERE


def _goals(group: Iterable[Placed]) -> list[tuple[Rect, float]]:
    """Return the edges of a group that walkers must be able to approach, see `RoomState.goals`."""
    goals = []
    for p in group:
        if p.y > 0 or not p.piece.solid:
            continue
        if p.piece.category != "chair" and not (p.piece.front_m > 0 or p.piece.receptacles):
            continue
        faced = p.piece.category != "chair" and used_from_front(p.piece.category)
        goals.append((front_strip(p, 0.002) if faced else footprint(p), reach_m(p.piece.category)))
    return goals


def _outline(p: Placed) -> BaseGeometry:
    """Return the footprint of a piece's collision shapes on the floor."""
    import shapely

    heading = p.quarter * np.pi / 2 + p.yaw
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])  # row vectors (x, z); +z turns towards +x, as in `turned`
    return shapely.transform(p.piece.outline, lambda xz: xz @ turn + (p.x, p.z))


def _bare_floor(state: RoomState) -> BaseGeometry:
    """Return the floor between the walls, extended through the doorways."""
    import shapely

    floor = [shapely.box(*state.interior)]
    for side, o in state.doors:
        # The disc must be able to stand in the doorway, so the floor extends through it by more than the radius.
        along = np.array(strip(state.interior, side, *o.span, 0.1))
        out = np.array([(0, -1, 0, 0), (-1, 0, 0, 0), (0, 0, 0, 1), (0, 0, 1, 0)][side]) * 0.5
        floor.append(shapely.box(*(along + out)))
    return shapely.union_all(floor)


def pockets(free: BaseGeometry, wide: BaseGeometry) -> list[BaseGeometry]:
    """Return parts of the free floor that a disc of width 2 r - 5 cm can enter and one of width 2 r + 10 cm cannot.

    ``wide`` is ``free`` shrunk by the radius of the wider disc.
    """
    import shapely

    narrow = free.buffer(-GAP_BAND[0] / 2, quad_segs=8)
    # Mitred, so that right-angled corners count as reached; the limit prevents it from bridging a tight passage.
    step = (GAP_BAND[1] - GAP_BAND[0]) / 2 + 0.008
    with np.errstate(divide="ignore", invalid="ignore"):  # GEOS divides by zero for parallel edges, then falls back
        reached = wide.buffer(step, quad_segs=8, join_style="mitre", mitre_limit=1.45)
    return [part for part in shapely.get_parts(narrow.difference(reached)) if part.area > CRUMB_M2]


def walkable(state: RoomState, extra: Sequence[Placed] = ()) -> bool:
    """Return whether agents can still walk through the room with ``extra`` furniture added.

    For a disc of `PLAN_RADIUS`, one island of free floor must connect all doors and come close enough to all goals, and
    no gap of ambiguous width may be left.
    """
    import shapely

    free = _without(state.free, extra)
    parts = shapely.get_parts(free.buffer(-PLAN_RADIUS, quad_segs=8))
    if not len(parts):
        return False
    main = max(parts, key=lambda part: part.area)
    if add_up(part.area for part in parts) - main.area > CRUMB_M2:
        return False
    for side, o in state.doors:
        x, z = wall_point(state.interior, side, sum(o.span) / 2)
        dx, dz = turned(side, 0.0, 0.02)
        if not main.intersects(shapely.Point(x + dx, z + dz)):
            return False
    goals = [*state.goals, *_goals(extra)]
    if goals:
        edges = shapely.box(*np.array([r for r, _ in goals]).T)
        if not np.all(shapely.distance(main, edges) <= [near for _, near in goals]):
            return False
    return not pockets(free, main)


def _without(free: BaseGeometry, group: Sequence[Placed]) -> BaseGeometry:
    import shapely

    outlines = [_outline(p) for p in group if p.piece.solid and p.y == 0]
    return free.difference(shapely.union_all(outlines)) if outlines else free


def commit(state: RoomState, group: Sequence[Placed]) -> None:
    """Add a group to the room, without rugs that would leave the room or cover another rug."""
    state.free = _without(state.free, group)
    for p in group:
        if p.piece.category == "rug":
            rect = footprint(p)
            if not _inside(rect, state.interior) or any(overlap(rect, other) for other in state.rugs):
                continue
            state.rugs.append(rect)
        elif p.piece.solid and p.y == 0:
            state.solids.append(footprint(p))
            if p.piece.front_m > 0:
                state.fronts.append(front_strip(p, p.piece.front_m))
        state.placed.append(p)
    state.goals += _goals(group)
