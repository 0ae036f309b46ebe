"""Models of bedroom furniture and of the desk for generated homes."""

from __future__ import annotations

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
from h3data_homes.materials import Finish
from h3data_homes.solids import MeshBuilder, shade, turn_x, vary
from h3data_homes.style import Style

DESK_DRAWERS = 0.4
"""Width of the drawers on the right of a desk, next to which a chair fits [m]."""


def bed(rng: np.random.Generator, style: Style, width: float = 1.6) -> Furniture:
    """Return a bed with its head at the back (-z) and the top of its mattress at 0.53 m."""
    mesh, length, frame = MeshBuilder(), 2.12, style.wood
    z0 = -length / 2
    mesh.span((-width / 2, 0.0, z0), (width / 2, 1.02, z0 + 0.06), frame, bevel=0.012)
    mesh.span((-width / 2 + 0.05, 0.58, z0 + 0.06), (width / 2 - 0.05, 0.98, z0 + 0.095), style.fabric_2, bevel=0.015)
    mesh.span((-width / 2, 0.12, z0 + 0.06), (width / 2, 0.32, length / 2), frame, bevel=0.012)
    for s in (-1, 1):
        for z in (z0 + 0.16, length / 2 - 0.12):
            mesh.box((s * (width / 2 - 0.1), 0.06, z), (0.07, 0.12, 0.07), style.wood_dark)
    mesh.cushion((0, 0.42, 0.03), (width - 0.04, 0.24, length - 0.12), style.linen, radius=0.05)
    cover = Finish(vary(rng, style.accent if rng.random() < 0.5 else style.fabric, 0.08), "quilt")
    mesh.cushion((0, 0.445, 0.33), (width + 0.04, 0.25, length - 0.62), cover, radius=0.06)
    mesh.cushion((0, 0.48, -0.33), (width + 0.045, 0.2, 0.26), shade(cover, 1.22), radius=0.05)
    count = 2 if width > 1.3 else 1
    for i in range(count):
        x = 0.0 if count == 1 else (i - 0.5) * width * 0.48
        mesh.pillow((x, 0.6, z0 + 0.34), (0.62, 0.2, 0.44), shade(style.linen, 1.03), turn=turn_x(0.22))
    if count == 2:
        mesh.pillow((0, 0.65, z0 + 0.5), (0.4, 0.15, 0.32), vary(rng, style.fabric_2), turn=turn_x(0.9))
    shapes = [
        box_part((0, 0.285, 0.03), (width, 0.57, length - 0.06)),
        box_part((0, 0.51, z0 + 0.03), (width, 1.02, 0.06)),
    ]
    top = surface("cover", (0, 0.575, 0.4), (width - 0.3, 1.1), 1.2)
    return finish("bed", mesh, (width + 0.04, 1.02, length), shapes=shapes, receptacles=[top], front=0.0)


def nightstand(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a nightstand of random size with two drawers."""
    mesh, w, d, h = MeshBuilder(), rng.uniform(0.4, 0.46), 0.38, rng.uniform(0.48, 0.56)
    mesh.span((-w / 2, 0.1, -d / 2), (w / 2, h - 0.02, d / 2 - 0.02), style.wood, bevel=0.004)
    mesh.span((-w / 2, h - 0.02, -d / 2), (w / 2, h, d / 2), style.wood, bevel=0.005)
    legs(mesh, w / 2 - 0.04, d / 2 - 0.06, 0.1, style.wood_dark, 0.035)
    middle = (0.1 + h) / 2
    for a, b in ((0.11, middle), (middle, h - 0.025)):
        cabinet_front(mesh, (-w / 2, w / 2), (a, b), d / 2 - 0.02, vary(rng, style.wood, 0.02), style.metal)
    # A small lamp at the back; the receptacle is in front of it.
    mesh.cylinder((0, h + 0.01, -d / 2 + 0.1), 0.055, 0.02, style.metal, segments=14)
    mesh.cylinder((0, h + 0.12, -d / 2 + 0.1), 0.01, 0.22, style.metal, segments=8)
    mesh.lathe(
        [(0.1, h + 0.18), (0.065, h + 0.34), (0, h + 0.34)], style.lampshade, segments=16, center=(0, 0, -d / 2 + 0.1)
    )
    top = surface("top", (0, h, 0.07), (w - 0.06, d - 0.2), 1.0)
    shapes: list[Shape] = [box_part((0, h / 2, 0), (w, h, d))]
    shapes += [
        cylinder_part((0, h + y, -d / 2 + 0.1), r, tall) for y, r, tall in ((0.09, 0.055, 0.18), (0.26, 0.1, 0.16))
    ]
    return finish("nightstand", mesh, (w, h + 0.34, d), shapes=shapes, receptacles=[top])


def wardrobe(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a wardrobe with two to four doors, 0.5 m each."""
    mesh, d, h = MeshBuilder(), 0.58, rng.uniform(2.0, 2.2)
    doors = int(rng.integers(2, 5))
    w = 0.5 * doors
    mesh.span((-w / 2, 0.06, -d / 2), (w / 2, h, d / 2 - 0.02), style.wood, bevel=0.004)
    mesh.span((-w / 2 + 0.02, 0, -d / 2 + 0.02), (w / 2 - 0.02, 0.06, d / 2 - 0.06), style.wood_dark)
    color = style.front if rng.random() < 0.5 else style.wood
    for i in range(doors):
        x = (-w / 2 + 0.5 * i, -w / 2 + 0.5 * (i + 1))
        cabinet_front(
            mesh,
            x,
            (0.08, h - 0.02),
            d / 2 - 0.02,
            vary(rng, color, 0.02),
            style.metal,
            knob="left" if i % 2 else "right",
        )
    shape = box_part((0, h / 2, 0), (w, h, d))
    return finish("wardrobe", mesh, (w, h, d), shapes=[shape], front=0.65)


def desk(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a desk of random size with three drawers."""
    mesh, w, d, h = MeshBuilder(), rng.uniform(1.1, 1.22), rng.uniform(0.58, 0.68), 0.74
    mesh.span((-w / 2, h - 0.03, -d / 2), (w / 2, h, d / 2), style.wood, bevel=0.006)
    drawer = DESK_DRAWERS
    mesh.span((w / 2 - drawer, 0.06, -d / 2 + 0.02), (w / 2 - 0.02, h - 0.03, d / 2 - 0.06), style.front, bevel=0.003)
    mesh.span((w / 2 - drawer + 0.02, 0, -d / 2 + 0.05), (w / 2 - 0.04, 0.06, d / 2 - 0.1), style.black)
    for i in range(3):
        y = (0.08 + i * 0.208, 0.08 + (i + 1) * 0.208)
        cabinet_front(mesh, (w / 2 - drawer, w / 2 - 0.02), y, d / 2 - 0.06, style.front, style.metal)
    shapes = [
        box_part((0, h - 0.015, 0), (w, 0.03, d)),
        box_part((w / 2 - drawer / 2, h / 2, 0), (drawer, h, d - 0.04)),
    ]
    for z in (-d / 2 + 0.05, d / 2 - 0.05):
        mesh.box((-w / 2 + 0.05, (h - 0.03) / 2, z), (0.045, h - 0.03, 0.045), style.wood_dark, bevel=0.004)
        shapes.append(box_part((-w / 2 + 0.05, (h - 0.03) / 2, z), (0.045, h - 0.03, 0.045)))
    x = -drawer / 2 + 0.05
    mesh.span((x - 0.1, h, -d / 2 + 0.08), (x + 0.1, h + 0.012, -d / 2 + 0.22), style.black, bevel=0.003)
    mesh.box((x, h + 0.09, -d / 2 + 0.12), (0.03, 0.16, 0.02), style.black)
    mesh.box((x, h + 0.29, -d / 2 + 0.14), (0.54, 0.32, 0.025), style.black, bevel=0.005)
    mesh.box((x, h + 0.29, -d / 2 + 0.1535), (0.51, 0.29, 0.002), (66, 92, 124))
    mesh.span((x - 0.2, h, 0.02), (x + 0.2, h + 0.018, 0.15), (58, 58, 62), bevel=0.004)
    shapes.append(box_part((x, h + 0.23, -d / 2 + 0.14), (0.54, 0.46, 0.05)))
    top = surface("top", (w / 2 - 0.24, h, 0.0), (0.36, d - 0.12), 1.0)
    # The height is that of the top, without the screen: a desk may stand in front of a window.
    return finish("desk", mesh, (w, h, d), shapes=shapes, receptacles=[top], front=0.0)


def chair_reach(rng: np.random.Generator) -> float:
    """Return a random distance by which a desk or dining chair is pulled out beyond the table's edge [m]."""
    return float(np.clip(rng.normal(0.30, 0.02), 0.26, 0.34))
