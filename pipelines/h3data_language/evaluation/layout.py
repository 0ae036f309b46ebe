"""Geometry for propositions (boxes of things, surfaces and rooms), stored as JSON in a recording's info.

With the layout and the columns of the recording, an evaluation needs neither the scene nor the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, suggest
from h3data.geometry import heading_from_quat
from h3data.scene import Scene, instance_matrix
from h3data.scene.articulation import joints_of

LAYOUT = "evaluation_layout"
Vector = tuple[float, float, float]


class ThingBox(msgspec.Struct, frozen=True):
    """Movable thing, with its box and the index of its pose in a recording."""

    body: int
    """Index of the thing's body, as in ``agent_<i>.grasp_body``."""
    center: Vector
    """Center of the box in the frame of the thing [m]."""
    half: Vector
    """Half extents of the box along the axes of the thing [m]."""


class Surface(msgspec.Struct, frozen=True):
    """Rectangle on which things can be placed."""

    center: Vector
    """Centre of the surface in the world [m]."""
    half: tuple[float, float]
    """Half extents along the surface's own x and z axes [m]."""
    heading: float
    """Heading of the surface: its rotation about +Y [rad]."""
    clearance: float
    """Free height above the surface [m]."""
    inside: bool = False
    """True if the surface is in a drawer or behind a door of the furniture."""


class FurnitureBox(msgspec.Struct, frozen=True):
    """Piece of furniture, with its box in the world and its surfaces."""

    center: Vector
    half: Vector
    surfaces: tuple[Surface, ...] = ()


class Layout(msgspec.Struct, frozen=True):
    """All things, furniture and rooms that propositions may name."""

    things: dict[str, ThingBox]
    """Things of the home, in the order of ``object_pose``."""
    furniture: dict[str, FurnitureBox]
    rooms: dict[str, tuple[tuple[float, float, float, float], ...]]
    """Rectangles ``x0 z0 x1 z1`` that make up each room [m]."""
    floor_y: float = 0.0

    @classmethod
    def of_info(cls, info: Mapping[str, Any]) -> Layout:
        """Read the layout in the info of a recording.

        Raises:
            InputError: the recording has no layout, or the layout is malformed.
        """
        try:
            layout = msgspec.convert(info.get(LAYOUT), cls)
        except msgspec.ValidationError as fault:
            why = str(fault).replace("`", "")
            raise InputError(
                f"Expected {LAYOUT} in the info, with things, furniture and rooms, got: {why}.", code="H3-LANGUAGE-005"
            ) from None
        numbers = [x for t in layout.things.values() for x in (*t.center, *t.half)]
        numbers += [x for f in layout.furniture.values() for s in f.surfaces for x in (*s.center, *s.half, s.heading)]
        if not np.isfinite(numbers).all():
            raise InputError(f"Expected finite numbers in {LAYOUT}, got NaN or infinite ones.", code="H3-LANGUAGE-003")
        return layout

    @classmethod
    def of_scene(cls, scene: Scene, things: Sequence[str], floor_y: float = 0.0) -> Layout:
        """Describe a home and its movable things."""
        joints = joints_of(scene)
        furniture = {}
        for instance in scene.instances:
            asset = scene.assets[instance.asset]
            if instance.motion != "static" or not asset.receptacles:
                continue
            matrix, scale = instance_matrix(instance), np.abs(instance.scale)
            low, high = _bounds(matrix, asset.mesh.bounds)
            heading, surfaces = float(heading_from_quat(instance.pose[3:])), []
            for r in asset.receptacles:
                name = f"{instance.name}|{r.name}"
                center, half = (matrix @ np.append(r.center, 1.0))[:3], r.half_size * scale[[0, 2]]
                enclosed = bool(joints.enclosing.get(name))
                mover = joints.owner.get(instance.name, -1)
                if mover >= 0:  # of a drawer: where it is closed, where it is open, and between
                    moved = [
                        (m[mover] @ np.append(center, 1.0))[:3]
                        for m in map(joints.motions, (joints.closed, joints.opened))
                    ]
                    c, s = np.cos(heading), np.sin(heading)
                    d = (moved[1] - moved[0])[[0, 2]]
                    half = half + np.abs([c * d[0] - s * d[1], s * d[0] + c * d[1]]) / 2
                    center = (moved[0] + moved[1]) / 2
                surfaces.append(
                    Surface(_rounded(center), _rounded(half), round(heading, 6), round(r.clearance_m, 4), enclosed)
                )
            owner = owner_of(scene, instance.name)
            known = furniture.get(owner)
            if known is not None:
                low = np.minimum(low, np.subtract(known.center, known.half))
                high = np.maximum(high, np.add(known.center, known.half))
            furniture[owner] = FurnitureBox(
                _rounded((low + high) / 2),
                _rounded((high - low) / 2),
                (*(known.surfaces if known else ()), *surfaces),
            )
        names = [i.name for i in scene.instances]
        boxes = {}
        for thing in things:
            instance = scene.instances[names.index(thing)]
            low, high = np.asarray(scene.assets[instance.asset].mesh.bounds, np.float64) * instance.scale
            boxes[thing] = ThingBox(names.index(thing), _rounded((low + high) / 2), _rounded((high - low) / 2))
        rooms = {
            r.name: tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in r.rectangles) for r in scene.rooms
        }
        return cls(boxes, furniture, rooms, float(floor_y))

    def require(self, name: str, *kinds: str) -> None:
        """Raise an `InputError` if none of the given kinds (``things``, ``furniture``, ``rooms``) has the name."""
        known = [each for kind in kinds for each in getattr(self, kind)]
        if name not in known:
            raise InputError(
                f"A proposition names {name!r}, which is not in this home.{suggest(name, known)}",
                code="H3-LANGUAGE-004",
            )


def owner_of(scene: Scene, name: str) -> str:
    """Return the thing to which a part belongs, such as the cabinet of a drawer or the articulated object of a link."""
    for thing in scene.articulations:
        if any(name in part.instances for part in thing.parts):
            name = thing.base or thing.name
            break
    return name.partition("/")[0]


def _bounds(matrix: NDArray[np.float64], bounds: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = np.asarray(bounds, np.float64)
    corners = np.array(
        [[x, y, z, 1.0] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    world = (corners @ matrix.T)[:, :3]
    return world.min(0), world.max(0)


def _rounded(values: Any) -> Any:
    return tuple(round(float(v), 4) for v in values)
