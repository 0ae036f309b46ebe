"""Stairwell of a home with two storeys (steps, handrails, walls, windows, ceiling), and the cellar below.

All assets are in world coordinates, like those of `h3data_homes.structure`. Their collision boxes end slightly below
the surfaces on which feet stand.
"""

from __future__ import annotations

import numpy as np

from h3data.geometry import quat_from_axis_angle
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import joined, moved
from h3data.scene.records import Asset, Box, Shape
from h3data_homes.floors import floor_mesh
from h3data_homes.layout import WALL_HEIGHT, WALL_THICKNESS, Layout, RoomPlan
from h3data_homes.materials import Finish
from h3data_homes.solids import MeshBuilder, shade, turn_x
from h3data_homes.storeys.plan import GOING_M, RISE_M, RISERS, STOREY_M, StoreyPlan, Well
from h3data_homes.structure import box_shape, face_quad, plan_box, wall_bar, wall_runs
from h3data_homes.style import Style
from h3data_homes.zoning import Rect

TOP_M = STOREY_M + WALL_HEIGHT
"""Height of the stairwell's ceiling above the ground floor [m]."""
_LINING_M = 0.004
"""Distance of the inner paint before the walls, whose other side is a facade [m]."""
_SLAB_M, _NOSE_M, _SUNK_M = 0.04, 0.02, 0.02
"""Thickness of a tread, how far it stands out over its riser, and how far below it its collision box ends."""
_RAIL_M, _RAIL_GAP_M, _RAIL_SIZE = 0.90, 0.05, (0.045, 0.05)
"""Height of the handrails above the noses, distance of their middle from the wall, width and height [m]."""
_RAIL_ENDS_M = 0.22
"""Length of the level ends of a handrail."""
_WINDOWS = ((0.7, 1.15, 2.15), (0.8, STOREY_M + 0.95, STOREY_M + 2.15))
"""Width, bottom and top of the windows in the end walls: at the lower end one each, at the upper end the higher [m]."""
_DOOR_M = 2.1


def stairwell_assets(plan: StoreyPlan, style: Style, rng: np.random.Generator) -> list[tuple[Asset, str]]:
    """Return all assets of the stairwell and the cellar, with the names of their layers."""
    well = plan.well
    return [
        (_walls(plan, style), ""),
        (_cellar(plan, style), ""),
        (Asset(name="floor_stairs", mesh=_landings(well, style, rng), category="floor"), ""),
        (_stairs(well, style), ""),
        (_handrails(well, style), ""),
        *((_window(well, k, style), "") for k in range(len(_window_places(well)))),
        (_ceiling(well, style), "ceiling"),
    ]


def _sign(well: Well) -> int:
    return 1 if well.ramp.end > well.ramp.start else -1


def riser(well: Well, k: int) -> float:
    """Return the z coordinate of riser ``k``, counted from 0 [m]."""
    return well.ramp.start + _sign(well) * (k + 0.5) * GOING_M


def _between(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a < b else (b, a)


# --- steps and floors -------------------------------------------------------------------------------------------------
def _landings(well: Well, style: Style, rng: np.random.Generator) -> Mesh:
    x0, z0, x1, z1 = well.rect
    ends = (z0, z1) if _sign(well) > 0 else (z1, z0)
    parts = []
    rects = []
    for height, end, edge in ((0.0, ends[0], riser(well, 0)), (STOREY_M, ends[1], riser(well, RISERS - 1))):
        low, high = _between(end, edge)
        rects.append((height, (x0, low, x1, high)))
    t, (below, above) = WALL_THICKNESS, well.doors  # the floor in the doorways
    rects += [(0.0, (x0 - t, below[0], x0, below[1])), (STOREY_M, (x1, above[0], x1 + t, above[1]))]
    for height, rect in rects:
        mesh = floor_mesh(RoomPlan(name="stairs", category="stairs", rect=rect, interior=rect), style, rng)
        lifted = np.eye(4)
        lifted[1, 3] = height
        parts.append(moved(mesh, lifted))
    return joined(parts)


def _stairs(well: Well, style: Style) -> Asset:
    """Return the closed steps with treads as the boards of the floor; the last one is the edge of the upper landing."""
    x0, z0, x1, z1 = well.rect
    mesh, shapes, sign = MeshBuilder(), list[Shape](), _sign(well)
    end = z1 if sign > 0 else z0
    for k in range(RISERS):
        top, front = (k + 1) * RISE_M, riser(well, k)
        back = end if k == RISERS - 1 else riser(well, k + 1)
        low, high = _between(front, back)
        mesh.span((x0, 0.0, low), (x1, top - _SLAB_M, high), style.trim)
        shapes.append(box_shape((x0, 0.0, low), (x1, top - _SUNK_M, high)))
        # the slab of the last step ends where the floor of the landing begins
        low, high = _between(front - sign * _NOSE_M, front if k == RISERS - 1 else back)
        mesh.span((x0, top - _SLAB_M, low), (x1, top, high), Finish(style.floor_wood, "wood"), bevel=0.006)
    skirt = 0.26
    _slanted(mesh, well, x0 + 0.008, (0.016, skirt), -0.02, style)
    _slanted(mesh, well, x1 - 0.008, (0.016, skirt), -0.02, style)
    return Asset(name="stairs", mesh=mesh.mesh(), category="stairs", shapes=tuple(shapes))


def _slanted(mesh: MeshBuilder, well: Well, x: float, size: tuple[float, float], above_m: float, style: Style) -> None:
    """Add a skirting board along the noses, its middle ``above_m`` over them."""
    center, length, angle = _incline(well, above_m)
    mesh.box((x, center[0], center[1]), (size[0], size[1], length), style.trim, turn=turn_x(angle))


def _incline(well: Well, above_m: float) -> tuple[tuple[float, float], float, float]:
    """Return middle (y, z), length and angle about x of a bar along the noses of all steps, ``above_m`` over them."""
    first, last = riser(well, 0), riser(well, RISERS - 1)
    rise, run = RISE_M * (RISERS - 1), abs(last - first)
    angle = -_sign(well) * float(np.arctan2(rise, run))
    return (RISE_M + rise / 2 + above_m, (first + last) / 2), float(np.hypot(rise, run)), angle


def _handrails(well: Well, style: Style) -> Asset:
    """Return a handrail on each wall, level at both ends, on brackets."""
    mesh, shapes, sign = MeshBuilder(), list[Shape](), _sign(well)
    (y, z), length, angle = _incline(well, _RAIL_M)
    (wide, high), first, last = _RAIL_SIZE, riser(well, 0), riser(well, RISERS - 1)
    for wall, into in ((well.rect[0], 1), (well.rect[2], -1)):
        x = wall + into * _RAIL_GAP_M
        mesh.box((x, y, z), (wide, high, length), style.wood_dark, bevel=0.01, turn=turn_x(angle))
        pose = np.concatenate([[x, y, z], quat_from_axis_angle(np.array([1.0, 0, 0]), angle)])
        shapes.append(Box(pose=pose, half_extents=np.array([wide, high, length]) / 2))
        for at, height in ((first, RISE_M + _RAIL_M), (last, STOREY_M + _RAIL_M)):
            away = -sign if at == first else sign
            a, b = _between(at, at + away * _RAIL_ENDS_M)
            mesh.span(
                (x - wide / 2, height - high / 2, a), (x + wide / 2, height + high / 2, b), style.wood_dark, bevel=0.01
            )
            shapes.append(box_shape((x - wide / 2, height - high / 2, a), (x + wide / 2, height + high / 2, b)))
        for share in (0.06, 0.35, 0.65, 0.94):
            at, height = first + share * (last - first), RISE_M + share * (STOREY_M - RISE_M) + _RAIL_M
            near, far = _between(wall, x)
            mesh.span((near, height - 0.06, at - 0.012), (far, height - 0.03, at + 0.012), style.metal)
    return Asset(name="handrails", mesh=mesh.mesh(), category="railing", shapes=tuple(shapes))


# --- walls ------------------------------------------------------------------------------------------------------------
def _walls(plan: StoreyPlan, style: Style) -> Asset:
    """Return the walls around the stairwell as far as the storeys have none, and paint inside all of them."""
    well, t = plan.well, WALL_THICKNESS
    x0, z0, x1, z1 = well.rect
    mesh, shapes = MeshBuilder(), list[Shape]()

    def wall(rect: Rect, bottom: float, top: float) -> None:
        low, high = (rect[0], bottom, rect[1]), (rect[2], top, rect[3])
        mesh.span(low, high, style.facade)
        shapes.append(box_shape(low, high))
        if top == TOP_M:  # seen from above without its ceiling
            y = top + 0.001
            ring = [(rect[0], y, rect[3]), (rect[2], y, rect[3]), (rect[2], y, rect[1]), (rect[0], y, rect[1])]
            mesh.quads([ring], style.wall_top)

    for a, b in _missing(plan.ground, plan.ground.width, (z0 - t, z1 + t)):
        wall((x0 - t, a, x0, b), 0.0, WALL_HEIGHT)
    wall((x0 - t, z0 - t, x0, z1 + t), WALL_HEIGHT, TOP_M)
    shift = plan.offset[1]
    for a, b in _missing(plan.upper, 0.0, (z0 - t - shift, z1 + t - shift)):
        wall((x1, a + shift, x1 + t, b + shift), 0.0, TOP_M)
    for end, holes in _end_walls(well):
        across = (end - t, end) if end == z0 else (end, end + t)
        at = 0.0
        middle = (x0 + x1) / 2
        for wide, low, high in holes:
            wall((x0, across[0], x1, across[1]), at, low)
            wall((x0, across[0], middle - wide / 2, across[1]), low, high)
            wall((middle + wide / 2, across[0], x1, across[1]), low, high)
            at = high
        wall((x0, across[0], x1, across[1]), at, TOP_M)
    _paint(mesh, well, style)
    return Asset(name="stairwell", mesh=mesh.mesh(), category="wall", shapes=tuple(shapes))


def _paint(mesh: MeshBuilder, well: Well, style: Style) -> None:
    x0, z0, x1, z1 = well.rect
    paint = next(iter(style.paint.values()))
    for x, into, (low, high), bottom in ((x0, 1, well.doors[0], 0.0), (x1, -1, well.doors[1], STOREY_M)):
        pieces = [
            (z0, 0.0, low, TOP_M),
            (high, 0.0, z1, TOP_M),
            (low, bottom + _DOOR_M, high, TOP_M),
        ]
        if bottom > 0:
            pieces.append((low, 0.0, high, bottom))
        mesh.quads([face_quad(1, x + into * _LINING_M, into, p) for p in pieces], paint)
        for u, outward in ((low, 1), (high, -1)):  # casings
            a, b = _between(u, u - outward * 0.07)
            wall_bar(mesh, 1, (a, b), (x, x + into * 0.016), (bottom, bottom + _DOOR_M), style.trim)
        span = (low - 0.07, high + 0.07)
        wall_bar(mesh, 1, span, (x, x + into * 0.016), (bottom + _DOOR_M, bottom + _DOOR_M + 0.07), style.trim)
    for end, holes in _end_walls(well):
        into, middle = (1, (x0 + x1) / 2) if end == z0 else (-1, (x0 + x1) / 2)
        pieces, at = [], 0.0
        for wide, low, high in holes:
            pieces += [(x0, at, x1, low), (x0, low, middle - wide / 2, high), (middle + wide / 2, low, x1, high)]
            at = high
        pieces.append((x0, at, x1, TOP_M))
        mesh.quads([face_quad(0, end + into * _LINING_M, into, p) for p in pieces], paint)


def _end_walls(well: Well) -> list[tuple[float, tuple[tuple[float, float, float], ...]]]:
    """Return (z of the inner face, windows) of the walls at both ends; at the lower landing there are two windows."""
    _, z0, _, z1 = well.rect
    low, high = (z0, z1) if _sign(well) > 0 else (z1, z0)
    return [(low, _WINDOWS), (high, _WINDOWS[1:])]


def _window_places(well: Well) -> list[tuple[float, tuple[float, float, float]]]:
    return [(end, hole) for end, holes in _end_walls(well) for hole in holes]


def _window(well: Well, index: int, style: Style) -> Asset:
    """Return a window in an end wall: frame, pane and sill."""
    end, (wide, low, high) = _window_places(well)[index]
    x0, z0, x1, _ = well.rect
    outer = end - WALL_THICKNESS if end == z0 else end + WALL_THICKNESS
    middle, (u0, u1) = (end + outer) / 2, ((x0 + x1 - wide) / 2, (x0 + x1 + wide) / 2)
    mesh, frame = MeshBuilder(), 0.045
    across = (middle - 0.03, middle + 0.03)
    for u in (u0, u1 - frame):
        wall_bar(mesh, 0, (u, u + frame), across, (low + frame, high - frame), style.trim)
    for y in (low, high - frame):
        wall_bar(mesh, 0, (u0, u1), across, (y, y + frame), style.trim)
    wall_bar(mesh, 0, (u0, u1), (middle - 0.005, middle + 0.005), (low + frame, high - frame), style.glass)
    into = 0.05 if end == z0 else -0.05
    wall_bar(mesh, 0, (u0 - 0.05, u1 + 0.05), (end, end + into), (low - 0.03, low + 0.004), style.trim)
    a, b = _between(end, outer)
    mesh.quads(  # reveals
        [
            face_quad(1, u0 + 0.001, 1, (a, low, b, high)),
            face_quad(1, u1 - 0.001, -1, (a, low, b, high)),
        ],
        style.trim,
    )
    shape = box_shape((u0, low, a), (u1, high, b))
    return Asset(name=f"window_stairs_{index}", mesh=mesh.mesh(), category="window", shapes=(shape,))


def _ceiling(well: Well, style: Style) -> Asset:
    x0, z0, x1, z1 = well.rect
    mesh, t = MeshBuilder(), WALL_THICKNESS
    mesh.span((x0 - t, TOP_M, z0 - t), (x1, TOP_M + 0.1, z1 + t), style.ceiling)
    return Asset(name="ceiling_stairs", mesh=mesh.mesh(), category="ceiling")


def _cellar(plan: StoreyPlan, style: Style) -> Asset:
    """Return the closed block on which the upper storey stands."""
    mesh, shapes = MeshBuilder(), list[Shape]()
    layout, (dx, dz) = plan.upper, plan.offset
    whole = (0.0, 0.0, layout.width, layout.depth)
    for rect in [r.rect for r in layout.rooms] if layout.notches else [whole]:
        low = [v - (WALL_THICKNESS if v == 0 else WALL_THICKNESS / 2) for v in rect[:2]]
        high = [v + (WALL_THICKNESS if v == whole[2 + i] else WALL_THICKNESS / 2) for i, v in enumerate(rect[2:])]
        a, b = (low[0] + dx, 0.0, low[1] + dz), (high[0] + dx, STOREY_M - 0.002, high[1] + dz)
        mesh.span(a, b, shade(style.facade, 0.86))
        shapes.append(box_shape(a, (b[0], STOREY_M - _SUNK_M, b[2])))
    return Asset(name="cellar", mesh=mesh.mesh(), category="wall", shapes=tuple(shapes))


def _missing(layout: Layout, line: float, span: tuple[float, float]) -> list[tuple[float, float]]:
    """Return parts of a span along z where a plan has no wall at x = ``line``."""
    middle = line + (WALL_THICKNESS / 2 if line else -WALL_THICKNESS / 2)
    runs = [plan_box(axis, along, across) for axis, _, along, across in wall_runs(layout)]
    covered = sorted((z0, z1) for x0, z0, x1, z1 in runs if x0 < middle < x1)
    out, at = [], span[0]
    for low, high in covered:
        if low > at + 1e-6:
            out.append((at, min(low, span[1])))
        at = max(at, high)
        if at >= span[1]:
            break
    if at < span[1] - 1e-6:
        out.append((at, span[1]))
    return [(a, b) for a, b in out if b - a > 1e-6]
