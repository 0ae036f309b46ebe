"""Parametric pieces of furniture, and the helpers that build them.

The asset frame has its origin on the floor below the centre of the footprint, +Y up, and the front facing +Z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from h3data.geometry import IDENTITY_POSE
from h3data.scene.records import Asset, Box, Cylinder, Receptacle, Shape
from h3data_homes.solids import Color, MeshBuilder, vary
from h3data_homes.style import Style

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from h3data_homes.furnishing.opening.placing import Opening

HEAD_BAND = (0.05, 1.8)
"""Range of heights in which shapes obstruct walkers, ankle to head [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Furniture:
    """Piece of furniture with the data for its placement."""

    category: str
    builder: MeshBuilder
    """Function that builds the visual mesh; only `asset` calls it, once the piece is placed."""
    shapes: tuple[Shape, ...]
    receptacles: tuple[Receptacle, ...]
    size: tuple[float, float, float]
    """Footprint and height: x, y, z [m]."""
    front_m: float = 0.0
    """Depth of the strip along the front that stays free for users [m]."""
    wall_gap_m: float = 0.02
    """Distance from the back of the piece to the wall [m]."""
    opens: Callable[[int], Opening] | None = None
    """Function that returns the same piece with doors and drawers that open, given the number of such pieces already
    placed; None if nothing opens."""

    @property
    def solid(self) -> bool:
        """Return whether the piece has collision shapes."""
        return bool(self.shapes)

    @cached_property
    def outline(self) -> BaseGeometry:
        """Footprint of the collision shapes within `HEAD_BAND`, as polygons in the asset frame (x, z) [m]."""
        import shapely

        from h3data.scene.freespace._footprints import shape_footprint

        parts = [_upright_box(s) or shape_footprint(s, np.eye(4), *HEAD_BAND) for s in self.shapes]
        return shapely.union_all([p for p in parts if p is not None])

    def asset(self, name: str) -> Asset:
        """Return the piece as an asset of a scene."""
        return Asset(
            name=name,
            mesh=self.builder.mesh(),
            category=self.category,
            shapes=self.shapes,
            receptacles=self.receptacles,
        )


def _upright_box(shape: Shape) -> BaseGeometry | None:
    """Return the footprint of an axis-aligned box that obstructs walkers, the common case; None for other shapes."""
    if not isinstance(shape, Box) or shape.pose[6] != 1:
        return None
    import shapely

    (x, y, z), (a, h, c) = shape.pose[:3].tolist(), shape.half_extents.tolist()
    reaches = y + h > HEAD_BAND[0] and y - h < HEAD_BAND[1]
    return shapely.box(x - a, z - c, x + a, z + c) if reaches else None


Maker = Callable[[np.random.Generator, Style], Furniture]


def box_part(center: ArrayLike, size: ArrayLike) -> Box:
    """Build a collision box by its centre and full size."""
    pose = IDENTITY_POSE.copy()
    pose[:3] = center
    return Box(pose=pose, half_extents=np.asarray(size, float) / 2)


def cylinder_part(center: ArrayLike, radius: float, height: float) -> Cylinder:
    """Build an upright collision cylinder by its centre, radius and height [m]."""
    pose = IDENTITY_POSE.copy()
    pose[:3] = center
    return Cylinder(pose=pose, radius=radius, half_height=height / 2)


def surface(name: str, center: ArrayLike, size: ArrayLike, clearance: float) -> Receptacle:
    """Build a receptacle from the centre of its surface, its full size along x and z, and the free height above it [m]."""
    return Receptacle(
        name=name, center=np.asarray(center, float), half_size=np.asarray(size, float) / 2, clearance_m=clearance
    )


def finish(
    category: str,
    mesh: MeshBuilder,
    size: tuple[float, float, float],
    *,
    shapes: Sequence[Shape] = (),
    receptacles: Sequence[Receptacle] = (),
    front: float = 0.0,
    wall_gap: float = 0.02,
    opens: Callable[[int], Opening] | None = None,
) -> Furniture:
    """Return the `Furniture` record of a finished model."""
    return Furniture(
        category=category,
        builder=mesh,
        shapes=tuple(shapes),
        receptacles=tuple(receptacles),
        size=size,
        front_m=front,
        wall_gap_m=wall_gap,
        opens=opens,
    )


def legs(mesh: MeshBuilder, half_x: float, half_z: float, top: float, color: Color, thick: float = 0.05) -> list[Shape]:
    """Add four square legs below a top; return their collision boxes."""
    shapes: list[Shape] = []
    for sx in (-1, 1):
        for sz in (-1, 1):
            center = (sx * half_x, top / 2, sz * half_z)
            mesh.box(center, (thick, top, thick), color, bevel=0.004)
            shapes.append(box_part(center, (thick, top, thick)))
    return shapes


def cabinet_front(
    mesh: MeshBuilder,
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    color: Color,
    handle: Color,
    *,
    knob: str = "top",
) -> None:
    """Add a door or drawer front with a thin shadow gap around it and a bar handle; ``z`` is the front of the carcass."""
    (x0, x1), (y0, y1), gap = x, y, 0.004
    # The front extends 2 mm into the carcass: coincident faces would flicker for a camera that gets inside.
    mesh.span((x0 + gap, y0 + gap, z - 0.002), (x1 - gap, y1 - gap, z + 0.018), color, bevel=0.003)
    middle = (x0 + x1) / 2
    if knob == "none":
        return
    if knob == "top":
        bar = min(0.16, 0.5 * (x1 - x0))
        mesh.box((middle, y1 - 0.05, z + 0.03), (bar, 0.012, 0.024), handle)
    else:
        at = x1 - 0.05 if knob == "right" else x0 + 0.05
        mesh.box((at, (y0 + y1) / 2, z + 0.03), (0.012, min(0.3, 0.5 * (y1 - y0)), 0.024), handle)


_SPINES: tuple[Color, ...] = (
    (150, 52, 44),
    (44, 74, 112),
    (58, 96, 74),
    (196, 160, 84),
    (222, 214, 196),
    (88, 66, 54),
    (110, 118, 128),
    (122, 72, 96),
)
"""Colours of book spines."""


def books(
    mesh: MeshBuilder, rng: np.random.Generator, x: tuple[float, float], y: float, z: tuple[float, float], tall: float
) -> None:
    """Add a row of upright books in the range ``x``, standing at height ``y``."""
    at = x[0]
    while at < x[1] - 0.05:
        thick = rng.uniform(0.018, 0.045)
        height, depth = tall * rng.uniform(0.7, 1.0), (z[1] - z[0]) * rng.uniform(0.75, 0.98)
        color = _SPINES[int(rng.integers(len(_SPINES)))]
        mesh.span((at, y, z[0]), (at + thick - 0.002, y + height, z[0] + depth), vary(rng, color, 0.12), bevel=0.002)
        at += thick


def stacks(
    mesh: MeshBuilder, rng: np.random.Generator, x: tuple[float, float], y: float, z: tuple[float, float], tall: float
) -> None:
    """Add a row of boxes and jars in the range ``x``, standing at height ``y``."""
    at, middle = x[0], (z[0] + z[1]) / 2
    while True:
        wide = float(rng.uniform(0.08, 0.22))
        color, height = vary(rng, _SPINES[int(rng.integers(len(_SPINES)))], 0.15), tall * float(rng.uniform(0.45, 0.95))
        if at + wide > x[1]:
            return
        if wide < 0.12:
            r = min(wide - 0.01, z[1] - z[0]) / 2
            mesh.cylinder(
                (at + wide / 2, y + height / 2, middle), r, height, vary(rng, (214, 206, 188), 0.1), segments=12
            )
            mesh.cylinder((at + wide / 2, y + height + 0.01, middle), r * 0.96, 0.02, color, segments=12)
        else:
            mesh.span((at + 0.005, y, z[0]), (at + wide - 0.005, y + height, z[1]), color, bevel=0.003)
        at += wide
