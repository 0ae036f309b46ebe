"""Models of furniture that opens: hollow bodies with shelves inside, and doors and drawers with joints.

All coordinates are in the frame of the closed piece (`h3data_homes.furnishing.furniture`). It looks like the piece that
it replaces, and has the same footprint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from h3data.scene.records import Joint, Receptacle, Shape
from h3data_homes.furnishing.furniture import box_part, cabinet_front, surface
from h3data_homes.furnishing.opening.placing import MovingPart, Opening
from h3data_homes.solids import Color, MeshBuilder, shade

BOARD_M = 0.018
"""Thickness of side panels, shelves and fronts [m]."""
SWING_RAD = np.pi / 2
"""Angle by which doors open [rad]. Doors hinged at their outer edge then stay within their own width, so that they do
not hit their neighbours."""
PULL_SHARE = 0.8
"""Distance by which a drawer opens, as a share of its depth."""
INSIDE: Color = (232, 230, 226)
"""Colour of inner walls of fridges and dishwashers."""
_X, _Y, _Z = (np.eye(3)[k] for k in range(3))

Span = tuple[float, float]


class _Body:
    """The body of a piece under construction: boards that are seen and collide, and surfaces between them."""

    def __init__(self, mesh: MeshBuilder | None = None) -> None:
        self.mesh, self.shapes, self.surfaces = mesh or MeshBuilder(), list[Shape](), list[Receptacle]()

    def board(self, low: Sequence[float], high: Sequence[float], color: Color, *, bevel: float = 0.0) -> None:
        self.mesh.span(low, high, color, bevel=bevel)
        self.solid(low, high)

    def solid(self, low: Sequence[float], high: Sequence[float]) -> None:
        a, b = np.asarray(low, float), np.asarray(high, float)
        self.shapes.append(box_part((a + b) / 2, b - a))

    def shell(self, x: Span, y: Span, z: Span, outside: Color, inside: Color, *, wall: float = BOARD_M) -> None:
        """Build five walls around a room that is open in front, +Z."""
        (x0, x1), (y0, y1), (z0, z1) = x, y, z
        for low, high in (
            ((x0, y0, z0), (x0 + wall, y1, z1)),
            ((x1 - wall, y0, z0), (x1, y1, z1)),
            ((x0 + wall, y0, z0), (x1 - wall, y0 + wall, z1)),
            ((x0 + wall, y1 - wall, z0), (x1 - wall, y1, z1)),
            ((x0 + wall, y0 + wall, z0), (x1 - wall, y1 - wall, z0 + wall)),
        ):
            self.board(low, high, outside)
        thin = 0.001  # the lining is another colour than the outside
        a, b = (x0 + wall, y0 + wall, z0 + wall), (x1 - wall, y1 - wall, z1 - 0.002)
        for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 0)):
            low, high = list(a), list(b)
            (high if end == 0 else low)[axis] = a[axis] + thin if end == 0 else b[axis] - thin
            self.mesh.span(low, high, inside)

    def shelf(
        self, name: str, x: Span, y: float, z: Span, above: float, color: Color, *, thick: float = BOARD_M
    ) -> str:
        """Add a board with its upper side at height ``y`` and a surface on it; return the name."""
        self.board((x[0], y - thick, z[0]), (x[1], y, z[1]), color)
        return self.floor(name, x, y, z, above)

    def floor(self, name: str, x: Span, y: float, z: Span, above: float) -> str:
        """Add a surface on what is there already; return the name."""
        center = ((x[0] + x[1]) / 2, y, (z[0] + z[1]) / 2)
        self.surfaces.append(surface(name, center, (x[1] - x[0] - 0.02, z[1] - z[0] - 0.02), above))
        return name


def _door(
    name: str,
    x: Span,
    y: Span,
    z: Span,
    mesh: MeshBuilder,
    *,
    hinge: str,
    handle: Sequence[float],
    behind: Sequence[str],
) -> MovingPart:
    """Return a door whose panel fills a box, hinged at its outer ``left``, ``right`` or ``bottom`` edge."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    axis, origin = {
        "left": (-_Y, (x0, 0.0, z1)),
        "right": (_Y, (x1, 0.0, z1)),
        "bottom": (_X, (0.0, y0, z1)),
    }[hinge]
    panel = box_part(((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2), (x1 - x0, y1 - y0, z1 - z0))
    joint = Joint(kind="revolute", axis=axis, origin=np.array(origin), lower=0.0, upper=SWING_RAD)
    return MovingPart(
        name=name, builder=mesh, shapes=(panel,), joint=joint, handle=np.array(handle, float), behind=tuple(behind)
    )


def _drawer(name: str, x: Span, y: Span, z: Span, front: float, color: Color, metal: Color) -> MovingPart:
    """Return a drawer between ``z`` with its front at ``front``: things lie on its bottom."""
    (x0, x1), (y0, y1), (z0, z1), wall = x, y, z, 0.012
    inner = MeshBuilder()
    cabinet_front(inner, x, y, front, color, metal)
    low, top = y0 + 0.02, y1 - 0.05
    a, b = x0 + BOARD_M + 0.006, x1 - BOARD_M - 0.006
    wood = shade(color, 0.8)
    shapes: list[Shape] = []
    for p, q in (
        ((a, low, z0), (b, low + wall, z1)),
        ((a, low, z0), (a + wall, top, z1)),
        ((b - wall, low, z0), (b, top, z1)),
        ((a + wall, low, z0), (b - wall, top, z0 + wall)),
    ):
        inner.span(p, q, wood)
        shapes.append(box_part((np.array(p) + q) / 2, np.array(q) - p))
    shapes.append(box_part(((x0 + x1) / 2, (y0 + y1) / 2, front + 0.008), (x1 - x0 - 0.008, y1 - y0 - 0.008, 0.02)))
    bottom = surface(
        "bottom", ((a + b) / 2, low + wall, (z0 + z1) / 2), (b - a - 2 * wall - 0.02, z1 - z0 - 0.05), y1 - low - 0.03
    )
    joint = Joint(kind="prismatic", axis=_Z, lower=0.0, upper=PULL_SHARE * (z1 - z0))
    return MovingPart(
        name=name,
        builder=inner,
        shapes=tuple(shapes),
        joint=joint,
        handle=np.array([(x0 + x1) / 2, y1 - 0.05, front + 0.03]),
        receptacles=(bottom,),
    )


def _fronts(
    x: Span, y: Span, z: float, colors: Sequence[Color], metal: Color, shelves: Sequence[Sequence[str]], *, knob: bool
) -> list[MovingPart]:
    """Return the doors side by side over a width; ``shelves`` are the surfaces behind each."""
    parts, count = [], len(colors)
    for i, color in enumerate(colors):
        x0, x1 = (x[0] + (i + k) * (x[1] - x[0]) / count for k in (0, 1))
        mesh, left = MeshBuilder(), i == 0 and count > 1
        # a door opens away from its neighbour; a single one has its knob on the right, as `cabinet_front` has it
        hinge = "left" if left or count == 1 else "right"
        side = "right" if hinge == "left" else "left"
        cabinet_front(mesh, (x0, x1), y, z, color, metal, knob=side if knob else "none")
        at = x1 - 0.05 if side == "right" else x0 + 0.05
        parts.append(
            _door(
                "door" if count == 1 else f"door_{i}",
                (x0 + 0.004, x1 - 0.004),
                (y[0] + 0.004, y[1] - 0.004),
                (z, z + 0.018),
                mesh,
                hinge=hinge,
                handle=(at, (y[0] + y[1]) / 2 if knob else y[0] + 0.05, z + 0.03),
                behind=shelves[i],
            )
        )
    return parts


# --- pieces -------------------------------------------------------------------------------------------------------------
def opening_fridge(size: tuple[float, float, float], body: Color, metal: Color) -> Opening:
    """Return a fridge below a freezer, each with a door."""
    w, h, d = size
    frame, front, split, half = _Body(), d / 2 - 0.06, 0.62 * h, w / 2
    back, wall = -d / 2, 0.04
    frame.board((-half, 0.03, back), (half, 0.1, front), body)
    names: dict[str, list[str]] = {"door": [], "freezer": []}
    for part, low, high, boards in (("door", 0.1, split, 2), ("freezer", split, h, 1)):
        frame.shell((-half, half), (low, high), (back, front), body, INSIDE, wall=wall)
        inner = high - low - 2 * wall
        for i in range(boards):
            y, name = low + wall + i * inner / boards, f"{part}_shelf_{i}"
            x, z = (-half + wall, half - wall), (back + wall, front - 0.03)
            above = inner / boards - 0.02
            made = (
                frame.floor(name, x, y + 0.001, z, above)
                if i == 0
                else frame.shelf(name, x, y, z, above, (206, 214, 216), thick=0.008)
            )
            names[part].append(made)
    frame.surfaces.append(surface("top", (0, h, -0.05), (w - 0.1, d - 0.2), 2.5 - h))
    parts = []
    grips = {"door": (split - 0.5, split - 0.06), "freezer": (split + 0.06, split + 0.34)}
    for part, low, high in (("door", 0.06, split - 0.004), ("freezer", split + 0.004, h)):
        mesh, (a, b) = MeshBuilder(), grips[part]
        mesh.span((-half, low, front + 0.005), (half, high, d / 2), body, bevel=0.012)
        mesh.span((-half + 0.05, a, d / 2 + 0.005), (-half + 0.075, b, d / 2 + 0.03), metal, bevel=0.006)
        handle = (-half + 0.06, (a + b) / 2, d / 2 + 0.02)
        box = (-half, half), (low, high), (front + 0.005, d / 2)
        parts.append(_door(part, *box, mesh, hinge="right", handle=handle, behind=names[part]))
    return _opening("fridge", "fridge", frame, parts)


def _cabinet(x: Span, y: Span, z: Span, front: Color, looks: MeshBuilder | None) -> _Body:
    """Return a carcass on a plinth; for walkers it is as wide and deep as the worktop."""
    frame = _Body(looks)
    frame.shell(x, y, z, shade(front, 0.9), shade(front, 0.95))
    frame.board((x[0], 0.0, z[0]), (x[1], y[0], z[1] - 0.05), (60, 58, 56))
    return frame


def opening_counter(
    size: tuple[float, float, float],
    front: float,
    colors: Sequence[Color],
    metal: Color,
    worktop: Color,
    *,
    kind: str,
    top: Receptacle,
    looks: MeshBuilder | None = None,
) -> Opening:
    """Return a base cabinet that opens.

    Args:
        size: Width, height of the upper side and depth of the worktop [m].
        front: Position of the front of the carcass along z [m].
        colors: Colours of the fronts.
        metal: Colour of the handles.
        worktop: Colour of the worktop.
        kind: Kind of cabinet: ``drawers``, ``doors``, ``sink`` or ``dishwasher``.
        top: Receptacle on the worktop.
        looks: Mesh of a sink's worktop with basin and tap; None for a plain board.
    """
    width, height, depth = size
    half, back = width / 2, -depth / 2
    low, high = 0.1, height - 0.04
    x, z = (-half, half), (back, front)
    frame = _cabinet(x, (low, high if looks is None else high - 0.16), z, colors[0], looks)
    if looks is None:
        frame.mesh.span((-half, high, back), (half, height, depth / 2), worktop)
    else:  # the basin is filled up to the worktop, as in the piece that does not open
        frame.solid((-half, high - 0.16, back), (half, high, front))
    frame.solid((-half, high, back), (half, height, depth / 2))
    frame.surfaces.append(top)
    inside = (-half + BOARD_M, half - BOARD_M)
    deep = (back + BOARD_M, front - 0.01)
    if kind == "drawers":
        bands = ((0.1, 0.36), (0.36, 0.62), (0.62, high))
        parts = [
            _drawer(f"drawer_{2 - i}", x, band, (back + 0.04, front), front, color, metal)
            for i, (band, color) in enumerate(zip(bands, colors, strict=True))
        ][::-1]
        return _opening("kitchen_counter", "kitchen_counter", frame, parts)
    if kind == "dishwasher":
        mesh, panel = MeshBuilder(), (front, front + 0.018)
        cabinet_front(mesh, x, (low, high), front, (196, 199, 202), metal)
        handle = (0.0, high - 0.05, front + 0.03)
        door = _door(
            "door",
            (-half + 0.004, half - 0.004),
            (low, high),
            panel,
            mesh,
            hinge="bottom",
            handle=handle,
            behind=("rack/rack",),
        )
        return _opening("dishwasher", "kitchen_counter", frame, [door, _rack(inside, (low, high), deep)])
    count = len(colors)
    ceiling = high - BOARD_M if looks is None else high - 0.16 - BOARD_M
    floor = low + BOARD_M + 0.001
    middle = [] if looks is not None else [low + 0.4]
    shelves: list[list[str]] = []
    for i in range(count):  # one surface behind each door
        part = (inside[0] + i * (inside[1] - inside[0]) / count, inside[0] + (i + 1) * (inside[1] - inside[0]) / count)
        shelves.append([frame.floor(f"bottom_{i}", part, floor, deep, (middle or [ceiling])[0] - floor - 0.03)])
        if middle:
            shelves[-1].append(
                frame.floor(f"shelf_{i}", part, middle[0], (deep[0], deep[1] - 0.03), ceiling - middle[0] - 0.02)
            )
    if middle:
        frame.board(
            (inside[0], middle[0] - BOARD_M, deep[0]), (inside[1], middle[0], deep[1] - 0.03), shade(colors[0], 0.95)
        )
    parts = _fronts(x, (low, high), front, colors, metal, shelves, knob=True)
    return _opening("kitchen_counter", "kitchen_counter", frame, parts)


def _rack(x: Span, y: Span, z: Span) -> MovingPart:
    """Return the rack of a dishwasher, which slides out once the door is down."""
    mesh, (x0, x1), (z0, z1) = MeshBuilder(), (x[0] + 0.02, x[1] - 0.02), (z[0] + 0.02, z[1] - 0.02)
    low, wire = y[0] + 0.2, (150, 154, 158)
    for i in range(21):
        at = x0 + i * (x1 - x0 - 0.008) / 20
        mesh.span((at, low, z0), (at + 0.008, low + 0.008, z1), wire)
    for y0 in (low, low + 0.12):
        for a, b in (
            ((x0, z0), (x0 + 0.008, z1)),
            ((x1 - 0.008, z0), (x1, z1)),
            ((x0, z0), (x1, z0 + 0.008)),
            ((x0, z1 - 0.008), (x1, z1)),
        ):
            mesh.span((a[0], y0, a[1]), (b[0], y0 + 0.008, b[1]), wire)
    floor = box_part(((x0 + x1) / 2, low + 0.004, (z0 + z1) / 2), (x1 - x0, 0.008, z1 - z0))
    bottom = surface(
        "rack", ((x0 + x1) / 2, low + 0.008, (z0 + z1) / 2), (x1 - x0 - 0.05, z1 - z0 - 0.05), y[1] - low - 0.08
    )
    return MovingPart(
        name="rack",
        builder=mesh,
        shapes=(floor,),
        joint=Joint(kind="prismatic", axis=_Z, lower=0.0, upper=PULL_SHARE * (z1 - z0)),
        handle=np.array([(x0 + x1) / 2, low + 0.124, z1]),
        receptacles=(bottom,),
    )


def opening_cabinet(
    width: float, depth: float, y: Span, colors: Sequence[Color], metal: Color, front: Color, looks: MeshBuilder
) -> Opening:
    """Return a wall cabinet with doors and two shelves inside; ``looks`` are attached meshes, such as tiles below it."""
    frame, half = _Body(looks), width / 2
    x, z, count = (-half, half), (-depth / 2, depth / 2 - 0.02), len(colors)
    frame.shell(x, y, z, shade(front, 0.92), shade(front, 0.95))
    middle, deep = (y[0] + y[1]) / 2, (z[0] + BOARD_M, z[1] - 0.01)
    frame.board(
        (x[0] + BOARD_M, middle - BOARD_M, deep[0]), (x[1] - BOARD_M, middle, deep[1] - 0.02), shade(front, 0.95)
    )
    shelves = []
    for i in range(count):
        part = (
            x[0] + BOARD_M + i * (width - 2 * BOARD_M) / count,
            x[0] + BOARD_M + (i + 1) * (width - 2 * BOARD_M) / count,
        )
        above = middle - y[0] - 2 * BOARD_M - 0.01
        shelves.append(
            [
                frame.floor(f"bottom_{i}", part, y[0] + BOARD_M + 0.001, deep, above),
                frame.floor(f"shelf_{i}", part, middle, (deep[0], deep[1] - 0.02), above),
            ]
        )
    parts = _fronts(x, y, depth / 2 - 0.02, colors, metal, shelves, knob=False)
    return _opening("kitchen_cabinet", "kitchen_cabinet", frame, parts)


def _opening(kind: str, category: str, frame: _Body, parts: Sequence[MovingPart]) -> Opening:
    return Opening(
        kind=kind,
        category=category,
        builder=frame.mesh,
        shapes=tuple(frame.shapes),
        receptacles=tuple(frame.surfaces),
        parts=tuple(parts),
    )
