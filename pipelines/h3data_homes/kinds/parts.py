"""Functions that return the parts of basic shapes, from which models of kinds are made.

A position (x, y, z) is the middle of a part's footprint at its underside, or the centre of a ball. Lengths are in
metres. Rotations are in degrees about x, y and z (in this order), around the part's centre. Colours are names that
`colours` resolves, or sRGB triples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data_homes.solids import Color, MeshBuilder, shade, turn_x, turn_y

Paint = str | tuple[int, int, int]
Point = tuple[float, float, float]
PartShape = Literal["box", "rod", "lathe", "ball", "soft", "pillow", "line", "leaves"]


class Part(NamedTuple):
    """Solid that is one part of a kind's model."""

    shape: PartShape
    color: Paint
    at: Point
    size: tuple[float, ...]
    turn: Point = (0.0, 0.0, 0.0)
    rim: tuple[tuple[float, float], ...] = ()
    """Profile of a lathe as pairs of radius and height [m]."""
    detail: int = 12


def box(
    color: Paint,
    x: float,
    y: float,
    z: float,
    w: float,
    h: float,
    d: float,
    *,
    bevel: float = 0.0,
    turn: Point = (0, 0, 0),
) -> Part:
    """Return a box, which has 44 triangles with bevels and 12 without."""
    return Part("box", color, (x, y, z), (w, h, d, bevel), turn)


def rod(
    color: Paint,
    x: float,
    y: float,
    z: float,
    r: float,
    h: float,
    *,
    top: float | None = None,
    turn: Point = (0, 0, 0),
    n: int = 10,
) -> Part:
    """Return a closed cylinder, or a cone frustum with radius ``top``; ``y`` is its underside after the rotation."""
    return Part("rod", color, (x, y, z), (r, h, r if top is None else top), turn, detail=n)


def lathe(
    color: Paint,
    *rim: tuple[float, float],
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    n: int = 14,
    stretch: tuple[float, float] = (1.0, 1.0),
    turn: Point = (0, 0, 0),
) -> Part:
    """Return a profile of (radius, height) revolved about y; an ascending profile faces outwards."""
    return Part("lathe", color, (x, y, z), stretch, turn, rim, n)


def ball(
    color: Paint, x: float, y: float, z: float, rx: float, ry: float = 0.0, rz: float = 0.0, *, n: int = 10
) -> Part:
    """Return an ellipsoid about (x, y, z); radii that are not given equal the first one."""
    return Part("ball", color, (x, y, z), (rx, ry or rx, rz or rx), detail=n)


def soft(
    color: Paint,
    x: float,
    y: float,
    z: float,
    w: float,
    h: float,
    d: float,
    r: float = 0.03,
    *,
    turn: Point = (0, 0, 0),
) -> Part:
    """Return a box with rounded edges."""
    return Part("soft", color, (x, y, z), (w, h, d, r), turn)


def line(color: Paint, r: float, *points: Point, n: int = 6) -> tuple[Part, ...]:
    """Return a bent tube through points."""
    return tuple(Part("line", color, a, (*b, r), detail=n) for a, b in pairwise(points))


def leaves(
    color: Paint, x: float, y: float, z: float, count: int, length: float, lean: tuple[float, float], width: float
) -> Part:
    """Return leaves that rise around a stem and bend outwards; ``lean`` is their range of angles from upright [rad]."""
    return Part("leaves", color, (x, y, z), (length, *lean, width), detail=count)


def legs(color: Paint, half_x: float, half_z: float, top: float, thick: float = 0.04) -> tuple[Part, ...]:
    """Return the parts of four square legs."""
    return tuple(box(color, sx * half_x, 0, sz * half_z, thick, top, thick) for sx in (-1, 1) for sz in (-1, 1))


Nested = Part | tuple["Nested", ...]


def flat(parts: Sequence[Nested]) -> tuple[Part, ...]:
    """Return the parts of nested tuples, in order."""
    out: list[Part] = []
    for part in parts:
        if isinstance(part, Part):
            out.append(part)
        else:
            out += flat(part)
    return tuple(out)


# --- from parts to triangles ------------------------------------------------------------------------------------------
Scale = NDArray[np.float64]


def add(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    """Add a part to a mesh, scaled along x, y and z."""
    _ADD[part.shape](mesh, part, color, scale)


def _turned(part: Part) -> NDArray[np.float64] | None:
    x, y, z = np.radians(part.turn).tolist()
    if not any((x, y, z)):
        return None
    c, s = np.cos(z), np.sin(z)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn_y(y) @ turn_x(x)


def _centre(part: Part, scale: Scale, height: float) -> NDArray[np.float64]:
    return np.array(part.at) * scale + (0.0, height / 2, 0.0)


def _box(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    size = np.array(part.size[:3]) * scale
    mesh.box(_centre(part, scale, size[1]), size, color, bevel=part.size[3], turn=_turned(part))


def _rod(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    r, h, top = part.size
    wide, turn = float(min(scale[0], scale[2])), _turned(part)
    axis = 1 if turn is None else int(np.abs(turn[:, 1]).argmax())
    long = h * float(scale[axis])
    half = h / 2 if axis == 1 else max(r, top)
    centre = np.array([part.at[0], part.at[1] + half, part.at[2]]) * scale
    mesh.cylinder(centre, r * wide, long, color, top_radius=top * wide, segments=part.detail, turn=turn)


def _lathe(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    rim = [(r, y * float(scale[1])) for r, y in part.rim]
    stretch = (part.size[0] * float(scale[0]), part.size[1] * float(scale[2]))
    center = np.array(part.at) * scale
    mesh.lathe(rim, color, center=center, segments=part.detail, stretch=stretch, turn=_turned(part))


def _ball(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    radii = (np.array(part.size) * scale).tolist()
    rings = max(4, part.detail // 2 + 1)
    mesh.ellipsoid(np.array(part.at) * scale, radii, color, segments=part.detail, rings=rings)


def _soft(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    size = np.array(part.size[:3]) * scale
    mesh.cushion(_centre(part, scale, size[1]), size, color, radius=part.size[3], turn=_turned(part))


def _pillow(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    size = np.array(part.size) * scale
    mesh.pillow(_centre(part, scale, size[1]), size, color, turn=_turned(part))


def _line(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    a, b = np.array(part.at) * scale, np.array(part.size[:3]) * scale
    along = b - a
    length = float(np.linalg.norm(along))
    up = along / max(length, 1e-9)
    side = np.cross((0.0, 0.0, 1.0) if abs(up[2]) < 0.9 else (1.0, 0.0, 0.0), up)
    side /= np.linalg.norm(side)
    turn = np.stack([side, up, np.cross(side, up)], 1)
    radius = part.size[3] * float(min(scale[0], scale[2]))
    mesh.cylinder((a + b) / 2, radius, length + 0.6 * radius, color, segments=part.detail, turn=turn)


def _leaves(mesh: MeshBuilder, part: Part, color: Color, scale: Scale) -> None:
    length, low, high, width = part.size
    base, s = np.array(part.at) * scale, np.linspace(0, 1, 4)
    for i in range(part.detail):
        around = 2.399963 * i  # the golden angle spreads any number of leaves evenly
        lean = low + (high - low) * (0.5 + 0.5 * np.sin(5.3 * i))
        long = length * float(scale[1]) * (0.78 + 0.22 * np.cos(3.1 * i))
        out, rise = long * np.sin(lean) * s**1.5, long * np.cos(lean * s) * s
        wide = width * float(scale[0]) * np.array([0.35, 0.95, 0.8, 0.04])
        c, q = np.sin(around), np.cos(around)
        middle = base + np.stack([out * c, rise, out * q], 1)
        left, right = (middle + sign * np.outer(wide, (q, 0, -c)) for sign in (-1, 1))
        front = np.stack([left[:-1], right[:-1], right[1:], left[1:]], 1)
        mesh.quads(front, shade(color, 0.9 + 0.07 * (i % 4)))
        mesh.quads(front[:, ::-1] - 0.001 * np.array([c, 0, q]), shade(color, 0.75 + 0.07 * (i % 4)))


_ADD: Mapping[PartShape, Callable[[MeshBuilder, Part, Color, Scale], None]] = {
    "box": _box,
    "rod": _rod,
    "lathe": _lathe,
    "ball": _ball,
    "soft": _soft,
    "pillow": _pillow,
    "line": _line,
    "leaves": _leaves,
}
