"""Replacement of first-generation models of furniture, with the same collision shapes, surfaces and positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from h3data_homes.furnishing.furniture import Furniture
from h3data_homes.furnishing.place import Placed, RoomState
from h3data_homes.kinds.kind import builder_of
from h3data_homes.kinds.parts import Nested, ball, box, flat, lathe, leaves, legs, line, rod, soft
from h3data_homes.lived_in.pictures import picture
from h3data_homes.solids import MeshBuilder
from h3data_homes.style import Style

# Models in the unit frame: width and depth from -0.5 to 0.5, height from 0 to 1, stretched to the piece's own size.
_SPINDLE_CHAIR = (
    box("wood", 0, 0.5, 0.03, 0.98, 0.035, 0.92, bevel=0.008),
    tuple(line("wood", 0.032, (0.36 * x, 0.5, 0.36 * z), (0.46 * x, 0, 0.46 * z)) for x in (-1, 1) for z in (-1, 1)),
    tuple(line("wood", 0.016, (0.16 * i, 0.52, -0.4), (0.18 * i, 0.97, -0.47), n=5) for i in (-2, -1, 0, 1, 2)),
    box("wood", 0, 0.93, -0.47, 0.95, 0.07, 0.06, bevel=0.008),
)
_SOFT_CHAIR = (
    soft("fabric", 0, 0.42, 0.02, 1.0, 0.13, 0.94, 0.03),
    soft("fabric", 0, 0.56, -0.42, 0.96, 0.44, 0.14, 0.03),
    tuple(
        line("wood_dark", 0.036, (0.38 * x, 0.44, 0.38 * z), (0.45 * x, 0, 0.45 * z)) for x in (-1, 1) for z in (-1, 1)
    ),
)
_SHELL_CHAIR = (
    soft("accent", 0, 0.47, 0.02, 0.98, 0.06, 0.94, 0.02),
    soft("accent", 0, 0.56, -0.43, 0.94, 0.42, 0.08, 0.02),
    tuple(line("metal", 0.022, (0.3 * x, 0.48, 0.3 * z), (0.46 * x, 0, 0.44 * z)) for x in (-1, 1) for z in (-1, 1)),
)
_SLAB_TABLE = (
    box("wood", 0, 0.86, 0, 1, 0.14, 1, bevel=0.01),
    tuple(box("metal", 0.4 * s, 0, 0, 0.03, 0.86, 0.8) for s in (-1, 1)),
    box("accent", 0.12, 0.2, 0, 0.3, 0.04, 0.5, bevel=0.004),
)
_GLASS_TABLE = (
    box("glass", 0, 0.96, 0, 1, 0.04, 1),
    legs("metal", 0.46, 0.44, 0.96, 0.035),
    tuple(box("metal", 0, 0.9, 0.46 * s, 0.94, 0.05, 0.03) for s in (-1, 1)),
    box("glass", 0, 0.3, 0, 0.92, 0.03, 0.88),
)


def _plant(pot: float, *leaf: Nested) -> tuple[Nested, ...]:
    return (
        lathe("clay", (0, 0), (0.3, 0), (0.42, pot), (0.38, pot), (0, 0.9 * pot), n=16),
        *leaf,
    )


_PLANTS = (
    _plant(
        0.24,
        line("leather", 0.05, (0, 0.2, 0), (0.05, 0.55, 0.03)),
        leaves("green", 0.04, 0.5, 0.02, 26, 0.42, (0.15, 1.3), 0.07),
    ),
    _plant(0.28, leaves("green*0.85", 0, 0.24, 0, 13, 0.74, (0.02, 0.3), 0.13)),
    _plant(
        0.26,
        line("leather*0.8", 0.035, (0, 0.2, 0), (-0.03, 0.8, 0)),
        tuple(
            ball(
                f"green*{0.8 + 0.1 * k}",
                0.2 * np.cos(2.1 * k),
                0.66 + 0.09 * k,
                0.2 * np.sin(2.1 * k),
                0.26,
                0.12,
                0.26,
                n=9,
            )
            for k in range(4)
        ),
    ),
    _plant(0.22, leaves("green", 0, 0.2, 0, 20, 0.66, (0.2, 0.75), 0.05)),
)
_FLOOR_LAMPS = (
    (
        tuple(line("wood", 0.04, (0, 0.78, 0), (0.42 * x, 0, 0.42 * z)) for x, z in ((1, 0.6), (-1, 0.6), (0, -1))),
        lathe("lampshade", (0.5, 0.76), (0.36, 1.0), n=20),
        lathe("lampshade*1.05", (0.35, 1.0), (0.49, 0.76), n=20),
    ),
    (
        lathe("metal", (0, 0), (0.38, 0), (0.36, 0.015), (0.05, 0.02), n=18),
        rod("metal", 0, 0.015, 0, 0.03, 0.86, n=8),
        line("metal", 0.028, (0, 0.87, 0), (0.02, 0.99, 0.1), (0.05, 0.98, 0.3)),
        lathe("accent", (0.26, 0.0), (0.22, 0.06), (0.06, 0.1), (0, 0.1), x=0.05, y=0.88, z=0.3, n=14),
        ball((252, 246, 220), 0.05, 0.89, 0.3, 0.12, 0.03, 0.12),
    ),
)

_MODELS: Mapping[str, tuple[tuple[Nested, ...], ...]] = {
    "chair": (_SPINDLE_CHAIR, _SOFT_CHAIR, _SHELL_CHAIR),
    "coffee_table": (_SLAB_TABLE, _GLASS_TABLE),
    "plant": _PLANTS,
    "floor_lamp": _FLOOR_LAMPS,
}
_KEEP = 0.25
"""Probability that a piece keeps the model of the first generation."""


def _remodelled(piece: Furniture, model: tuple[Nested, ...], rng: np.random.Generator, style: Style) -> Furniture:
    return replace(piece, builder=builder_of(flat(model), rng, style, np.array(piece.size)))


def _other_sofa(piece: Furniture, rng: np.random.Generator, style: Style) -> Furniture:
    """Return a sofa or armchair on legs, with a tight back and slim arms; outlines as before."""
    w, _, d = piece.size
    mesh, arm = MeshBuilder(), 0.17
    cloth = style.fabric if piece.category == "sofa" else style.fabric_2
    inner, seats = w - 2 * arm, max(1, round((w - 0.34) / 0.64))
    for sx in (-1, 1):
        mesh.cushion((sx * (w - arm) / 2, 0.37, 0.01), (arm - 0.03, 0.44, d - 0.04), cloth, radius=0.03)
        mesh.box((sx * (w - arm) / 2, 0.605, 0.01), (arm - 0.02, 0.03, d - 0.05), style.wood, bevel=0.008)
        for sz in (-1, 1):
            mesh.cylinder((sx * (w / 2 - 0.1), 0.08, sz * (d / 2 - 0.1)), 0.018, 0.16, style.wood_dark, segments=8)
    mesh.box((0, 0.2, 0), (w - 0.06, 0.08, d - 0.06), style.wood_dark, bevel=0.006)
    mesh.cushion((0, 0.53, -d / 2 + 0.11), (inner + 0.02, 0.54, 0.2), cloth, radius=0.05)
    for i in range(seats):
        x = -inner / 2 + (i + 0.5) * inner / seats
        mesh.cushion((x, 0.355, 0.1), (inner / seats - 0.006, 0.23, d - 0.21), cloth, radius=0.045)
    if rng.random() < 0.7:
        mesh.cushion((inner * 0.3, 0.6, -d / 2 + 0.29), (0.42, 0.3, 0.14), style.accent, radius=0.06)
    return replace(piece, builder=mesh)


_OTHER: Mapping[str, Callable[[Furniture, np.random.Generator, Style], Furniture]] = {
    "sofa": _other_sofa,
    "armchair": _other_sofa,
    "picture": lambda piece, rng, style: picture(rng, style, piece.size[:2]),
}


def remodel(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """Replace the models of furniture in a room; equal pieces stay equal."""
    changed: dict[int, Furniture] = {}
    chosen: dict[str, int] = {}
    out: list[Placed] = []
    for placed in state.placed:
        piece = placed.piece
        models = _MODELS.get(piece.category, ())
        if id(piece) not in changed:
            keep = piece.category != "picture" and rng.random() < _KEEP
            if models and not keep:
                # Chairs of one room match even where the pieces differ.
                number = chosen.setdefault(piece.category, int(rng.integers(len(models))))
                if piece.category in ("plant", "floor_lamp"):
                    number = int(rng.integers(len(models)))
                changed[id(piece)] = _remodelled(piece, models[number], rng, style)
            elif piece.category in _OTHER and not keep:
                changed[id(piece)] = _OTHER[piece.category](piece, rng, style)
            else:
                changed[id(piece)] = piece
        out.append(replace(placed, piece=changed[id(piece)]))
    state.placed[:] = out
