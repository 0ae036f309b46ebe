"""Framed pictures with ten motifs made of flat shapes, in the colours of the home."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from h3data_homes.furnishing.furniture import Furniture, finish
from h3data_homes.solids import Color, MeshBuilder, shade, turn_x, vary
from h3data_homes.style import Style

_LAYER_M = 0.0006
"""Distance between shapes that lie on each other [m]."""


class _Sheet:
    """A canvas of half sizes ``a`` and ``b``; positions and sizes are shares of them, later shapes lie on top."""

    def __init__(self, mesh: MeshBuilder, a: float, b: float) -> None:
        self.mesh, self.a, self.b, self.z = mesh, a, b, 0.024

    def _next(self) -> float:
        self.z += _LAYER_M
        return self.z

    def bar(self, x0: float, y0: float, x1: float, y1: float, color: Color) -> None:
        self.poly([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], color)

    def poly(self, corners: list[tuple[float, float]], color: Color) -> None:
        """Add a convex quadrilateral, counter-clockwise."""
        z = self._next()
        self.mesh.quads([[(x * self.a, y * self.b, z) for x, y in corners]], color)

    def disc(self, x: float, y: float, r: float, color: Color, *, n: int = 20) -> None:
        """Add a disc whose radius is a share of the smaller half size."""
        r *= min(self.a, self.b)
        at = (x * self.a, y * self.b, self._next())
        self.mesh.cylinder(at, r, 0.0004, color, segments=n, turn=turn_x(np.pi / 2))


Colors = list[Color]
_Motif = Callable[[_Sheet, np.random.Generator, Colors], None]


def _sea(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    level = float(rng.uniform(-0.3, 0.1))
    s.bar(-1, level, 1, 1, shade(c[3], 1.08))
    s.bar(-1, -1, 1, level, c[0])
    s.disc(float(rng.uniform(-0.5, 0.5)), level + 0.4, 0.2, c[2])
    for k in range(4):
        y, x = level - 0.15 - 0.2 * k, float(rng.uniform(-0.7, 0.1))
        s.bar(x, y, x + 0.6, y + 0.04, shade(c[0], 1.3))
    x = float(rng.uniform(-0.4, 0.4))
    s.poly([(x - 0.12, level), (x + 0.12, level), (x + 0.02, level + 0.45), (x, level + 0.45)], (244, 242, 236))


def _hills(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, shade(c[3], 1.05))
    s.disc(0.5, 0.55, 0.18, c[2])
    for k, color in enumerate((shade(c[0], 1.25), c[0], shade(c[1], 0.8))):
        tops = rng.uniform(-0.2, 0.4, 6) - 0.35 * k
        x = np.linspace(-1, 1, 6)
        for i in range(5):
            s.poly([(x[i], -1), (x[i + 1], -1), (x[i + 1], tops[i + 1]), (x[i], tops[i])], color)


def _stripes(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    cuts = np.sort(np.append(rng.uniform(-0.9, 0.9, 5), (-1.0, 1.0))).tolist()
    for i, (a, b) in enumerate(pairwise(cuts)):
        s.bar(-1, a, 1, b, shade(c[i % 4], (1.0, 1.2, 0.85)[i % 3]))


def _rings(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, shade(c[3], 1.1))
    x, y = rng.uniform(-0.2, 0.2, 2).tolist()
    for k in range(5):
        s.disc(x, y, 0.92 - 0.17 * k, c[k % 3] if k % 2 == 0 else shade(c[3], 1.1), n=26)


def _blocks(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, (40, 40, 42))
    x, y = rng.uniform(-0.35, 0.35, 2).tolist()
    for k, (x0, y0, x1, y1) in enumerate(((-1, -1, x, y), (x, -1, 1, y), (-1, y, x, 1), (x, y, 1, 1))):
        color = ((236, 232, 222), c[0], c[1], c[2])[(k + int(10 * abs(x))) % 4]
        s.bar(x0 + 0.03, y0 + 0.03, x1 - 0.03, y1 - 0.03, color)


def _leaf(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, (240, 236, 224))
    green = vary(rng, (86, 118, 84), 0.1)
    s.bar(-0.015, -0.85, 0.015, 0.7, shade(green, 0.7))
    for k in range(5):
        y, long = -0.6 + 0.26 * k, 0.62 - 0.08 * k
        for sign in (-1, 1):
            corners = [(0.0, y), (sign * 0.45 * long, y + 0.02), (sign * long, y + 0.3), (sign * 0.2 * long, y + 0.22)]
            s.poly(corners if sign > 0 else corners[::-1], shade(green, 0.9 + 0.06 * k))


def _still_life(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -0.35, 1, 1, shade(c[3], 0.8))
    s.bar(-1, -1, 1, -0.35, shade(c[1], 0.6))
    x = float(rng.uniform(-0.45, -0.25))
    s.poly([(x - 0.14, -0.55), (x + 0.14, -0.55), (x + 0.2, 0.0), (x - 0.2, 0.0)], c[0])
    s.poly([(x - 0.2, 0.0), (x + 0.2, 0.0), (x + 0.08, 0.22), (x - 0.08, 0.22)], c[0])
    for dx, dy in ((-0.16, 0.5), (0.02, 0.62), (0.18, 0.46)):
        s.disc(x + dx, dy, 0.13, c[2])
    s.disc(0.3, -0.42, 0.2, (206, 72, 50))
    s.disc(0.56, -0.48, 0.17, (222, 160, 62))


def _portrait(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, shade(c[0], 0.8))
    skin = vary(rng, (206, 160, 128), 0.2)
    s.poly([(-0.75, -1), (0.75, -1), (0.42, -0.35), (-0.42, -0.35)], c[1])
    s.bar(-0.14, -0.4, 0.14, -0.1, shade(skin, 0.9))
    s.disc(0, 0.28, 0.5, (62, 44, 36))
    s.disc(0, 0.16, 0.4, skin)
    for x in (-0.15, 0.15):
        s.disc(x, 0.2, 0.045, (40, 36, 36), n=10)
    s.bar(-0.12, -0.04, 0.12, -0.01, (150, 70, 66))


def _town(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    s.bar(-1, -1, 1, 1, shade(c[3], 1.1))
    s.disc(-0.5, 0.6, 0.16, c[2])
    for k, x in enumerate(np.linspace(-0.95, 0.6, 5).tolist()):
        tall = float(rng.uniform(-0.1, 0.45))
        s.bar(x, -1, x + 0.36, tall, c[k % 3])
        s.poly(
            [(x - 0.03, tall), (x + 0.39, tall), (x + 0.2, tall + 0.24), (x + 0.16, tall + 0.24)],
            shade(c[(k + 1) % 3], 0.6),
        )
        for j in range(3):
            s.bar(x + 0.12, -0.8 + 0.32 * j, x + 0.24, -0.62 + 0.32 * j, (250, 236, 180))


def _moon(s: _Sheet, rng: np.random.Generator, c: Colors) -> None:
    night = (38, 48, 74)
    s.bar(-1, -1, 1, 1, night)
    s.disc(0.25, 0.35, 0.36, (238, 230, 204), n=24)
    s.disc(0.4, 0.42, 0.32, night, n=24)
    for x, y in rng.uniform(-0.9, 0.9, (9, 2)).tolist():
        s.disc(x, abs(y), 0.025, (244, 240, 220), n=6)
    for k in range(6):
        x, tall = -0.9 + 0.34 * k, float(rng.uniform(-0.5, -0.1))
        s.poly([(x - 0.16, -1), (x + 0.16, -1), (x + 0.01, tall), (x - 0.01, tall)], (26, 44, 46))


MOTIFS: tuple[_Motif, ...] = (
    _sea,
    _hills,
    _stripes,
    _rings,
    _blocks,
    _leaf,
    _still_life,
    _portrait,
    _town,
    _moon,
)


def picture(rng: np.random.Generator, style: Style, size: tuple[float, float]) -> Furniture:
    """Return a framed picture of a given width and height [m], with its origin at its centre and its back at z = 0."""
    mesh, (w, h) = MeshBuilder(), size
    frame = (style.wood_dark, style.black, style.wood, style.metal, style.white)[int(rng.integers(5))]
    mesh.span((-w / 2, -h / 2, 0.002), (w / 2, h / 2, 0.022), frame, bevel=0.004)
    mesh.span((-w / 2 + 0.02, -h / 2 + 0.02, 0.02), (w / 2 - 0.02, h / 2 - 0.02, 0.0235), (242, 239, 230))
    margin = 0.02 if rng.random() < 0.4 else 0.07
    colors = [
        vary(rng, style.fabric, 0.15),
        vary(rng, style.accent, 0.15),
        vary(rng, (236, 200, 120), 0.1),
        vary(rng, (206, 214, 216), 0.08),
    ]
    plain = [(int(c[0]), int(c[1]), int(c[2])) for c in colors]
    MOTIFS[int(rng.integers(len(MOTIFS)))](_Sheet(mesh, w / 2 - margin, h / 2 - margin), rng, list(plain))
    return finish("picture", mesh, (w, h, 0.025))
