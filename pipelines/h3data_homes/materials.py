"""Materials of surfaces: near-white repeating patterns, which are multiplied by the colours of a home's style.

All homes share them. They are generated from fixed seeds with sums, products and means of integers only, so that every
machine gets the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.mesh.mesh import Texture
from h3data.srgb import linear_to_bytes

_PX = 128
_STEPS = 256
"""Light is quantised to 1 / _STEPS: no texel lies on the border between two sRGB bytes, and files stay small."""

BOARDS, TILES = 4, 2
"""Number of boards in the height of the pattern "boards", and number of tiles along each side of "tiles"; floors cut
their pieces along these joints."""

Pattern = NDArray[np.float64]
"""Darkness of each texel in arbitrary units, shape [H, W]."""


class Finish(tuple[int, int, int]):
    """Colour with a material: sRGB 0-255 and a name, such as ``Finish((186, 140, 92), "wood")``.

    It can be used wherever a plain colour can; `shade` and `vary` keep the material.
    """

    material: str

    def __new__(cls, color: Sequence[int], material: str) -> Finish:
        """Create a colour with a material.

        Raises:
            InputError: there is no such material.
        """
        if material not in MATERIALS:
            raise InputError(f"Unknown material {material!r}. Available: {', '.join(MATERIALS)}.", code="H3-SCENE-026")
        finish = super().__new__(cls, color)
        finish.material = material
        return finish

    def __getnewargs__(self) -> tuple[Sequence[int], str]:
        return tuple(self), self.material

    def __repr__(self) -> str:
        return f"Finish({tuple(self)}, {self.material!r})"


@dataclass(frozen=True)
class Material:
    """Repeating pattern of a material, and the area over which it repeats."""

    make_pattern: Callable[[np.random.Generator], Pattern]
    size_m: tuple[float, float]
    """Width and height of one repetition; the grain runs along the width [m]."""
    darkening: float
    """Mean share of light, 0 to 1, by which the pattern darkens a surface's colour."""


def _noise(rng: np.random.Generator, across: int, down: int) -> Pattern:
    """Return smooth, periodic noise 0..1, interpolated between ``across`` x ``down`` random points (powers of two)."""
    values = rng.integers(0, 1 << 16, (down, across)) / (1 << 16)
    for axis, count in enumerate((down, across)):
        steps = _PX // count
        t = (np.arange(steps) + 0.5) / steps
        t = t * t * (3 - 2 * t)
        here, there = np.repeat(values, steps, axis), np.repeat(np.roll(values, -1, axis), steps, axis)
        weight = np.tile(t, count)
        weight = weight[:, None] if axis == 0 else weight[None]
        values = here * (1 - weight) + there * weight
    return values


def _speckle(rng: np.random.Generator, share: float) -> Pattern:
    """Return 1 at a random ``share`` of the texels, 0 elsewhere."""
    return (rng.integers(0, 1 << 16, (_PX, _PX)) < share * (1 << 16)).astype(float)


def _rows_columns() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows, columns = np.indices((_PX, _PX))
    return rows, columns


def _wave(x: Pattern) -> Pattern:
    """Return a triangle wave of period 1 from 0 to 1."""
    return np.abs(2 * (x - np.floor(x)) - 1)


def _grain(rng: np.random.Generator) -> Pattern:
    """Return wood grain: streaks along the width, with slightly wavy growth rings."""
    rows, _ = _rows_columns()
    rings = _wave(rows * (6 / _PX) + 1.1 * _noise(rng, 2, 4))
    fine = 0.5 * _noise(rng, 4, 64) + 0.5 * _noise(rng, 8, 128)
    pores = _noise(rng, 16, 128)
    return 0.5 * rings * rings + 0.6 * fine + 0.7 * (pores > 0.86) + 0.5 * _noise(rng, 2, 16)


def _boards(rng: np.random.Generator) -> Pattern:
    """Return four floor boards, one above the other, each with its own grain and a joint around it."""
    rows, columns = _rows_columns()
    tall = _PX // BOARDS
    grain = _grain(rng)
    for k in range(BOARDS):  # shifted, as if neighbours came from different parts of the tree
        part = slice(k * tall, (k + 1) * tall)
        grain[part] = np.roll(grain[part], 37 * k, axis=1)
    joint = (rows % tall == 0) | (columns == 0)
    beside = (rows % tall == tall - 1) | (columns == _PX - 1)
    return grain + 3.2 * joint + 1.0 * beside


def _tiles(rng: np.random.Generator) -> Pattern:
    """Return two by two glazed tiles with grout between them."""
    rows, columns = _rows_columns()
    tall = _PX // TILES
    y, x = rows % tall, columns % tall
    edge = np.minimum(np.minimum(x, tall - 1 - x), np.minimum(y, tall - 1 - y))
    cloud = 0.6 * _noise(rng, 8, 8) + 0.4 * _noise(rng, 32, 32)
    return np.where(edge == 0, 9.0, 0.8 * cloud + 0.8 * (edge == 1))


def _weave(rng: np.random.Generator) -> Pattern:
    """Return a plain weave: every thread passes over one and under the next; some threads are darker."""
    rows, columns = _rows_columns()
    over = (rows // 4 + columns // 4) % 2 == 0
    along = np.where(over, columns % 4, rows % 4)
    across = np.where(over, rows % 4, columns % 4)
    round_thread = np.where((across == 0) | (across == 3), 0.9, 0.1) + np.where((along == 0) | (along == 3), 0.5, 0.0)
    warp, weft = _noise(rng, 32, 2), _noise(rng, 2, 32)
    return round_thread + 1.3 * np.where(over, weft, warp) + 0.5 * _noise(rng, 8, 8)


def _quilt(rng: np.random.Generator) -> Pattern:
    """Return a quilt: stitched diamonds, padded between the seams."""
    rows, columns = _rows_columns()
    a, b = _wave((rows + columns) / 64), _wave((rows - columns) / 64)
    seam = np.maximum(a, b)
    return 1.6 * seam * seam * seam * seam + 1.5 * (seam > 0.96) + 0.5 * _noise(rng, 64, 64)


def _rug(rng: np.random.Generator) -> Pattern:
    """Return rows of knots with a zigzag woven in."""
    rows, columns = _rows_columns()
    zigzag = _wave(rows / 32 + _wave(columns / 32))
    knots = 0.5 * (rows % 2) + 0.7 * _noise(rng, 64, 64)
    return knots + 1.3 * (zigzag > 0.72)


def _carpet(rng: np.random.Generator) -> Pattern:
    """Return a carpet: tufts without a preferred direction."""
    tufts = _noise(rng, 64, 64)
    return 1.4 * tufts * tufts + 0.6 * _noise(rng, 128, 128) + 0.5 * _noise(rng, 8, 8)


def _plaster(rng: np.random.Generator) -> Pattern:
    """Return a painted wall: faint clouds and roller marks."""
    return 0.5 * _noise(rng, 4, 4) + 0.4 * _noise(rng, 16, 8) + 0.6 * _noise(rng, 64, 64)


def _stone(rng: np.random.Generator) -> Pattern:
    """Return the speckled stone of a worktop."""
    cloud = 0.6 * _noise(rng, 8, 8) + 0.4 * _noise(rng, 32, 32)
    grains = _noise(rng, 64, 64)
    return 0.7 * cloud + 1.6 * (grains > 0.8) + 1.6 * _speckle(rng, 0.03)


def _brick(rng: np.random.Generator) -> Pattern:
    """Return four bricks by eight courses, every other course offset by half a brick; the joints are lighter."""
    rows, columns = _rows_columns()
    course = rows // 16
    x = (columns + 16 * (course % 2)) % _PX
    tone = rng.integers(0, 256, (8, 4))[course, x // 32] / 256
    joint = (rows % 16 < 2) | (x % 32 < 1)
    brick = 0.6 + 1.2 * tone + 0.7 * _noise(rng, 64, 64) + 0.5 * _noise(rng, 16, 16)
    return np.where(joint, 0.4 * _noise(rng, 64, 64), brick)


def _render(rng: np.random.Generator) -> Pattern:
    """Return the rough render (plaster) of an outer wall."""
    grains = _noise(rng, 64, 64)
    return grains * grains + 0.5 * _noise(rng, 128, 128) + 0.6 * _noise(rng, 4, 4)


def _concrete(rng: np.random.Generator) -> Pattern:
    """Return the blotches and pores of concrete."""
    cloud = 0.5 * _noise(rng, 4, 4) + 0.3 * _noise(rng, 16, 16) + 0.2 * _noise(rng, 64, 64)
    return 1.2 * cloud + 2.0 * _speckle(rng, 0.015)


MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        "boards": Material(_boards, (1.2, 0.56), 0.12),
        "wood": Material(_grain, (1.6, 0.4), 0.12),
        "tiles": Material(_tiles, (0.6, 0.6), 0.06),
        "weave": Material(_weave, (0.24, 0.24), 0.12),
        "quilt": Material(_quilt, (0.48, 0.48), 0.08),
        "rug": Material(_rug, (0.5, 0.5), 0.12),
        "carpet": Material(_carpet, (0.5, 0.5), 0.12),
        "plaster": Material(_plaster, (1.6, 1.6), 0.03),
        "stone": Material(_stone, (0.5, 0.5), 0.10),
        "brick": Material(_brick, (0.96, 0.6), 0.14),
        "render": Material(_render, (0.8, 0.8), 0.10),
        "concrete": Material(_concrete, (1.6, 1.6), 0.08),
    }
)


@cache
def texture(material: str) -> Texture:
    """Return the texture image of a material, which is always the same object so that meshes share it."""
    record = MATERIALS[material]
    seed = np.frombuffer(material.encode().ljust(16, b"\0")[:16], "<u8").astype(np.uint64)
    darker = np.rint(record.make_pattern(np.random.Generator(np.random.Philox(key=seed))) * 65536).astype(np.int64)
    darker -= darker.min()
    light = 1 - darker * (record.darkening * darker.size / int(darker.sum()))
    grey = linear_to_bytes(np.rint(np.clip(light, 0, 1) * _STEPS) / _STEPS)
    pixels = np.full((*grey.shape, 4), 255, np.uint8)
    pixels[..., :3] = grey[..., None]
    return Texture(pixels=pixels, name=material)
