"""Shapes by which the files in ``datasets/kinds/`` describe the models of the catalogue.

A position ``at`` (x, y, z) is the middle of a shape's footprint at its underside, or the centre of a ball or arc.
Lengths are in metres. Rotations are in degrees about x, y and z (in this order), around the shape's centre. Colours are
names that `colours` resolves, or sRGB triples.
"""

from __future__ import annotations

from functools import cache, cached_property
from itertools import chain
from typing import Literal

import msgspec
import numpy as np

from h3data.scene.kinds import Kind
from h3data_homes.kinds import parts
from h3data_homes.kinds.parts import Paint, Part, Point

Solid = Literal["box", "round", "parts", "none"]
"""Kind of the collision shapes of a model: the bounding box, an upright cylinder, the upright boxes and rods among the
parts, or none."""


class Shape(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="shape", tag=str.lower):
    """Base of the shapes of a model."""

    color: Paint

    def parts(self) -> tuple[Part, ...]:
        """Return the solids of the shape."""
        raise NotImplementedError


class Box(Shape, frozen=True):
    """Box shape, which has 44 triangles with bevels and 12 without."""

    at: Point
    size: tuple[float, float, float]
    bevel: float = 0.0
    turn: Point = (0, 0, 0)

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the box."""
        return (parts.box(self.color, *self.at, *self.size, bevel=self.bevel, turn=self.turn),)


class Rod(Shape, frozen=True):
    """Closed cylinder, or cone frustum with the radius ``top`` at its top; ``at`` is its underside after the rotation."""

    at: Point
    radius: float
    height: float
    top: float | None = None
    turn: Point = (0, 0, 0)
    sides: int = 10

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the cylinder or cone frustum."""
        return (parts.rod(self.color, *self.at, self.radius, self.height, top=self.top, turn=self.turn, n=self.sides),)


class Lathe(Shape, frozen=True):
    """Solid of revolution of a profile (radius, height) about y; an ascending profile faces outwards."""

    rim: tuple[tuple[float, float], ...]
    at: Point = (0.0, 0.0, 0.0)
    stretch: tuple[float, float] = (1.0, 1.0)
    turn: Point = (0, 0, 0)
    sides: int = 14

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the solid of revolution."""
        x, y, z = self.at
        more = {"n": self.sides, "stretch": self.stretch, "turn": self.turn}
        return (parts.lathe(self.color, *self.rim, x=x, y=y, z=z, **more),)  # type: ignore[arg-type]


class Ball(Shape, frozen=True):
    """Ellipsoid about its centre."""

    at: Point
    radii: tuple[float, float, float]
    sides: int = 10

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the ellipsoid."""
        return (parts.ball(self.color, *self.at, *self.radii, n=self.sides),)


class Soft(Shape, frozen=True):
    """Box with rounded edges."""

    at: Point
    size: tuple[float, float, float]
    radius: float
    turn: Point = (0, 0, 0)

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the rounded box."""
        return (parts.soft(self.color, *self.at, *self.size, self.radius, turn=self.turn),)


class Pillow(Shape, frozen=True):
    """Pillow that lies flat."""

    at: Point
    size: tuple[float, float, float]
    turn: Point = (0, 0, 0)

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the pillow."""
        return (Part("pillow", self.color, self.at, self.size, self.turn),)


class Line(Shape, frozen=True):
    """Bent tube through points."""

    radius: float
    points: tuple[Point, ...]
    sides: int = 6

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the bent tube."""
        return parts.line(self.color, self.radius, *self.points, n=self.sides)


class Arc(Shape, frozen=True):
    """Tube along an arc of radius ``bend`` in a plane of constant z, between two angles [deg] (0 = +x, 90 = up)."""

    at: Point
    bend: float
    angles: tuple[float, float]
    radius: float
    pieces: int = 6

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the arc."""
        x, y, z = self.at
        angle = np.radians(np.linspace(*self.angles, self.pieces + 1))
        points = ((x + self.bend * float(np.cos(a)), y + self.bend * float(np.sin(a)), z) for a in angle)
        return parts.line(self.color, self.radius, *points, n=5)


class Leaves(Shape, frozen=True):
    """Leaves around a stem that rise and bend outwards; ``lean`` is their range of angles from upright [rad]."""

    at: Point
    count: int
    length: float
    lean: tuple[float, float]
    width: float

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the leaves."""
        return (parts.leaves(self.color, *self.at, self.count, self.length, self.lean, self.width),)


class Legs(Shape, frozen=True):
    """Four square legs at +-``half`` along x and z, up to the height ``top``."""

    half: tuple[float, float]
    top: float
    thick: float = 0.04

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the legs."""
        return parts.legs(self.color, *self.half, self.top, self.thick)


class Fronts(Shape, frozen=True):
    """Doors or drawers with handles on the front of a carcass, at ``at_z`` and between two heights [m]."""

    handle: Paint
    width: float
    heights: tuple[float, float]
    at_z: float
    rows: int = 1
    columns: int = 1
    knob: bool = False

    def parts(self) -> tuple[Part, ...]:
        """Return the parts of the doors or drawers."""
        found: list[Part] = []
        (low, high), z = self.heights, self.at_z
        a, b = self.width / self.columns, (high - low) / self.rows
        for i in range(self.columns):
            for k in range(self.rows):
                x, y = -self.width / 2 + (i + 0.5) * a, low + k * b
                found.append(parts.box(self.color, x, y + 0.004, z + 0.008, a - 0.008, b - 0.008, 0.02, bevel=0.003))
                if self.knob:
                    at = (x, y + b / 2 - 0.011, z + 0.029)
                    found.append(parts.rod(self.handle, *at, 0.011, 0.022, turn=(90, 0, 0), n=8))
                else:
                    size = (min(0.14, a / 2), 0.012, 0.02)
                    found.append(parts.box(self.handle, x, y + b - min(0.05, b / 2), z + 0.026, *size))
        return tuple(found)


class Surface(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Receptacle of a kind: the middle of its surface, its full size along x and z, and the free height above it [m]."""

    name: str
    at: Point
    size: tuple[float, float]
    clearance: float


class Model(msgspec.Struct, frozen=True, kw_only=True, eq=False, dict=True, forbid_unknown_fields=True):
    """Model of one kind of furniture or object: its shapes, collision shapes and receptacles."""

    shapes: tuple[Box | Rod | Lathe | Ball | Soft | Pillow | Line | Arc | Leaves | Legs | Fronts, ...] = msgspec.field(
        name="parts"
    )
    solid: Solid = "box"
    blocks: tuple[tuple[float, float, float, float, float, float], ...] = ()
    """Collision boxes (x, underside, z, width, height, depth) [m] that replace those of ``solid``."""
    surfaces: tuple[Surface, ...] = ()
    front_m: float = 0.0
    """Depth of the free floor that is needed in front [m]."""
    wall_gap_m: float = 0.02
    scale: tuple[tuple[float, float], ...] = ((0.94, 1.06),)
    """Ranges of scale factors: one for all axes, or one each for x, y and z."""
    aligned: bool = False
    """True if the object stands parallel to the edges of the furniture below it."""

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Parts of all shapes, in order."""
        return tuple(chain.from_iterable(shape.parts() for shape in self.shapes))


@cache
def model_of(kind: Kind) -> Model:
    """Return the model of a kind whose `Kind.model` is given.

    Raises:
        ValueError: the kind has no model in the catalogue.
    """
    if not kind.model:
        raise ValueError(f"The kind {kind.name!r} has no model in the catalogue.")
    return msgspec.json.decode(kind.model, type=Model)
