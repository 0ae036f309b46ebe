"""Floor meshes of rooms: boards and tiles, with one quad each."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from h3data.mesh.mesh import Mesh
from h3data_homes.layout import RoomPlan
from h3data_homes.materials import BOARDS, MATERIALS, TILES
from h3data_homes.solids import MeshBuilder, material_of, vary
from h3data_homes.style import Style
from h3data_homes.zoning import Rect

_PLANK_LENGTH, _PLANK_WIDTH = MATERIALS["boards"].size_m[0], MATERIALS["boards"].size_m[1] / BOARDS
TILE_M = MATERIALS["tiles"].size_m[0] / TILES


def _flat(rects: np.ndarray, y: float = 0.0) -> np.ndarray:
    """Return the upward quads [Q, 4, 3] of plan rectangles [Q, 4]."""
    x0, z0, x1, z1 = rects.T
    height = np.full_like(x0, y)
    ring = [(x0, z1), (x1, z1), (x1, z0), (x0, z0)]
    return np.stack([np.stack([x, height, z], -1) for x, z in ring], 1)


def _planks(rect: Rect, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Plan rectangles [Q, 4] of staggered floor boards along the longer side, and texture places on "boards" [Q, 4, 2]."""
    x0, z0, x1, z1 = rect
    swap = (z1 - z0) > (x1 - x0)
    a0, b0, a1, b1 = (z0, x0, z1, x1) if swap else rect
    boards, places = [], []
    rows = np.append(np.arange(b0, b1 - 0.03, _PLANK_WIDTH), b1)
    for low, high in pairwise(rows.tolist()):
        cuts = np.arange(a0 - rng.uniform(0, _PLANK_LENGTH), a1, _PLANK_LENGTH)
        ends = np.concatenate([[a0], cuts[(cuts > a0 + 0.08) & (cuts < a1 - 0.08)], [a1]])
        for k, (s, e) in enumerate(pairwise(ends.tolist())):
            boards.append((s, low, e, high))
            top = len(boards) % BOARDS * _PLANK_WIDTH  # neighbours show different boards of the texture
            left = s - float(cuts[0]) if k == 0 else 0.0
            places.append((left, top, left + e - s, top + min(high - low, _PLANK_WIDTH)))
    out = np.array(boards)
    return _flat(out[:, [1, 0, 3, 2]] if swap else out), _place(np.array(places), swap)


def _place(rects: np.ndarray, swap: bool = False) -> np.ndarray:
    """Return texture places [Q, 4, 2] of the corners that `_flat` returns, from rectangles on the material [Q, 4]."""
    a0, b0, a1, b1 = rects.T
    ring = [(a1, b0), (a1, b1), (a0, b1), (a0, b0)] if swap else [(a0, b1), (a1, b1), (a1, b0), (a0, b0)]
    return np.stack([np.stack(p, -1) for p in ring], 1)


def floor_mesh(room: RoomPlan, style: Style, rng: np.random.Generator) -> Mesh:
    """Return a floor mesh of boards or, in kitchens and bathrooms, of tiles; each has its own tint."""
    mesh = MeshBuilder()
    if room.category not in style.floor_tile:
        boards, places = _planks(room.rect, rng)
        mesh.quads(boards, [vary(rng, style.floor_wood, 0.09) for _ in boards], place=places)
        return mesh.mesh()
    x0, z0, x1, z1 = room.rect
    if material_of(style.floor_tile[room.category]) != "tiles":
        mesh.quads(_flat(np.array([room.rect])), style.floor_tile[room.category])
        return mesh.mesh()
    xs, zs = np.append(np.arange(x0, x1 - 0.02, TILE_M), x1), np.append(np.arange(z0, z1 - 0.02, TILE_M), z1)
    a0, b0 = (v.ravel() for v in np.meshgrid(xs[:-1], zs[:-1], indexing="ij"))
    a1, b1 = (v.ravel() for v in np.meshgrid(xs[1:], zs[1:], indexing="ij"))
    tiles = np.stack([a0, b0, a1, b1], 1)
    tint = style.floor_tile[room.category]
    corner = tiles[:, :2] - (x0, z0)
    places = np.concatenate([corner, corner + tiles[:, 2:] - tiles[:, :2]], 1)
    mesh.quads(_flat(tiles), [vary(rng, tint, 0.04) for _ in tiles], place=_place(places))
    return mesh.mesh()
