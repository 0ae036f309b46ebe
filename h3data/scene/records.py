"""Records of a scene: assets (meshes, collision parts, receptacles), their instances in the world, rooms, lights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import pose_to_matrix
from h3data.mesh.mesh import Mesh


# --- collision shapes: a closed family, always convex, in the asset's frame --------------------------------------------
@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """A box given by the pose of its centre."""

    pose: NDArray[np.float64]
    """pose7 of the centre in the asset frame, shape [7]."""
    half_extents: NDArray[np.float64]
    """Shape [3] [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cylinder:
    """A cylinder about the y axis of its own pose."""

    pose: NDArray[np.float64]
    """pose7 of the centre in the asset frame, shape [7]."""
    radius: float
    half_height: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Capsule:
    """The points within ``radius`` of the segment from ``start`` to ``end``."""

    start: NDArray[np.float64]
    """Shape [3] [m]."""
    end: NDArray[np.float64]
    """Shape [3] [m]."""
    radius: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Hull:
    """The convex hull of a set of points."""

    points: NDArray[np.float64]
    """Shape [N, 3] [m]."""


Shape = Box | Cylinder | Capsule | Hull


@dataclass(frozen=True, kw_only=True, eq=False)
class Receptacle:
    """A horizontal surface of an asset on which objects can be placed: a rectangle with free space above it."""

    name: str
    center: NDArray[np.float64]
    """Centre of the surface in the asset frame, shape [3] [m]."""
    half_size: NDArray[np.float64]
    """Half extents along the asset's x and z axes, shape [2] [m]."""
    clearance_m: float
    """Free height above the surface [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Asset:
    """One kind of object: its mesh, its collision shapes and the surfaces on which other objects can be placed."""

    name: str
    mesh: Mesh
    category: str = "object"
    shapes: tuple[Shape, ...] = ()
    """Convex collision parts; empty if nothing collides with it (a rug, a lamp shade)."""
    receptacles: tuple[Receptacle, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Asset({self.name!r}, {self.category}, {len(self.mesh.faces)} triangles, {len(self.shapes)} shapes, "
            f"{len(self.receptacles)} receptacles)"
        )


Motion = Literal["static", "kinematic"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """One asset placed in the world."""

    name: str
    asset: str
    pose: NDArray[np.float64]
    """pose7 of the asset frame in the world, shape [7]."""
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    """Scale per axis of the asset frame, shape [3]."""
    semantic_id: int = 0
    motion: Motion = "static"
    """``static`` for the building and its furniture, ``kinematic`` for objects that agents may move."""
    layer: str = ""
    """Named layers can be hidden from a camera: views from above hide ``ceiling``."""
    receptacles: tuple[str, ...] | None = None
    """Names of the asset's receptacles that may be used here; None = all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """A named floor area."""

    name: str
    category: str
    rectangles: NDArray[np.float64]
    """Disjoint rectangles ``x0 z0 x1 z1`` that make up the room, shape [R, 4] [m]."""
    floor_y: float = 0.0


LightKind = Literal["point", "directional", "spot"]
LightFrame = Literal["global", "camera", "object"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightSource:
    """A lamp or the sun, as in a Habitat lighting config. Baked light uses those in the global frame."""

    name: str
    kind: LightKind
    vector: NDArray[np.float64]
    """Direction in which the light of a ``directional`` source travels, else the position [m]; shape [3]."""
    color: NDArray[np.float64]
    """RGB, usually 0..1, shape [3]."""
    intensity: float
    """Factor on the colour; negative values subtract light, as in Habitat."""
    frame: LightFrame = "global"
    """Frame of ``vector``."""
    cone_rad: tuple[float, float] = (0.0, 0.0)
    """Half angles of a spot: full light inside the first, none outside the second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A home: assets, their instances, rooms and lights. World frame, +Y up, metres."""

    name: str
    assets: Mapping[str, Asset]
    instances: tuple[Instance, ...]
    rooms: tuple[Room, ...] = ()
    lights: tuple[LightSource, ...] | None = None
    """None if the source says nothing about light; empty if there are no lamps (Habitat then shows flat colours)."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """How to obtain the scene again, e.g. ``{"kind": "home", "preset": "small", "seed": 7}``, or Habitat's files."""

    def __post_init__(self) -> None:
        unknown = sorted({i.asset for i in self.instances} - set(self.assets))
        if unknown:
            raise SceneError(f"Scene {self.name!r}: instances refer to assets that it does not have: {unknown[:5]}.")
        names = [i.name for i in self.instances]
        if len(set(names)) != len(names):
            repeated = sorted({n for n in names if names.count(n) > 1})
            raise SceneError(f"Scene {self.name!r}: instance names must be unique, these are not: {repeated[:5]}.")

    @property
    def static_instances(self) -> tuple[Instance, ...]:
        return tuple(i for i in self.instances if i.motion == "static")

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Minimum and maximum corner of all instances, shape [2, 3] [m]."""
        boxes = [instance_bounds(self, i) for i in self.instances if len(self.assets[i.asset].mesh.vertices)]
        if not boxes:
            return np.zeros((2, 3))
        return np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)])

    def receptacles(self) -> Iterator[tuple[Instance, Receptacle]]:
        """Every usable receptacle of every static instance; Habitat names them ``instance|receptacle``."""
        for instance in self.static_instances:
            for receptacle in self.assets[instance.asset].receptacles:
                if instance.receptacles is None or receptacle.name in instance.receptacles:
                    yield instance, receptacle

    def __repr__(self) -> str:
        triangles = sum(len(self.assets[i.asset].mesh.faces) for i in self.instances)
        return (
            f"Scene({self.name!r}, {len(self.assets)} assets, {len(self.instances)} instances, {triangles} triangles, "
            f"{len(self.rooms)} rooms)"
        )


def instance_matrix(instance: Instance) -> NDArray[np.float64]:
    """4x4 matrix from asset frame to world, scale included."""
    matrix = pose_to_matrix(instance.pose).astype(np.float64)
    matrix[:3, :3] *= instance.scale
    return matrix


def instance_bounds(scene: Scene, instance: Instance) -> NDArray[np.float64]:
    """Axis-aligned box in the world around the bounding box of the instance's mesh, shape [2, 3] [m]."""
    lo, hi = scene.assets[instance.asset].mesh.bounds
    matrix = instance_matrix(instance)
    center = matrix[:3, :3] @ ((lo + hi) / 2) + matrix[:3, 3]
    half = np.abs(matrix[:3, :3]) @ ((hi - lo) / 2)
    return np.stack([center - half, center + half])
