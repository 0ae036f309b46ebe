"""Models of living-room furniture for generated homes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from h3data.scene.records import Shape
from h3data_homes.furnishing.furniture import (
    Furniture,
    books,
    box_part,
    cabinet_front,
    cylinder_part,
    finish,
    legs,
    stacks,
    surface,
)
from h3data_homes.materials import Finish
from h3data_homes.solids import Color, MeshBuilder, shade, turn_x, turn_y, vary
from h3data_homes.style import Style


def _seat(width: float, depth: float, seats: int, rng: np.random.Generator, style: Style, category: str) -> Furniture:
    """Return an upholstered sofa or armchair with ``seats`` cushions."""
    mesh, fabric = MeshBuilder(), style.fabric if category == "sofa" else style.fabric_2
    arm, high, back = 0.17, 0.8, 0.2
    inner = width - 2 * arm
    mesh.cushion((0, 0.2, 0), (width - 0.02, 0.24, depth - 0.02), shade(fabric, 0.9), radius=0.03)
    mesh.cushion((0, 0.45, -depth / 2 + back / 2), (width, 0.7, back), fabric, radius=0.07)
    for s in (-1, 1):
        mesh.cushion((s * (width - arm) / 2, 0.35, 0.01), (arm, 0.5, depth - 0.02), fabric, radius=0.06)
    each = inner / seats
    for i in range(seats):
        x = -inner / 2 + (i + 0.5) * each
        tint = vary(rng, fabric, 0.03)
        mesh.cushion((x, 0.39, back / 2 + 0.01), (each - 0.008, 0.17, depth - back - 0.01), tint, radius=0.05)
        mesh.cushion(
            (x, 0.62, -depth / 2 + back + 0.06),
            (each - 0.02, 0.36, 0.15),
            shade(tint, 1.05),
            radius=0.065,
            turn=turn_x(-0.14),
        )
    for s in (-1, 1) if seats > 1 else (0,):
        mesh.pillow(
            (s * (inner / 2 - 0.24), 0.63, -depth / 2 + back + 0.2),
            (0.42, 0.14, 0.42),
            Finish(vary(rng, style.accent), "weave"),
            turn=turn_y(-s * 0.25) @ turn_x(np.pi / 2 - 0.35),
        )
    for sx in (-1, 1):
        for sz in (-1, 1):
            mesh.box((sx * (width / 2 - 0.1), 0.045, sz * (depth / 2 - 0.1)), (0.05, 0.09, 0.05), style.wood_dark)
    seat_depth = depth - back
    shapes: list[Shape] = [
        box_part((0, 0.24, back / 2), (inner, 0.47, seat_depth)),
        box_part((0, high / 2, -depth / 2 + back / 2), (inner, high, back)),
        *(box_part((s * (width - arm) / 2, 0.3, 0), (arm, 0.6, depth)) for s in (-1, 1)),
    ]
    seat = surface("seat", (0, 0.475, 0.22), (inner - 0.12, depth - 0.62), 0.5)
    return finish(category, mesh, (width, high, depth), shapes=shapes, receptacles=[seat], front=0.35)


def sofa(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a sofa with two or three seats."""
    seats = int(rng.integers(2, 4))
    return _seat(0.5 + 0.64 * seats + rng.uniform(0, 0.1), rng.uniform(0.88, 0.95), seats, rng, style, "sofa")


def armchair(rng: np.random.Generator, style: Style) -> Furniture:
    """Build an armchair of random size."""
    return _seat(rng.uniform(0.86, 0.95), rng.uniform(0.82, 0.88), 1, rng, style, "armchair")


def coffee_table(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a coffee table with a shelf below its top."""
    mesh = MeshBuilder()
    w, d, h = rng.uniform(0.9, 1.15), rng.uniform(0.5, 0.6), rng.uniform(0.38, 0.44)
    mesh.span((-w / 2, h - 0.035, -d / 2), (w / 2, h, d / 2), style.wood, bevel=0.008)
    mesh.span((-w / 2 + 0.06, 0.12, -d / 2 + 0.06), (w / 2 - 0.06, 0.14, d / 2 - 0.06), style.wood_dark, bevel=0.004)
    shapes = legs(mesh, w / 2 - 0.05, d / 2 - 0.05, h - 0.035, style.wood_dark)
    shapes += [box_part((0, h - 0.0175, 0), (w, 0.035, d)), box_part((0, 0.13, 0), (w - 0.12, 0.02, d - 0.12))]
    top = surface("top", (0, h, 0), (w - 0.06, d - 0.06), 1.0)
    return finish("coffee_table", mesh, (w, h, d), shapes=shapes, receptacles=[top])


def tv_stand(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a TV stand of random width."""
    mesh = MeshBuilder()
    w, d, h = rng.uniform(1.3, 1.7), 0.42, rng.uniform(0.46, 0.54)
    mesh.span((-w / 2, 0.06, -d / 2), (w / 2, h - 0.025, d / 2 - 0.02), style.wood, bevel=0.004)
    mesh.span((-w / 2, h - 0.025, -d / 2), (w / 2, h, d / 2), style.wood, bevel=0.006)
    mesh.span((-w / 2 + 0.05, 0.0, -d / 2 + 0.04), (w / 2 - 0.05, 0.06, d / 2 - 0.06), style.black)
    for i in range(3):
        a, b = -w / 2 + i * w / 3, -w / 2 + (i + 1) * w / 3
        cabinet_front(mesh, (a, b), (0.07, h - 0.03), d / 2 - 0.02, vary(rng, style.wood, 0.03), style.metal)
    side = 0.5 * w - 0.23  # beside the TV's foot and in front of its screen
    ends = [
        surface(f"top_{name}", (s * (0.2 + side / 2), h, 0.085), (side, 0.19), 0.5)
        for name, s in (("left", -1), ("right", 1))
    ]
    shape = box_part((0, h / 2, 0), (w, h, d))
    return finish("tv_stand", mesh, (w, h, d), shapes=[shape], receptacles=ends, front=0.5)


def tv(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a TV that stands on a TV stand, with its origin at its foot."""
    mesh = MeshBuilder()
    w = rng.uniform(1.0, 1.22)
    h = w * 9 / 16
    mesh.span((-0.17, 0.0, -0.09), (0.17, 0.015, 0.09), style.black, bevel=0.004)
    mesh.span((-0.03, 0.015, -0.03), (0.03, 0.12, 0.0), style.black)
    mesh.span((-w / 2, 0.07, -0.025), (w / 2, 0.07 + h, 0.015), style.black, bevel=0.006)
    mesh.span((-w / 2 + 0.015, 0.085, 0.015), (w / 2 - 0.015, 0.055 + h, 0.017), (52, 60, 74))
    shapes = [box_part((0, 0.07 + h / 2, -0.005), (w, h, 0.04)), box_part((0, 0.035, 0), (0.34, 0.07, 0.18))]
    return finish("tv", mesh, (w, h + 0.07, 0.18), shapes=shapes)


def shelf(rng: np.random.Generator, style: Style, *, stores: bool = False) -> Furniture:
    """Return an open shelf that is partly filled with books, or with boxes and jars if ``stores`` is true."""
    mesh = MeshBuilder()
    w, d, h, t = rng.uniform(0.8, 1.1), 0.32, rng.uniform(1.7, 2.0), 0.025
    wood = style.wood
    for s in (-1, 1):
        mesh.box((s * (w - t) / 2, h / 2, 0), (t, h, d), wood, bevel=0.003)
    mesh.span((-w / 2 + t, 0.05, -d / 2), (w / 2 - t, h - t, -d / 2 + 0.01), shade(wood, 0.85))
    levels = np.linspace(0.07, h - t, 6)
    receptacles, inner = [], w - 2 * t
    for i, y in enumerate(levels.tolist()):
        mesh.span((-inner / 2, y, -d / 2 + 0.01), (inner / 2, y + t, d / 2), wood, bevel=0.002)
        if i == len(levels) - 1:
            receptacles.append(surface("top", (0, y + t, 0.01), (inner - 0.06, d - 0.1), 0.4))
            continue
        room = float(levels[1] - levels[0]) - t
        split = rng.uniform(-0.1, 0.6) if i != 2 else -0.4
        filled = inner * max(0.0, split + 0.4)
        (stacks if stores else books)(
            mesh,
            rng,
            (-inner / 2 + 0.01, -inner / 2 + 0.01 + filled),
            y + t,
            (-d / 2 + 0.02, d / 2 - 0.07),
            min(0.27, room - 0.03),
        )
        if inner - filled > 0.25:
            middle = (-inner / 2 + filled + inner / 2) / 2
            receptacles.append(surface(f"level_{i}", (middle, y + t, 0.01), (inner - filled - 0.06, d - 0.08), room))
    shapes = [box_part((0, h / 2, 0), (w, h, d))] if not receptacles else _shelf_shapes(w, h, d, t, levels)
    return finish("shelf", mesh, (w, h, d), shapes=shapes, receptacles=receptacles, front=0.5)


def _shelf_shapes(w: float, h: float, d: float, t: float, levels: np.ndarray) -> list[Shape]:
    boards: list[Shape] = [box_part((0, y + t / 2, 0), (w, t, d)) for y in levels.tolist()]
    boards += [box_part((s * (w - t) / 2, h / 2, 0), (t, h, d)) for s in (-1, 1)]
    return [*boards, box_part((0, h / 2, -d / 2 + 0.005), (w, h, 0.01))]


def rug(rng: np.random.Generator, style: Style, size: tuple[float, float] | None = None) -> Furniture:
    """Return a flat rug without collision shapes, whose three borders are geometry."""
    mesh = MeshBuilder()
    w, d = size if size is not None else (rng.uniform(1.9, 2.3), rng.uniform(1.4, 1.7))
    yarn, yarn_2 = Finish(style.accent, "carpet"), Finish(style.fabric_2, "carpet")
    tints = [yarn, shade(yarn_2, 1.15), shade(yarn, 1.25), shade(Finish(style.fabric_2, "rug"), 1.3)]
    y, insets = 0.008, (0.0, 0.07, 0.14, 0.17)
    for outer, inner, tint in zip(insets, insets[1:], tints, strict=False):
        a, b = _corners(w / 2 - outer, d / 2 - outer, y), _corners(w / 2 - inner, d / 2 - inner, y)
        mesh.quads([[a[k - 1], a[k], b[k], b[k - 1]] for k in range(4)], tint)
    foot, rim = _corners(w / 2, d / 2, 0.0), _corners(w / 2, d / 2, y)
    mesh.quads([[foot[k - 1], foot[k], rim[k], rim[k - 1]] for k in range(4)], shade(tints[0], 0.8))
    x, z = w / 2 - insets[-1], d / 2 - insets[-1]
    stripes = pairwise(np.linspace(-x, x, 9).tolist())
    mesh.quads(
        [[(u, y, z), (v, y, z), (v, y, -z), (u, y, -z)] for u, v in stripes], [shade(tints[3], 0.94), tints[3]] * 4
    )
    return finish("rug", mesh, (w, 0.008, d))


def _corners(x: float, z: float, y: float) -> list[tuple[float, float, float]]:
    """Return corners of a flat rectangle about the origin, counter-clockwise from above."""
    return [(-x, y, z), (x, y, z), (x, y, -z), (-x, y, -z)]


def floor_lamp(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a floor lamp with a conical shade."""
    mesh = MeshBuilder()
    h = rng.uniform(1.5, 1.65)
    mesh.cylinder((0, 0.0125, 0), 0.15, 0.025, style.metal, bevel=0.005, segments=20)
    mesh.cylinder((0, h / 2, 0), 0.012, h, style.metal, segments=8)
    mesh.lathe([(0.19, h - 0.3), (0.13, h)], style.lampshade, segments=20)
    mesh.lathe([(0.128, h), (0.186, h - 0.3)], shade(style.lampshade, 1.05), segments=20)
    mesh.ellipsoid((0, h - 0.17, 0), (0.05, 0.06, 0.05), (255, 250, 225), segments=10, rings=6)
    shapes = [cylinder_part((0, h / 2, 0), 0.15, h)]
    return finish("floor_lamp", mesh, (0.38, h, 0.38), shapes=shapes)


def plant(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a potted plant of random height."""
    mesh = MeshBuilder()
    pot, radius, tall = rng.uniform(0.28, 0.36), rng.uniform(0.15, 0.18), rng.uniform(0.9, 1.35)
    clay = vary(rng, (196, 112, 76) if rng.random() < 0.5 else (225, 222, 214))
    mesh.lathe(
        [(0, 0), (radius * 0.72, 0), (radius, pot), (radius * 0.9, pot), (radius * 0.86, pot - 0.03), (0, pot - 0.03)],
        clay,
        segments=18,
    )
    mesh.cylinder((0, pot - 0.02, 0), radius * 0.87, 0.012, (66, 48, 36), segments=18)
    green = vary(rng, (70, 122, 62), 0.12)
    n = int(rng.integers(11, 16))
    for i in range(n):
        around, lean = 2 * np.pi * i / n + rng.uniform(-0.2, 0.2), rng.uniform(0.12, 0.75)
        length = (tall - pot) * rng.uniform(0.7, 1.0)
        _leaf(mesh, (0.0, pot - 0.02, 0.0), around, lean, length, min(0.26, radius + 0.12), vary(rng, green, 0.15))
    reach = 0.42
    shapes = [cylinder_part((0, pot / 2, 0), radius, pot), cylinder_part((0, (pot + tall) / 2, 0), 0.16, tall - pot)]
    return finish("plant", mesh, (reach, tall, reach), shapes=shapes, wall_gap=0.06)


def _leaf(
    mesh: MeshBuilder, base: tuple, around: float, lean: float, length: float, reach: float, color: tuple
) -> None:
    """Add a long leaf that rises and bends outwards by at most ``reach``, with two visible sides."""
    s = np.linspace(0, 1, 5)
    out = np.minimum(length * np.sin(lean), reach) * s**1.6
    rise = np.sqrt(np.maximum(length**2 * s**2 - out**2, 0)) * (1 - 0.18 * lean * s**2)
    width = 0.055 * np.sin(np.pi * (0.12 + 0.86 * s)) + 0.004
    c, q = np.sin(around), np.cos(around)
    middle = np.stack([base[0] + out * c, base[1] + rise, base[2] + out * q], 1)
    side = np.array([q, 0, -c]) * width[:, None]
    left, right = middle - side, middle + side
    front = [[left[i], right[i], right[i + 1], left[i + 1]] for i in range(4)]
    back = [[right[i], left[i], left[i + 1], right[i + 1]] for i in range(4)]
    mesh.quads(front, color)
    mesh.quads(np.asarray(back) - 0.0012 * np.array([c, 0, q]), shade(color, 0.85))


def picture(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a framed picture with its origin at its centre and its back at z = 0."""
    mesh = MeshBuilder()
    w, h = (rng.uniform(0.5, 0.8), rng.uniform(0.4, 0.6))[:: int(rng.choice([1, -1]))]
    mesh.span(
        (-w / 2, -h / 2, 0.002),
        (w / 2, h / 2, 0.022),
        style.wood_dark if rng.random() < 0.5 else style.black,
        bevel=0.004,
    )
    mesh.span((-w / 2 + 0.025, -h / 2 + 0.025, 0.022), (w / 2 - 0.025, h / 2 - 0.025, 0.0235), (240, 236, 226))
    a, b = w / 2 - 0.08, h / 2 - 0.08
    share = rng.uniform(-0.3, 0.2)
    sky, land = vary(rng, (170, 196, 214), 0.15), vary(rng, style.accent, 0.2)
    place, light = rng.uniform(-0.5, 0.5), vary(rng, (240, 214, 140))
    motif = (_landscape, _shapes, _mountains)[int((share + 0.3) * 6)]
    motif(mesh, (a, b), share * b, place * a, (sky, land, light))
    return finish("picture", mesh, (w, h, 0.025))


_Motif = tuple[Color, Color, Color]
"""Sky, land, light."""


def _landscape(mesh: MeshBuilder, half: tuple[float, float], horizon: float, x: float, colors: _Motif) -> None:
    """Add a sun above a plain; ``half`` is half the size of the sheet."""
    (a, b), (sky, land, light) = half, colors
    mesh.span((-a, horizon, 0.0235), (a, b, 0.0245), sky)
    mesh.span((-a, -b, 0.0235), (a, horizon, 0.0245), land)
    at = (x, horizon + (b - horizon) * 0.55, 0.0252)
    mesh.cylinder(at, 0.22 * min(a, b), 0.0014, light, segments=18, turn=turn_x(np.pi / 2))


def _shapes(mesh: MeshBuilder, half: tuple[float, float], horizon: float, x: float, colors: _Motif) -> None:
    """Add an abstract: a disc and crossing bars."""
    (a, b), (sky, land, light) = half, colors
    mesh.span((-a, -b, 0.0235), (a, b, 0.0242), shade(light, 0.98))
    r = 0.5 * min(a, b)
    mesh.cylinder((x * 0.6, horizon + 0.3 * b, 0.0246), r, 0.001, land, segments=26, turn=turn_x(np.pi / 2))
    mesh.span((-0.8 * a, -0.75 * b, 0.0246), (0.25 * a, -0.35 * b, 0.0252), shade(sky, 0.55))
    mesh.span((0.1 * a, -0.8 * b, 0.0252), (0.3 * a, 0.8 * b, 0.0256), shade(land, 0.55))


def _mountains(mesh: MeshBuilder, half: tuple[float, float], horizon: float, x: float, colors: _Motif) -> None:
    """Add two mountain ridges, one behind the other."""
    (a, b), (sky, land, light) = half, colors
    mesh.span((-a, -b, 0.0235), (a, b, 0.0242), shade(sky, 1.1))
    mesh.cylinder((-x, 0.6 * b, 0.0244), 0.14 * min(a, b), 0.001, light, segments=18, turn=turn_x(np.pi / 2))
    for top, peak, z, color in ((0.45 * b, x, 0.0248, shade(sky, 0.7)), (horizon, -0.6 * x, 0.0252, shade(land, 0.8))):
        ridge = [(-a, -0.35 * b), (peak - 0.35 * a, 0.3 * top), (peak, top), (peak + 0.3 * a, 0.1 * b), (a, -0.2 * b)]
        for (x0, y0), (x1, y1) in pairwise(ridge):
            mesh.quads([[(x0, -b, z), (x1, -b, z), (x1, y1, z), (x0, y0, z)]], color)


def console(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a shallow shoe cabinet for the hall."""
    mesh = MeshBuilder()
    w, d, h = rng.uniform(0.8, 1.1), 0.24, 0.85
    mesh.span((-w / 2, 0.05, -d / 2), (w / 2, h - 0.02, d / 2 - 0.02), style.front, bevel=0.004)
    mesh.span((-w / 2 - 0.0, h - 0.02, -d / 2), (w / 2, h, d / 2), style.wood, bevel=0.004)
    mesh.span((-w / 2 + 0.04, 0, -d / 2 + 0.03), (w / 2 - 0.04, 0.05, d / 2 - 0.05), style.wood_dark)
    for i in range(2):
        for j in range(2):
            x = (-w / 2 + i * w / 2, -w / 2 + (i + 1) * w / 2)
            y = (0.06 + j * (h - 0.09) / 2, 0.06 + (j + 1) * (h - 0.09) / 2)
            cabinet_front(mesh, x, y, d / 2 - 0.02, vary(rng, style.front, 0.02), style.metal)
    top = surface("top", (0, h, 0), (w - 0.06, d - 0.04), 1.0)
    return finish("console", mesh, (w, h, d), shapes=[box_part((0, h / 2, 0), (w, h, d))], receptacles=[top], front=0.3)


def ceiling_lamp(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a ceiling lamp, whose origin is the point at which it is fixed."""
    mesh = MeshBuilder()
    r = rng.uniform(0.16, 0.22)
    mesh.cylinder((0, -0.012, 0), 0.06, 0.024, style.metal, segments=12)
    mesh.cylinder((0, -0.05, 0), 0.01, 0.06, style.metal, segments=6)
    mesh.lathe([(0, -0.16), (r * 0.6, -0.15), (r, -0.1), (r * 0.96, -0.08), (0, -0.075)], (250, 244, 226), segments=20)
    return finish("ceiling_lamp", mesh, (2 * r, 0.16, 2 * r))


def bench(rng: np.random.Generator, style: Style) -> Furniture:
    """Return an upholstered bench without a back."""
    mesh, w, d, h = MeshBuilder(), rng.uniform(1.0, 1.4), 0.4, 0.46
    mesh.span((-w / 2, h - 0.12, -d / 2), (w / 2, h - 0.07, d / 2), style.wood_dark, bevel=0.004)
    mesh.cushion((0, h - 0.035, 0), (w - 0.02, 0.09, d - 0.02), style.fabric_2, radius=0.035)
    shapes = legs(mesh, w / 2 - 0.07, d / 2 - 0.06, h - 0.12, style.wood_dark)
    shapes.append(box_part((0, h - 0.055, 0), (w, 0.13, d)))
    top = surface("seat", (0, h + 0.012, 0), (w - 0.12, d - 0.1), 1.2)
    return finish("bench", mesh, (w, h + 0.01, d), shapes=shapes, receptacles=[top], front=0.35)
