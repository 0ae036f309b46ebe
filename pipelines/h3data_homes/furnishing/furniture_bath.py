"""Models of bathroom furniture for generated homes."""

from __future__ import annotations

import numpy as np

from h3data.scene.records import Hull
from h3data_homes.furnishing.furniture import Furniture, box_part, cabinet_front, cylinder_part, finish, surface
from h3data_homes.materials import Finish
from h3data_homes.solids import Color, MeshBuilder, shade, turn_x, vary
from h3data_homes.style import Style

_PORCELAIN: Color = (248, 248, 246)


def toilet(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a toilet with cistern, of random depth."""
    mesh, w, d = MeshBuilder(), 0.38, rng.uniform(0.62, 0.68)
    z0 = -d / 2
    mesh.span((-w / 2, 0.36, z0), (w / 2, 0.76, z0 + 0.18), _PORCELAIN, bevel=0.02)
    mesh.span((-w / 2 - 0.01, 0.76, z0 - 0.0), (w / 2 + 0.01, 0.79, z0 + 0.19), _PORCELAIN, bevel=0.01)
    mesh.box((0, 0.795, z0 + 0.09), (0.06, 0.01, 0.04), style.metal)
    middle = z0 + 0.18 + (d - 0.18) / 2
    half = (d - 0.18) / 2
    bowl = [(0, 0), (0.11, 0), (0.1, 0.12), (0.17, 0.33), (0.18, 0.38), (0.135, 0.385), (0.1, 0.27), (0, 0.25)]
    mesh.lathe(bowl, _PORCELAIN, center=(0, 0, middle), segments=20, stretch=(1.0, half / 0.18))
    mesh.span((-0.1, 0, z0 + 0.02), (0.1, 0.37, middle), _PORCELAIN, bevel=0.02)
    seat = shade(_PORCELAIN, 0.97)
    mesh.lathe(
        [(0.125, 0.385), (0.185, 0.385), (0.185, 0.402), (0.125, 0.402)],
        seat,
        center=(0, 0, middle),
        segments=20,
        stretch=(1.0, half / 0.185),
    )
    mesh.box((0, 0.57, z0 + 0.205), (0.34, 0.38, 0.02), seat, bevel=0.009, turn=turn_x(-0.1))
    angle = np.arange(12) * (2 * np.pi / 12)
    rim = np.stack([0.185 * np.sin(angle), np.full(12, 0.4), middle + half * np.cos(angle)], 1)
    foot = np.stack([0.12 * np.sin(angle), np.zeros(12), middle + half * 0.6 * np.cos(angle)], 1)
    shapes = [Hull(points=np.concatenate([rim, foot])), box_part((0, 0.395, z0 + 0.1), (w, 0.79, 0.2))]
    tank = surface("tank", (0, 0.79, z0 + 0.09), (w - 0.06, 0.14), 0.6)
    return finish("toilet", mesh, (w + 0.02, 0.79, d), shapes=shapes, receptacles=[tank], front=0.55)


def bathroom_sink(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a vanity with a basin on top."""
    mesh, w, d, h = MeshBuilder(), rng.uniform(0.62, 0.85), 0.46, 0.84
    mesh.span((-w / 2, 0.2, -d / 2), (w / 2, h - 0.03, d / 2 - 0.02), style.front, bevel=0.004)
    for s in (-1, 1):
        for z in (-0.15, 0.15):
            mesh.box((s * (w / 2 - 0.04), 0.1, z), (0.03, 0.2, 0.03), style.metal)
    for i in range(2):
        x = (-w / 2 + i * w / 2, -w / 2 + (i + 1) * w / 2)
        cabinet_front(mesh, x, (0.21, h - 0.035), d / 2 - 0.02, style.front, style.metal, knob="left" if i else "right")
    mesh.span((-w / 2, h - 0.03, -d / 2), (w / 2, h, d / 2), _PORCELAIN, bevel=0.006)
    x = w / 2 - 0.25
    bowl = [(0.12, 0.0), (0.17, 0.05), (0.185, 0.11), (0.17, 0.112), (0.13, 0.03), (0, 0.012)]
    mesh.lathe(bowl, shade(_PORCELAIN, 0.98), center=(x, h, 0.03), segments=22)
    mesh.cylinder((x, h + 0.11, -d / 2 + 0.05), 0.014, 0.22, style.metal, segments=10)
    mesh.cylinder((x, h + 0.21, -d / 2 + 0.1), 0.011, 0.12, style.metal, segments=8, turn=turn_x(np.pi / 2))
    side = w - 0.5
    receptacles = (
        [surface("top", (-w / 2 + side / 2 + 0.02, h, 0), (side - 0.01, d - 0.08), 0.9)] if side > 0.12 else []
    )
    shapes = [box_part((0, h / 2, 0), (w, h, d)), cylinder_part((x, h + 0.055, 0.03), 0.185, 0.11)]
    return finish("bathroom_sink", mesh, (w, h + 0.2, d), shapes=shapes, receptacles=receptacles, front=0.6)


def mirror(rng: np.random.Generator, style: Style, width: float = 0.6) -> Furniture:
    """Return a wall mirror with its origin at its centre and its back at z = 0."""
    mesh, h = MeshBuilder(), 0.75
    mesh.span((-width / 2, -h / 2, 0.002), (width / 2, h / 2, 0.022), style.metal, bevel=0.004)
    mesh.span((-width / 2 + 0.02, -h / 2 + 0.02, 0.022), (width / 2 - 0.02, h / 2 - 0.02, 0.024), (206, 220, 226))
    return finish("mirror", mesh, (width, h, 0.025))


def mat(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a flat bath mat without collision shapes."""
    mesh, w, d, y = MeshBuilder(), 0.8, 0.5, 0.012
    pile = Finish(vary(rng, shade(style.accent, 1.15), 0.05), "carpet")
    mesh.span((-w / 2, 0, -d / 2), (w / 2, y, d / 2), pile, bevel=0.004)
    return finish("rug", mesh, (w, y, d))


def bathtub(rng: np.random.Generator, style: Style) -> Furniture:
    """Build a bathtub of 1.7 x 0.75 m with tiled sides."""
    mesh, w, d, h, rim = MeshBuilder(), 1.7, 0.75, 0.56, 0.075
    x, z = w / 2, d / 2
    mesh.span((-x, 0.0, z - 0.02), (x, h - 0.03, z), vary(rng, style.wall_tile, 0.02))
    mesh.span((-x, 0.0, -z), (x, 0.06, z - 0.02), _PORCELAIN)
    for a, b in (
        ((-x, -z), (x, -z + rim)),
        ((-x, z - rim), (x, z)),
        ((-x, -z + rim), (-x + rim, z - rim)),
        ((x - rim, -z + rim), (x, z - rim)),
    ):
        mesh.span((a[0], h - 0.03, a[1]), (b[0], h, b[1]), _PORCELAIN, bevel=0.008)
    top = [(-x + rim, -z + rim), (x - rim, -z + rim), (x - rim, z - rim), (-x + rim, z - rim)]
    low = [(px * 0.86, pz * 0.78) for px, pz in top]
    bottom = 0.14
    mesh.quads([[(*_at(low[k], bottom),) for k in (3, 2, 1, 0)]], shade(_PORCELAIN, 0.97))
    for k in range(4):
        n = (k + 1) % 4
        mesh.quads(
            [[_at(low[k], bottom), _at(low[n], bottom), _at(top[n], h - 0.01), _at(top[k], h - 0.01)]], _PORCELAIN
        )
    for s in (-1, 1):
        mesh.span((min(s * x, s * (x - 0.02)), 0, -z), (max(s * x, s * (x - 0.02)), h - 0.03, z - 0.02), _PORCELAIN)
    mesh.cylinder((x - 0.035, h + 0.07, 0), 0.015, 0.14, style.metal, segments=10)
    mesh.box((x - 0.085, h + 0.13, 0), (0.12, 0.02, 0.03), style.metal, bevel=0.005)
    return finish("bathtub", mesh, (w, h, d), shapes=[box_part((0, h / 2, 0), (w, h, d))], front=0.5)


def _at(point: tuple[float, float], y: float) -> tuple[float, float, float]:
    return point[0], y, point[1]


def shower(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a corner shower with walls behind and on the left, a glass screen on the right, and an open front."""
    mesh, w, d, h = MeshBuilder(), 0.9, 0.9, 2.0
    mesh.span((-w / 2, 0, -d / 2), (w / 2, 0.06, d / 2), _PORCELAIN, bevel=0.01)
    mesh.cylinder((0, 0.0615, 0), 0.05, 0.004, style.metal, segments=14)
    mesh.span((w / 2 - 0.012, 0.06, -d / 2), (w / 2, h, d / 2), (196, 216, 222))
    mesh.span((w / 2 - 0.02, h, -d / 2), (w / 2 + 0.0, h + 0.025, d / 2), style.metal)
    mesh.cylinder((0, 1.45, -d / 2 + 0.05), 0.012, 1.2, style.metal, segments=8)
    mesh.cylinder((0, 2.05, -d / 2 + 0.17), 0.01, 0.26, style.metal, segments=8, turn=turn_x(np.pi / 2))
    mesh.cylinder((0, 2.03, -d / 2 + 0.3), 0.09, 0.02, style.metal, segments=18, top_radius=0.05)
    mesh.box((0, 1.05, -d / 2 + 0.05), (0.2, 0.05, 0.06), style.metal, bevel=0.01)
    shape = box_part((0, h / 2, 0), (w, h, d))  # the whole cabin is an obstacle: agents do not walk into the tray
    return finish("shower", mesh, (w, h + 0.1, d), shapes=[shape], front=0.5)


def washer(rng: np.random.Generator, style: Style) -> Furniture:
    """Return a washing machine or dryer, whose knob has a random position."""
    mesh, w, d, h = MeshBuilder(), 0.6, 0.6, 0.86
    z = d / 2 - 0.03
    mesh.span((-w / 2, 0.02, -d / 2), (w / 2, h, z), _PORCELAIN, bevel=0.012)
    mesh.span((-w / 2 + 0.04, 0, -d / 2 + 0.04), (w / 2 - 0.04, 0.02, z - 0.06), style.black)
    mesh.span((-w / 2 + 0.02, h - 0.13, z - 0.002), (w / 2 - 0.02, h - 0.02, z + 0.006), shade(_PORCELAIN, 0.93))
    knob = float(rng.choice([-0.18, 0.0, 0.18]))
    mesh.cylinder((knob, h - 0.075, z + 0.014), 0.035, 0.025, style.metal, segments=18, turn=turn_x(np.pi / 2))
    mesh.cylinder((0, 0.42, z + 0.012), 0.21, 0.028, style.metal, segments=28, bevel=0.006, turn=turn_x(np.pi / 2))
    mesh.cylinder((0, 0.42, z + 0.027), 0.165, 0.006, (58, 66, 78), segments=28, turn=turn_x(np.pi / 2))
    top = surface("top", (0, h, -0.02), (w - 0.08, d - 0.16), 0.8)
    shape = box_part((0, h / 2, 0), (w, h, d))
    return finish("washer", mesh, (w, h, d), shapes=[shape], receptacles=[top], front=0.6)
