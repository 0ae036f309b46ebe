"""Walls, ceiling, windows and trim of a plan, as assets in world coordinates (their instances have identity poses)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from h3data.geometry import IDENTITY_POSE
from h3data.scene.records import Asset, Box
from h3data_homes.floors import TILE_M
from h3data_homes.layout import WALL_HEIGHT, WALL_THICKNESS, Layout, Opening, RoomPlan
from h3data_homes.solids import Color, MeshBuilder, shade, vary
from h3data_homes.style import Style
from h3data_homes.zoning import Rect, shared_wall

_BASEBOARD_HEIGHT, _BASEBOARD_DEPTH, _CASING_WIDTH = 0.09, 0.012, 0.07


@dataclass(frozen=True)
class WallBox:
    """Solid piece of a wall as a plan rectangle and a range of heights [m]."""

    rect: Rect
    bottom: float
    top: float


def plan_box(axis: int, along: tuple[float, float], across: tuple[float, float]) -> Rect:
    """Return the plan rectangle of a span along an axis (0 = x, 1 = z) and a span across it [m]."""
    if axis == 0:
        return along[0], across[0], along[1], across[1]
    return across[0], along[0], across[1], along[1]


def wall_thickness_span(layout: Layout, opening: Opening) -> tuple[float, float]:
    """Return the coordinates of both faces of the wall that an opening cuts, on the axis across the wall [m]."""
    if len(opening.rooms) == 2 or opening.line not in (0.0, (layout.depth, layout.width)[opening.axis]):
        return opening.line - WALL_THICKNESS / 2, opening.line + WALL_THICKNESS / 2
    return (-WALL_THICKNESS, 0.0) if opening.line == 0 else (opening.line, opening.line + WALL_THICKNESS)


def _inner_walls(layout: Layout) -> list[tuple[int, float, float, float]]:
    """Return (axis, line, low, high) of inner walls and of walls facing notches, centred on their line as well.

    Neighbours on one line are merged; ends stop at walls that cross them.
    """
    pieces: dict[tuple[int, float], list[tuple[float, float]]] = {}
    rects = [*(r.rect for r in layout.rooms), *layout.notches]
    for i, a in enumerate(rects[: len(layout.rooms)]):
        for b in rects[i + 1 :]:
            wall = shared_wall(a, b)
            if wall is not None:
                pieces.setdefault(wall[:2], []).append(wall[2:])
    merged = []
    for (axis, line), spans in sorted(pieces.items()):
        runs: list[list[float]] = []
        for low, high in sorted(spans):
            if runs and low <= runs[-1][1] + 1e-9:
                runs[-1][1] = max(runs[-1][1], high)
            else:
                runs.append([low, high])
        end = (layout.width, layout.depth)[axis]
        for low, high in runs:
            trimmed = low + (WALL_THICKNESS / 2 if low > 0 else 0), high - (WALL_THICKNESS / 2 if high < end else 0)
            merged.append((axis, line, *trimmed))
    return merged


def wall_runs(layout: Layout) -> list[tuple[int, float, tuple[float, float], tuple[float, float]]]:
    """Return (axis, line, span along, span across) of every wall [m]; outer walls along x include the corners."""
    t = WALL_THICKNESS
    runs = [(axis, line, (low, high), (line - t / 2, line + t / 2)) for axis, line, low, high in _inner_walls(layout)]
    for axis, line, span in _outer_walls(layout):
        runs.append((axis, line, span, (line, line + t) if line else (-t, 0.0)))
    return runs


def _outer_walls(layout: Layout) -> list[tuple[int, float, tuple[float, float]]]:
    """Return (axis, line, span) of the walls on the bounding box; those along x include its corners."""
    t, walls = WALL_THICKNESS, []
    for axis, line in ((0, 0.0), (0, layout.depth), (1, 0.0), (1, layout.width)):
        end = (layout.width, layout.depth)[axis]
        missing = sorted((n[axis], n[axis + 2]) for n in layout.notches if line in (n[1 - axis], n[3 - axis]))
        at = 0.0
        for low, high in [*missing, (end, end)]:
            if low > at:
                corner = t if axis == 0 else 0.0
                walls.append((axis, line, (at - (t / 2 if at else corner), low + (t / 2 if low < end else corner))))
            at = high
    return walls


def wall_boxes(layout: Layout) -> list[WallBox]:
    """Return the solid boxes of all walls, including lintels above openings and parapets below windows."""
    boxes = []
    for axis, line, along, across in wall_runs(layout):
        cuts = [o for o in layout.openings if o.axis == axis and abs(o.line - line) < 1e-9]
        cuts = sorted((o for o in cuts if along[0] - 1e-6 <= o.span[0] <= along[1]), key=lambda o: o.span)
        at = along[0]
        for o in cuts:
            boxes.append(WallBox(plan_box(axis, (at, o.span[0]), across), 0.0, WALL_HEIGHT))
            boxes.append(WallBox(plan_box(axis, o.span, across), o.height[1], WALL_HEIGHT))
            if o.height[0] > 0:
                boxes.append(WallBox(plan_box(axis, o.span, across), 0.0, o.height[0]))
            at = o.span[1]
        boxes.append(WallBox(plan_box(axis, (at, along[1]), across), 0.0, WALL_HEIGHT))
    return [b for b in boxes if b.rect[2] - b.rect[0] > 1e-6 and b.rect[3] - b.rect[1] > 1e-6]


def box_shape(low: Iterable[float], high: Iterable[float]) -> Box:
    """Return a collision box between two corners."""
    a, b = np.array(list(low), float), np.array(list(high), float)
    pose = IDENTITY_POSE.copy()
    pose[:3] = (a + b) / 2
    return Box(pose=pose, half_extents=(b - a) / 2)


_Piece = tuple[float, float, float, float]  # u0 y0 u1 y1 on a wall's face


def _pieces(low: float, high: float, openings: Iterable[Opening]) -> list[_Piece]:
    """Return the rectangles of a wall face between two ends, minus its openings."""
    out, at = [], low
    for o in sorted(openings, key=lambda o: o.span):
        out += [(at, 0.0, o.span[0], WALL_HEIGHT), (o.span[0], o.height[1], o.span[1], WALL_HEIGHT)]
        if o.height[0] > 0:
            out.append((o.span[0], 0.0, o.span[1], o.height[0]))
        at = o.span[1]
    out.append((at, 0.0, high, WALL_HEIGHT))
    return [p for p in out if p[2] - p[0] > 1e-6]


def face_quad(axis: int, at: float, outward: int, piece: _Piece) -> list[tuple[float, float, float]]:
    """Return the corners of a wall-face piece; ``outward`` is the sign of its normal along the axis across the wall."""
    u0, y0, u1, y1 = piece
    ring = [(u0, y0), (u1, y0), (u1, y1), (u0, y1)]
    if (outward > 0) == (axis == 1):
        ring = ring[::-1]
    return [(u, y, at) if axis == 0 else (at, y, u) for u, y in ring]


def room_sides(layout: Layout, room: RoomPlan) -> list[tuple[int, float, int, float, float, list[Opening]]]:
    """Return the four wall faces of a room as (axis, face, inward sign, low, high, openings)."""
    sides = []
    for axis in (0, 1):
        across = 1 - axis
        for end, sign in ((across, 1), (across + 2, -1)):
            line, face = room.rect[end], room.interior[end]
            cuts = [o for o in layout.openings if o.axis == axis and abs(o.line - line) < 1e-9 and room.name in o.rooms]
            sides.append((axis, face, sign, room.interior[axis], room.interior[axis + 2], cuts))
    return sides


def _below_above(pieces: list[_Piece], height: float) -> tuple[list[_Piece], list[_Piece]]:
    """Return the parts of the pieces below a height and those above it."""
    below = [(u0, y0, u1, min(y1, height)) for u0, y0, u1, y1 in pieces if y0 < height]
    above = [(u0, max(y0, height), u1, y1) for u0, y0, u1, y1 in pieces if y1 > height]
    return below, above


def walls_asset(layout: Layout, style: Style) -> Asset:
    """Return an asset of all walls, painted per room and tiled up to 1.5 m in bathrooms, with collision boxes."""
    mesh = MeshBuilder()
    for room in layout.rooms:
        paint = style.paint[room.name]
        for axis, face, sign, low, high, openings in room_sides(layout, room):
            pieces = _pieces(low, high, openings)
            if room.category == "bathroom":
                tiles, pieces = _below_above(pieces, 5 * TILE_M)
                mesh.quads([face_quad(axis, face, sign, t) for t in tiles], style.wall_tile)
            mesh.quads([face_quad(axis, face, sign, p) for p in pieces], paint)
    _facade(mesh, layout, style)
    for opening in layout.openings:
        _reveal(mesh, layout, opening, style.trim)
    for axis, _, along, across in wall_runs(layout):
        x0, z0, x1, z1 = plan_box(axis, along, across)
        top = [(x0, WALL_HEIGHT, z1), (x1, WALL_HEIGHT, z1), (x1, WALL_HEIGHT, z0), (x0, WALL_HEIGHT, z0)]
        mesh.quads([top], style.wall_top)
    shapes = tuple(
        box_shape((b.rect[0], b.bottom, b.rect[1]), (b.rect[2], b.top, b.rect[3])) for b in wall_boxes(layout)
    )
    return Asset(name="walls", mesh=mesh.mesh(), category="wall", shapes=shapes)


def _facade(mesh: MeshBuilder, layout: Layout, style: Style) -> None:
    """Add the outdoor faces of the walls on the bounding box and around the notches."""
    t = WALL_THICKNESS
    outside = [o for o in layout.openings if len(o.rooms) == 1]
    for axis, line, span in _outer_walls(layout):
        corner = t if axis == 1 else 0.0
        end = (layout.width, layout.depth)[axis]
        low, high = span[0] - (corner if span[0] == 0 else 0), span[1] + (corner if span[1] == end else 0)
        cuts = [o for o in outside if o.axis == axis and o.line == line and low < o.span[0] < high]
        pieces = _pieces(low, high, cuts)
        mesh.quads([face_quad(axis, line + t if line else -t, 1 if line else -1, p) for p in pieces], style.facade)
    for notch in layout.notches:
        for axis in (0, 1):
            end = (layout.width, layout.depth)[axis]
            low, high = (
                v + s * t / 2 if 0 < v < end else v - s * t for v, s in ((notch[axis], 1), (notch[axis + 2], -1))
            )
            for line, sign in ((notch[1 - axis], 1), (notch[3 - axis], -1)):
                if line in (0.0, (layout.depth, layout.width)[axis]):
                    continue
                cuts = [o for o in outside if o.axis == axis and abs(o.line - line) < 1e-9 and low < o.span[0] < high]
                pieces = _pieces(low, high, cuts)
                mesh.quads([face_quad(axis, line + sign * t / 2, sign, p) for p in pieces], style.facade)


def _reveal(mesh: MeshBuilder, layout: Layout, opening: Opening, color: Color) -> None:
    """Add the faces of an opening through the thickness of the wall."""
    c0, c1 = wall_thickness_span(layout, opening)
    (u0, u1), (y0, y1) = opening.span, opening.height
    across = 1 - opening.axis
    mesh.quads([face_quad(across, u0, 1, (c0, y0, c1, y1)), face_quad(across, u1, -1, (c0, y0, c1, y1))], color)
    x0, z0, x1, z1 = plan_box(opening.axis, opening.span, (c0, c1))
    mesh.quads([[(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)]], color)
    if y0 > 0:
        mesh.quads([[(x0, y0, z1), (x1, y0, z1), (x1, y0, z0), (x0, y0, z0)]], color)


def ceiling_asset(layout: Layout, style: Style) -> Asset:
    """Return a ceiling slab over the whole home, or one per room if the footprint has notches.

    Its layer should be hidden in views from above.
    """
    mesh = MeshBuilder()
    whole = (0.0, 0.0, layout.width, layout.depth)
    for rect in [r.rect for r in layout.rooms] if layout.notches else [whole]:
        low = [v - (WALL_THICKNESS if v == 0 else WALL_THICKNESS / 2) for v in rect[:2]]
        high = [v + (WALL_THICKNESS if v == whole[2 + i] else WALL_THICKNESS / 2) for i, v in enumerate(rect[2:])]
        mesh.span((low[0], WALL_HEIGHT, low[1]), (high[0], WALL_HEIGHT + 0.1, high[1]), style.ceiling)
    return Asset(name="ceiling", mesh=mesh.mesh(), category="ceiling")


def trim_asset(layout: Layout, style: Style) -> Asset:
    """Build baseboards along the walls and casings around the doors."""
    mesh = MeshBuilder()
    for room in layout.rooms:
        for axis, face, sign, low, high, openings in room_sides(layout, room):
            doors = [o for o in openings if o.height[0] == 0]
            depth = (face, face + sign * _BASEBOARD_DEPTH)
            ends = [low, *(v for o in sorted(doors, key=lambda o: o.span) for v in o.span), high]
            for i in range(0, len(ends), 2):
                a = ends[i] + (_CASING_WIDTH if i > 0 else 0)
                b = ends[i + 1] - (_CASING_WIDTH if i + 2 < len(ends) else 0)
                if b - a > 0.01:
                    wall_bar(mesh, axis, (a, b), depth, (0.0, _BASEBOARD_HEIGHT), style.trim)
            for o in doors:
                _casing(mesh, axis, o, (face, face + sign * 0.016), style.trim)
    return Asset(name="trim", mesh=mesh.mesh(), category="trim")


def wall_bar(
    mesh: MeshBuilder,
    axis: int,
    along: tuple[float, float],
    across: tuple[float, float],
    height: tuple[float, float],
    color: Color,
) -> None:
    """Add a box along a wall to a mesh, given its range along the wall, across it, and in height."""
    x0, z0, x1, z1 = plan_box(axis, along, (min(across), max(across)))
    mesh.span((x0, height[0], z0), (x1, height[1], z1), color)


def _casing(mesh: MeshBuilder, axis: int, o: Opening, across: tuple[float, float], color: Color) -> None:
    w, top = _CASING_WIDTH, o.height[1]
    wall_bar(mesh, axis, (o.span[0] - w, o.span[0]), across, (0.0, top), color)
    wall_bar(mesh, axis, (o.span[1], o.span[1] + w), across, (0.0, top), color)
    wall_bar(mesh, axis, (o.span[0] - w, o.span[1] + w), across, (top, top + w), color)


def window_asset(layout: Layout, opening: Opening, index: int, style: Style) -> Asset:
    """Return a window with a frame, sky-coloured panes and an inner sill."""
    mesh = MeshBuilder()
    c0, c1 = wall_thickness_span(layout, opening)
    into = 1 if layout.room(opening.rooms[0]).rect[1 - opening.axis] == opening.line else -1
    inner, outer = (c1, c0) if into > 0 else (c0, c1)
    (u0, u1), (y0, y1) = opening.span, opening.height
    middle, bar = (c0 + c1) / 2, 0.045
    frame = (middle - 0.03, middle + 0.03)
    posts = [u0, (u0 + u1) / 2 - bar / 2, u1 - bar] if u1 - u0 > 0.8 else [u0, u1 - bar]
    for u in posts:
        wall_bar(mesh, opening.axis, (u, u + bar), frame, (y0 + bar, y1 - bar), style.trim)
    wall_bar(mesh, opening.axis, (u0, u1), frame, (y0, y0 + bar), style.trim)
    wall_bar(mesh, opening.axis, (u0, u1), frame, (y1 - bar, y1), style.trim)
    wall_bar(mesh, opening.axis, (u0, u1), (middle - 0.005, middle + 0.005), (y0 + bar, y1 - bar), style.glass)
    wall_bar(
        mesh, opening.axis, (u0 - 0.05, u1 + 0.05), (inner, inner + into * 0.06), (y0 - 0.03, y0 + 0.004), style.trim
    )
    x0, z0, x1, z1 = plan_box(opening.axis, opening.span, (min(inner, outer), max(inner, outer)))
    shape = box_shape((x0, y0, z0), (x1, y1, z1))
    return Asset(name=f"window_{index}", mesh=mesh.mesh(), category="window", shapes=(shape,))


def balustrade_asset(layout: Layout, opening: Opening, index: int, style: Style) -> Asset:
    """Return a handrail on the parapet of a balcony."""
    mesh = MeshBuilder()
    c0, c1 = wall_thickness_span(layout, opening)
    middle, (u0, u1), y = (c0 + c1) / 2, opening.span, opening.height[0]
    wall_bar(mesh, opening.axis, (u0, u1), (middle - 0.08, middle + 0.08), (y, y + 0.03), style.wood_dark)
    return Asset(name=f"balustrade_{index}", mesh=mesh.mesh(), category="trim")


def entrance_asset(layout: Layout, opening: Opening, style: Style, name: str = "front_door") -> Asset:
    """Return the closed front door, or the closed door of a garage."""
    mesh = MeshBuilder()
    c0, c1 = wall_thickness_span(layout, opening)
    middle = (c0 + c1) / 2
    (u0, u1), (_, y1) = opening.span, opening.height
    wall_bar(mesh, opening.axis, (u0, u1), (middle - 0.025, middle + 0.025), (0.0, y1), style.front_door)
    for low, high in ((0.18, 0.95), (1.1, y1 - 0.18)):
        wall_bar(
            mesh,
            opening.axis,
            (u0 + 0.15, u1 - 0.15),
            (middle - 0.034, middle + 0.034),
            (low, high),
            shade(style.front_door, 1.12),
        )
    wall_bar(mesh, opening.axis, (u0 + 0.05, u0 + 0.09), (middle - 0.075, middle + 0.075), (0.98, 1.06), style.metal)
    wall_bar(
        mesh, opening.axis, (u0, u1), (c0, c1), (-0.02, 0.004), style.metal
    )  # threshold: closes the gap under the door
    x0, z0, x1, z1 = plan_box(opening.axis, opening.span, (c0, c1))
    return Asset(name=name, mesh=mesh.mesh(), category="door", shapes=(box_shape((x0, 0, z0), (x1, y1, z1)),))


def blind_asset(layout: Layout, opening: Opening, index: int, style: Style, rng: np.random.Generator) -> Asset:
    """Return a partly lowered roller blind over a window."""
    mesh = MeshBuilder()
    room = layout.room(opening.rooms[0])
    across = 1 - opening.axis
    low = room.rect[across] == opening.line
    face, into = room.interior[across] if low else room.interior[across + 2], 1 if low else -1
    (u0, u1), (y0, y1) = opening.span, opening.height
    top, down = y1 + 0.11, rng.uniform(0.1, 0.5) * (y1 - y0)
    cloth = vary(rng, shade(style.fabric_2, 1.25), 0.05)
    wall_bar(mesh, opening.axis, (u0 - 0.06, u1 + 0.06), (face, face + into * 0.07), (top - 0.07, top), style.trim)
    wall_bar(
        mesh,
        opening.axis,
        (u0 - 0.04, u1 + 0.04),
        (face + into * 0.03, face + into * 0.034),
        (y1 - down, top - 0.03),
        cloth,
    )
    hem = (face + into * 0.026, face + into * 0.038)
    wall_bar(mesh, opening.axis, (u0 - 0.04, u1 + 0.04), hem, (y1 - down - 0.02, y1 - down), style.trim)
    return Asset(name=f"blind_{index}", mesh=mesh.mesh(), category="blind")
