"""Models of small objects that stand on receptacles.

The asset frame has its origin at the centre of the bounding box, and +Y up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from h3data.scene.records import Asset, Hull, Shape
from h3data_homes.furnishing.furniture import box_part, cylinder_part
from h3data_homes.solids import Color, MeshBuilder, shade, vary
from h3data_homes.style import Style

_BRIGHT: tuple[Color, ...] = (
    (198, 58, 48),
    (222, 160, 52),
    (64, 122, 74),
    (52, 96, 160),
    (230, 226, 214),
    (132, 78, 140),
    (40, 150, 150),
)


def _bright(rng: np.random.Generator) -> Color:
    return vary(rng, _BRIGHT[int(rng.integers(len(_BRIGHT)))], 0.08)


def _centered(category: str, mesh: MeshBuilder, shapes: tuple[Shape, ...], height: float) -> Asset:
    """Return the asset of a model that stands at y = 0, shifted so that the origin is at half its height."""
    m = mesh.mesh()
    vertices = m.vertices - np.array([0, height / 2, 0], np.float32)
    return Asset(name=category, mesh=replace(m, vertices=vertices), category=category, shapes=shapes)


def can(rng: np.random.Generator, style: Style) -> Asset:
    """Build a drinks can with a label of random colour."""
    r, h, mesh, label = 0.033, 0.102, MeshBuilder(), _bright(rng)
    mesh.lathe([(0, 0), (r - 0.003, 0), (r, 0.004), (r, 0.012)], style.metal, segments=16)
    mesh.lathe([(r, 0.012), (r, h - 0.012)], label, segments=16)
    mesh.lathe(
        [(r, h - 0.012), (r, h - 0.004), (r - 0.003, h), (r - 0.005, h - 0.004), (0, h - 0.004)],
        style.metal,
        segments=16,
    )
    mesh.lathe([(r + 0.0004, 0.04), (r + 0.0004, 0.062)], (240, 236, 222), segments=16)
    return _centered("can", mesh, (cylinder_part((0, 0, 0), r, h),), h)


def mug(rng: np.random.Generator, style: Style) -> Asset:
    """Build a mug of random colour."""
    r, h, mesh, color = 0.041, 0.092, MeshBuilder(), _bright(rng)
    mesh.lathe(
        [(0, 0), (r - 0.004, 0), (r, 0.006), (r, h), (r - 0.005, h), (r - 0.006, 0.01), (0, 0.01)], color, segments=16
    )
    mesh.cylinder((0, h * 0.72, 0), r - 0.0055, 0.001, (70, 42, 26), segments=16)
    bend = np.linspace(-np.pi / 2, np.pi / 2, 7)
    path = np.stack([r - 0.004 + 0.028 * np.cos(bend), h / 2 + 0.027 * np.sin(bend)], 1)
    for (x0, y0), (x1, y1) in zip(path[:-1].tolist(), path[1:].tolist(), strict=True):
        angle = float(np.arctan2(x1 - x0, y1 - y0))
        c, s = np.cos(-angle), np.sin(-angle)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        length = float(np.hypot(x1 - x0, y1 - y0)) + 0.004
        mesh.box(((x0 + x1) / 2, (y0 + y1) / 2, 0), (0.008, length, 0.012), color, bevel=0.003, turn=turn)
    return _centered(
        "mug", mesh, (cylinder_part((0, 0, 0), r, h), box_part((r + 0.014, 0, 0), (0.028, 0.06, 0.014))), h
    )


def bowl(rng: np.random.Generator, style: Style) -> Asset:
    """Build a bowl of random colour."""
    r, h, mesh, color = 0.08, 0.058, MeshBuilder(), _bright(rng)
    outer = [(0, 0), (0.036, 0), (0.038, 0.006), (0.06, 0.022), (0.075, 0.042), (r, h)]
    inner = [(r - 0.004, h), (0.07, 0.043), (0.055, 0.025), (0.03, 0.012), (0, 0.01)]
    mesh.lathe(outer, color, segments=20)
    mesh.lathe([(r, h), (r - 0.004, h)], shade(color, 1.1), segments=20)
    mesh.lathe(inner, shade(color, 1.15), segments=20)
    angle = np.arange(10) * (2 * np.pi / 10)
    ring = [
        np.stack([q * np.sin(angle), np.full(10, y - h / 2), q * np.cos(angle)], 1) for q, y in ((0.038, 0.0), (r, h))
    ]
    return _centered("bowl", mesh, (Hull(points=np.concatenate(ring)),), h)


def box(rng: np.random.Generator, style: Style) -> Asset:
    """Return a cereal or cracker box with a printed front."""
    w, h, d = rng.uniform(0.12, 0.17), rng.uniform(0.18, 0.23), rng.uniform(0.05, 0.065)
    mesh, color = MeshBuilder(), _bright(rng)
    mesh.span((-w / 2, 0, -d / 2), (w / 2, h, d / 2), color, bevel=0.001)
    light = (246, 240, 222)
    for s in (-1, 1):
        z = (s * d / 2, s * (d / 2 + 0.0006))
        mesh.span((-w * 0.4, h * 0.62, min(z)), (w * 0.4, h * 0.86, max(z)), light)
        mesh.span((-w * 0.3, h * 0.14, min(z)), (w * 0.3, h * 0.48, max(z)), shade(color, 1.35))
    return _centered("box", mesh, (box_part((0, 0, 0), (w, h, d)),), h)


def bottle(rng: np.random.Generator, style: Style) -> Asset:
    """Build a bottle of random height and colour, with a label."""
    r, h, mesh = 0.034, rng.uniform(0.21, 0.25), MeshBuilder()
    color = vary(rng, [(46, 104, 66), (196, 214, 222), (110, 62, 34), (220, 190, 70)][int(rng.integers(4))])
    body = [(0, 0), (r - 0.004, 0), (r, 0.005), (r, h * 0.6), (r * 0.8, h * 0.7), (0.013, h * 0.8), (0.013, h - 0.02)]
    mesh.lathe(body, color, segments=16)
    mesh.cylinder((0, h - 0.01, 0), 0.0155, 0.02, _bright(rng), segments=12)
    mesh.lathe([(r + 0.0005, h * 0.2), (r + 0.0005, h * 0.48)], (240, 235, 220), segments=16)
    shapes = (
        cylinder_part((0, h * 0.35 - h / 2, 0), r, h * 0.7),
        cylinder_part((0, h * 0.85 - h / 2, 0), 0.016, h * 0.3),
    )
    return _centered("bottle", mesh, shapes, h)


def book(rng: np.random.Generator, style: Style) -> Asset:
    """Return a book lying flat."""
    w, d, h, mesh = rng.uniform(0.13, 0.18), rng.uniform(0.19, 0.25), rng.uniform(0.02, 0.04), MeshBuilder()
    cover = _bright(rng)
    mesh.span((-w / 2, 0, -d / 2), (w / 2, 0.003, d / 2), cover)
    mesh.span((-w / 2, h - 0.003, -d / 2), (w / 2, h, d / 2), cover)
    mesh.span((-w / 2, 0.003, -d / 2), (-w / 2 + 0.003, h - 0.003, d / 2), cover)
    mesh.span((-w / 2 + 0.003, 0.003, -d / 2 + 0.004), (w / 2 - 0.004, h - 0.003, d / 2 - 0.004), (238, 232, 214))
    mesh.span((-w * 0.3, h, d * 0.1), (w * 0.3, h + 0.0006, d * 0.3), shade(cover, 1.5))
    return _centered("book", mesh, (box_part((0, 0, 0), (w, h, d)),), h)


def _fruit(category: str, r: float, squash: float, color: Color) -> Asset:
    h, mesh = 2 * r * squash, MeshBuilder()
    angle = np.linspace(-np.pi / 2, np.pi / 2, 10)
    dent = [(max(float(np.cos(a)), 0.0) * r, h / 2 * (1 + float(np.sin(a)))) for a in angle[1:-1]]
    mesh.lathe([(0, 0), *dent, (0, h * 0.97 if category == "apple" else h)], color, segments=16)
    stem = 0.012 if category == "apple" else 0.002
    mesh.cylinder((0, h * 0.97 + stem / 2, 0), 0.002 if category == "apple" else 0.004, stem, (86, 66, 38), segments=6)
    return _centered(category, mesh, (cylinder_part((0, 0, 0), r, h),), h)


def apple(rng: np.random.Generator, style: Style) -> Asset:
    """Build a red, green or orange-red apple."""
    return _fruit("apple", 0.037, 0.92, vary(rng, [(190, 44, 40), (140, 176, 62), (212, 92, 48)][int(rng.integers(3))]))


def orange(rng: np.random.Generator, style: Style) -> Asset:
    """Build an orange."""
    return _fruit("orange", 0.036, 0.97, vary(rng, (236, 142, 40)))


OBJECT_MAKERS: Mapping[str, Callable[[np.random.Generator, Style], Asset]] = {
    "can": can,
    "mug": mug,
    "bowl": bowl,
    "box": box,
    "bottle": bottle,
    "book": book,
    "apple": apple,
    "orange": orange,
}

AFFINITY: Mapping[str, tuple[str, ...]] = {
    "dining_table": ("bowl", "mug", "apple", "orange", "bottle", "can"),
    "kitchen_counter": ("mug", "bowl", "box", "bottle", "can", "apple", "orange"),
    "fridge": ("box", "bowl"),
    "coffee_table": ("book", "mug", "can", "bowl"),
    "tv_stand": ("book", "can", "bowl"),
    "shelf": ("book", "box", "bowl", "mug"),
    "sofa": ("book",),
    "armchair": ("book",),
    "bed": ("book",),
    "kitchen_cabinet": ("mug", "bowl", "box", "can"),
    "nightstand": ("book", "mug", "apple"),
    "desk": ("book", "mug", "can", "apple"),
    "console": ("bowl", "book", "bottle"),
    "bathroom_sink": ("mug", "bottle"),
    "toilet": ("box", "bottle"),
    "kitchen_island": ("bowl", "mug", "apple", "orange", "bottle", "can", "box"),
    "washer": ("box", "bottle"),
    "bench": ("book", "box"),
}
"""Categories of small objects by the category of furniture on which they are placed."""


def renamed(asset: Asset, name: str) -> Asset:
    """Return an asset under another name."""
    return replace(asset, name=name)
