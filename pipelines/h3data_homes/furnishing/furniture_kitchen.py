"""Models of kitchen modules and of the dining set for generated homes.

The modules are 600 mm deep and have the same worktop height, so that they line up.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np

from h3data.scene.records import Shape
from h3data_homes.furnishing.furniture import (
    Furniture,
    box_part,
    cabinet_front,
    cylinder_part,
    finish,
    legs,
    surface,
)
from h3data_homes.furnishing.opening.pieces import opening_cabinet, opening_counter, opening_fridge
from h3data_homes.furnishing.opening.placing import Opening
from h3data_homes.layout import WALL_HEIGHT
from h3data_homes.solids import MeshBuilder, shade, turn_x, vary
from h3data_homes.style import Style

MODULE_DEPTH, WORKTOP_HEIGHT = 0.6, 0.9
FRIDGE_WIDTH, STOVE_WIDTH, SINK_WIDTH, DISHWASHER_WIDTH = 0.68, 0.6, 0.8, 0.6
_FRONT_Z = MODULE_DEPTH / 2 - 0.04


def _base(mesh: MeshBuilder, width: float, style: Style) -> None:
    mesh.span(
        (-width / 2, 0.1, -MODULE_DEPTH / 2), (width / 2, WORKTOP_HEIGHT - 0.04, _FRONT_Z), shade(style.front, 0.9)
    )
    mesh.span((-width / 2, 0, -MODULE_DEPTH / 2), (width / 2, 0.1, _FRONT_Z - 0.05), (60, 58, 56))


def counter(
    rng: np.random.Generator, style: Style, width: float, kind: Literal["drawers", "doors", "sink"] = "doors"
) -> Furniture:
    """Return a base cabinet with its section of worktop; kind ``sink`` has a basin and a tap."""
    mesh, half = MeshBuilder(), width / 2
    _base(mesh, width, style)
    low, high = 0.1, WORKTOP_HEIGHT - 0.04
    colors = [style.front] * 3
    if kind == "drawers":
        for a, b in ((0.1, 0.36), (0.36, 0.62), (0.62, high)):
            cabinet_front(mesh, (-half, half), (a, b), _FRONT_Z, style.front, style.metal)
    else:
        parts = 2 if width > 0.62 else 1
        colors = [vary(rng, style.front, 0.01) for _ in range(parts)]
        for i in range(parts):
            x = (-half + i * width / parts, -half + (i + 1) * width / parts)
            cabinet_front(
                mesh,
                x,
                (low, high),
                _FRONT_Z,
                colors[i],
                style.metal,
                knob="right" if i == 0 else "left",
            )
    shapes: list[Shape] = [box_part((0, WORKTOP_HEIGHT / 2, 0), (width, WORKTOP_HEIGHT, MODULE_DEPTH))]
    y, back, front = WORKTOP_HEIGHT, -MODULE_DEPTH / 2, MODULE_DEPTH / 2
    if kind != "sink":
        mesh.span((-half, y - 0.04, back), (half, y, front), style.worktop)
        top = surface("top", (0, y, 0.02), (width - 0.04, MODULE_DEPTH - 0.12), 0.5)

        def opening(number: int) -> Opening:
            # the first cupboard as wide as a dishwasher is one
            inside = "dishwasher" if kind == "doors" and width == DISHWASHER_WIDTH and not number else kind
            return opening_counter(size, _FRONT_Z, colors, style.metal, style.worktop, kind=inside, top=top)

        size = width, y, MODULE_DEPTH
        return finish("kitchen_counter", mesh, size, shapes=shapes, receptacles=[top], front=0.75, opens=opening)
    _sink(mesh, half, style)
    left = 2 * half - 0.5
    top = surface("top", (-half + left / 2, y, 0.02), (left - 0.06, MODULE_DEPTH - 0.12), 0.5)

    def opening_sink(number: int) -> Opening:
        looks = MeshBuilder()
        _sink(looks, half, style)
        return opening_counter(size, _FRONT_Z, colors, style.metal, style.worktop, kind=kind, top=top, looks=looks)

    size = width, y, MODULE_DEPTH
    # For collision, the cabinet is solid and the basin filled up to the worktop.
    return finish("kitchen_counter", mesh, size, shapes=shapes, receptacles=[top], front=0.75, opens=opening_sink)


def _sink(mesh: MeshBuilder, half: float, style: Style) -> None:
    """Add a worktop with a basin and a tap."""
    y, back, front = WORKTOP_HEIGHT, -MODULE_DEPTH / 2, MODULE_DEPTH / 2
    x0, x1, z0, z1, deep = half - 0.5, half - 0.08, -0.17, 0.2, 0.16
    for a, b in (
        ((-half, back), (x0, front)),
        ((x1, back), (half, front)),
        ((x0, back), (x1, z0)),
        ((x0, z1), (x1, front)),
    ):
        mesh.span((a[0], y - 0.04, a[1]), (b[0], y, b[1]), style.worktop)
    steel, bottom = style.metal, y - deep
    mesh.quads([[(x0, bottom, z1), (x1, bottom, z1), (x1, bottom, z0), (x0, bottom, z0)]], shade(steel, 0.85))
    ring = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
    for (ax, az), (bx, bz) in zip(ring, ring[1:] + ring[:1], strict=True):
        rim = y - 0.04  # below the edges of the worktop
        mesh.quads([[(ax, bottom, az), (bx, bottom, bz), (bx, rim, bz), (ax, rim, az)]], shade(steel, 0.95))
    middle = (x0 + x1) / 2
    mesh.cylinder((middle, bottom + 0.003, 0.01), 0.03, 0.004, style.black, segments=12)
    mesh.cylinder((middle, y + 0.13, -0.22), 0.014, 0.26, steel, segments=10)
    mesh.cylinder((middle, y + 0.255, -0.145), 0.011, 0.17, steel, segments=8, turn=turn_x(np.pi / 2))
    mesh.cylinder((middle, y + 0.235, -0.065), 0.011, 0.05, steel, segments=8)
    mesh.box((middle + 0.035, y + 0.05, -0.22), (0.06, 0.014, 0.014), steel)


def stove(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a kitchen module with oven and hob."""
    mesh, w, y = MeshBuilder(), STOVE_WIDTH, WORKTOP_HEIGHT
    body = style.white if rng.random() < 0.5 else (150, 153, 156)
    mesh.span((-w / 2, 0.08, -MODULE_DEPTH / 2), (w / 2, y - 0.02, _FRONT_Z), body)
    mesh.span((-w / 2 + 0.01, 0, -MODULE_DEPTH / 2), (w / 2 - 0.01, 0.08, _FRONT_Z - 0.05), (60, 58, 56))
    mesh.span((-w / 2, y - 0.02, -MODULE_DEPTH / 2), (w / 2, y, MODULE_DEPTH / 2), style.black, bevel=0.003)
    mesh.span((-w / 2 + 0.02, 0.12, _FRONT_Z), (w / 2 - 0.02, 0.7, _FRONT_Z + 0.02), shade(body, 0.95), bevel=0.004)
    mesh.span((-w / 2 + 0.08, 0.22, _FRONT_Z + 0.02), (w / 2 - 0.08, 0.58, _FRONT_Z + 0.023), (46, 48, 54))
    mesh.box((0, 0.66, _FRONT_Z + 0.045), (0.42, 0.018, 0.018), style.metal)
    for i in range(4):
        mesh.cylinder(
            (-0.18 + 0.12 * i, 0.79, _FRONT_Z + 0.012), 0.02, 0.026, style.black, segments=10, turn=turn_x(np.pi / 2)
        )
    for x, z, r in ((-0.14, -0.12, 0.09), (0.14, -0.12, 0.075), (-0.14, 0.13, 0.075), (0.14, 0.13, 0.1)):
        mesh.cylinder((x, y + 0.002, z), r, 0.004, (70, 70, 74), segments=20)
        mesh.cylinder((x, y + 0.0045, z), r * 0.75, 0.001, (52, 52, 56), segments=20)
    shape = box_part((0, y / 2, 0), (w, y, MODULE_DEPTH))
    return finish("stove", mesh, (w, y, MODULE_DEPTH), shapes=[shape], front=0.75)


def fridge(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a fridge-freezer of random height and colour."""
    mesh, w, h, d = MeshBuilder(), FRIDGE_WIDTH, rng.uniform(1.75, 1.95), 0.64
    body = vary(rng, [(236, 237, 238), (172, 176, 180), (62, 66, 72)][int(rng.integers(3))], 0.02)
    mesh.span((-w / 2, 0.03, -d / 2), (w / 2, h, d / 2 - 0.06), body, bevel=0.006)
    split = 0.62 * h
    for low, high in ((0.06, 0.62 * h - 0.004), (split + 0.004, h)):
        mesh.span((-w / 2, low, d / 2 - 0.055), (w / 2, high, d / 2), body, bevel=0.012)
    for low, high in ((split - 0.5, split - 0.06), (split + 0.06, split + 0.34)):
        mesh.span((-w / 2 + 0.05, low, d / 2 + 0.005), (-w / 2 + 0.075, high, d / 2 + 0.03), style.metal, bevel=0.006)
    top = surface("top", (0, h, -0.05), (w - 0.1, d - 0.2), 2.5 - h)
    shape = box_part((0, h / 2, 0), (w, h, d))
    return finish(
        "fridge",
        mesh,
        (w, h, d),
        shapes=[shape],
        receptacles=[top],
        front=0.75,
        opens=lambda _: opening_fridge((w, h, d), body, style.metal),
    )


def upper_cabinet(rng: np.random.Generator, style: Style, width: float) -> Furniture:
    """Return a wall cabinet, whose origin is on the floor below it, as for all furniture."""
    mesh, d, y0, y1 = MeshBuilder(), 0.34, 1.45, 2.15
    mesh.span((-width / 2, y0, -d / 2), (width / 2, y1, d / 2 - 0.02), shade(style.front, 0.92))
    _splashback(mesh, width, -d / 2, y0, style)
    parts = max(1, round(width / 0.45))
    colors = [vary(rng, style.front, 0.015) for _ in range(parts)]
    for i in range(parts):
        x = (-width / 2 + i * width / parts, -width / 2 + (i + 1) * width / parts)
        cabinet_front(mesh, x, (y0, y1), d / 2 - 0.02, colors[i], style.metal, knob="none")
    shape = box_part((0, (y0 + y1) / 2, 0), (width, y1 - y0, d))

    def opening(number: int) -> Opening:
        tiles = MeshBuilder()
        _splashback(tiles, width, -d / 2, y0, style)
        return opening_cabinet(width, d, (y0, y1), colors, style.metal, style.front, tiles)

    return finish("kitchen_cabinet", mesh, (width, y1, d), shapes=[shape], opens=opening)


def _splashback(mesh: MeshBuilder, width: float, z: float, top: float, style: Style) -> None:
    """Add tiles on the wall above the worktop; ``z`` is the back of the cabinet that hangs above."""
    x, y = width / 2, WORKTOP_HEIGHT
    mesh.quads([[(-x, y, z), (x, y, z), (x, top, z), (-x, top, z)]], style.wall_tile)


def hood(rng: np.random.Generator, style: Style) -> Furniture:
    """Return an extractor hood from above the stove to the ceiling, with its origin on the floor below it."""
    mesh, w, d, y0, y1 = MeshBuilder(), STOVE_WIDTH - 0.01, 0.48, 1.58, 1.64
    _splashback(mesh, STOVE_WIDTH, -d / 2, y0, style)
    steel = style.metal
    mesh.span((-w / 2, y0, -d / 2), (w / 2, y1, d / 2), steel, bevel=0.004)
    mesh.span((-w / 2 + 0.04, y0 - 0.002, -d / 2 + 0.04), (w / 2 - 0.04, y0, d / 2 - 0.04), shade(steel, 0.6))
    low, top = (w / 2, d / 2), (0.13, 0.11)
    back = -d / 2
    ring = [(-low[0], d / 2), (low[0], d / 2), (low[0], back), (-low[0], back)]
    cap = [(-top[0], back + 2 * top[1]), (top[0], back + 2 * top[1]), (top[0], back), (-top[0], back)]
    for k in range(4):
        (ax, az), (bx, bz), (cx, cz), (ex, ez) = ring[k], ring[(k + 1) % 4], cap[(k + 1) % 4], cap[k]
        mesh.quads([[(ax, y1, az), (bx, y1, bz), (cx, 1.86, cz), (ex, 1.86, ez)]], shade(steel, 0.96))
    mesh.span((-top[0], 1.86, back), (top[0], WALL_HEIGHT - 0.002, back + 2 * top[1]), steel)
    shapes = [
        box_part((0, (y0 + 1.86) / 2, 0), (w, 1.86 - y0, d)),
        box_part((0, (1.86 + WALL_HEIGHT) / 2, back + top[1]), (2 * top[0], WALL_HEIGHT - 0.01 - 1.86, 2 * top[1])),
    ]
    return finish("kitchen_cabinet", mesh, (w, WALL_HEIGHT, d), shapes=shapes)


def dining_table(rng: np.random.Generator, style: Style, seats: int = 4) -> Furniture:
    """Build a dining table for four, six or eight people."""
    mesh, h = MeshBuilder(), 0.74
    w = {8: 2.4, 6: 1.75}.get(seats) or rng.uniform(1.2, 1.4)
    d = rng.uniform(0.8, 0.9)
    boards = np.linspace(-d / 2, d / 2, 5).tolist()
    for z0, z1 in pairwise(boards):
        mesh.span((-w / 2, h - 0.035, z0), (w / 2, h, z1), vary(rng, style.wood, 0.035), bevel=0.003)
    mesh.span((-w / 2 + 0.08, h - 0.11, -d / 2 + 0.06), (w / 2 - 0.08, h - 0.035, d / 2 - 0.06), style.wood_dark)
    shapes = legs(mesh, w / 2 - 0.07, d / 2 - 0.07, h - 0.035, style.wood_dark, 0.065)
    shapes.append(box_part((0, h - 0.0175, 0), (w, 0.035, d)))
    top = surface("top", (0, h, 0), (w - 0.1, d - 0.1), 1.2)
    return finish("dining_table", mesh, (w, h, d), shapes=shapes, receptacles=[top])


def chair(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a dining chair."""
    mesh, w, d, seat, high = MeshBuilder(), 0.43, 0.47, 0.45, 0.9
    wood = style.wood
    mesh.span((-w / 2, seat - 0.03, -d / 2 + 0.03), (w / 2, seat, d / 2), wood, bevel=0.008)
    mesh.cushion((0, seat + 0.012, 0.015), (w - 0.05, 0.035, d - 0.09), style.fabric_2, radius=0.016)
    shapes = legs(mesh, w / 2 - 0.03, d / 2 - 0.05, seat - 0.03, wood, 0.036)
    for s in (-1, 1):
        mesh.box(
            (s * (w / 2 - 0.025), (seat + high) / 2 - 0.02, -d / 2 + 0.035),
            (0.034, high - seat + 0.04, 0.03),
            wood,
            bevel=0.005,
            turn=turn_x(-0.06),
        )
    for y in (0.62, 0.73, 0.845):
        mesh.box(
            (0, y, -d / 2 + 0.03 - (y - 0.67) * 0.06), (w - 0.06, 0.062, 0.018), wood, bevel=0.006, turn=turn_x(-0.06)
        )
    shapes += [
        box_part((0, seat - 0.0, 0.01), (w, 0.06, d - 0.02)),
        box_part((0, 0.69, -d / 2 + 0.03), (w, 0.46, 0.06)),
    ]
    return finish("chair", mesh, (w, high, d), shapes=shapes)


def island(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a free-standing block of cabinets, whose worktop overhangs at the back, where stools stand."""
    mesh, w, d, over = MeshBuilder(), rng.uniform(1.7, 2.2), 0.9, 0.26
    y, z0, z1 = WORKTOP_HEIGHT, -d / 2 + over, d / 2 - 0.03
    mesh.span((-w / 2, 0.1, z0), (w / 2, y - 0.04, z1 - 0.02), shade(style.front, 0.92), bevel=0.003)
    mesh.span((-w / 2 + 0.03, 0, z0 + 0.05), (w / 2 - 0.03, 0.1, z1 - 0.07), (60, 58, 56))
    mesh.span((-w / 2 - 0.01, y - 0.04, -d / 2), (w / 2 + 0.01, y, d / 2), style.worktop, bevel=0.004)
    for i in range(3):
        x = (-w / 2 + i * w / 3, -w / 2 + (i + 1) * w / 3)
        cabinet_front(mesh, x, (0.1, y - 0.04), z1 - 0.02, vary(rng, style.front, 0.01), style.metal)
    shapes: list[Shape] = [
        box_part((0, y / 2, (z0 + z1) / 2), (w, y, z1 - z0)),
        box_part((0, y - 0.02, 0), (w + 0.02, 0.04, d)),
    ]
    top = surface("top", (0, y, 0), (w - 0.1, d - 0.1), 1.0)
    return finish("kitchen_island", mesh, (w + 0.02, y, d), shapes=shapes, receptacles=[top])


def stool(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a bar stool."""
    mesh, r, h = MeshBuilder(), 0.19, 0.66
    mesh.cylinder((0, h - 0.025, 0), r, 0.05, style.fabric_2, segments=20, bevel=0.015)
    mesh.cylinder((0, h - 0.06, 0), r - 0.015, 0.02, style.wood_dark, segments=20)
    for sx in (-1, 1):
        for sz in (-1, 1):
            mesh.box((sx * 0.12, (h - 0.07) / 2, sz * 0.12), (0.03, h - 0.07, 0.03), style.wood_dark, bevel=0.004)
    for s in (-1, 1):
        mesh.box((0, 0.22, s * 0.12), (0.24, 0.02, 0.02), style.metal)
        mesh.box((s * 0.12, 0.28, 0), (0.02, 0.02, 0.24), style.metal)
    return finish("chair", mesh, (2 * r, h, 2 * r), shapes=[cylinder_part((0, h / 2, 0), r, h)])
