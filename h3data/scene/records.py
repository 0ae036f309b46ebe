"""Records of a scene: assets with collision shapes and receptacles, instances, doors and drawers, rooms, and lights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import pose_to_matrix
from h3data.mesh.mesh import Mesh


# --- collision shapes: a closed family, always convex, in the asset's frame --------------------------------------------
@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """Collision box, given by the pose of its centre and its size."""

    pose: NDArray[np.float64]
    """Pose (pose7) of the centre in the asset frame, shape [7]."""
    half_extents: NDArray[np.float64]
    """Half of each side length, shape [3] [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cylinder:
    """Collision cylinder about the y axis of its own pose."""

    pose: NDArray[np.float64]
    """Pose (pose7) of the centre in the asset frame, shape [7]."""
    radius: float
    half_height: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Capsule:
    """Collision capsule: all points within ``radius`` [m] of the segment from ``start`` to ``end``."""

    start: NDArray[np.float64]
    """First end of the axis, shape [3] [m]."""
    end: NDArray[np.float64]
    """Second end of the axis, shape [3] [m]."""
    radius: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Hull:
    """Collision shape that is the convex hull of a set of points."""

    points: NDArray[np.float64]
    """Corners of the hull in the asset frame, shape [N, 3] [m]."""


Shape = Box | Cylinder | Capsule | Hull


@dataclass(frozen=True, kw_only=True, eq=False)
class Receptacle:
    """Horizontal surface of an asset on which objects can be placed: a rectangle with free space above it."""

    name: str
    center: NDArray[np.float64]
    """Centre of the surface in the asset frame, shape [3] [m]."""
    half_size: NDArray[np.float64]
    """Half extents along the asset's x and z axes, shape [2] [m]."""
    clearance_m: float
    """Free height above the surface [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Asset:
    """Kind of object: its mesh, its collision shapes and the surfaces on which other objects can be placed."""

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
    """Instance of an asset with its pose in the world."""

    name: str
    asset: str
    pose: NDArray[np.float64]
    """Pose (pose7) of the asset frame in the world, shape [7]."""
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    """Scale per axis of the asset frame, shape [3]."""
    semantic_id: int = 0
    motion: Motion = "static"
    """Kind of motion: ``static`` for the building and its furniture, ``kinematic`` for objects that agents may move."""
    layer: str = ""
    """Name of the layer, which cameras can hide: views from above hide ``ceiling``."""
    receptacles: tuple[str, ...] | None = None
    """Names of the asset's receptacles that may be used; None = all."""


@dataclass(frozen=True, kw_only=True)
class Ramp:
    """Straight flight of stairs in a room, whose floor rises from `Room.floor_y` to ``top_y`` and is level at both ends."""

    axis: Literal[0, 1]
    """Plan axis along which the stairs rise: 0 = x, 1 = z."""
    start: float
    """Coordinate of the lower end of the ramp along its axis [m]."""
    end: float
    """Coordinate of the upper end of the ramp [m]; smaller than ``start`` if it rises towards lower coordinates."""
    top_y: float
    """Height of the floor at the upper end [m]."""
    steps: int
    """Number of risers. They stand in the middle of equal parts, so the ramp passes through the middle of every tread."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """Room of a scene: a named floor area."""

    name: str
    category: str
    rectangles: NDArray[np.float64]
    """Disjoint rectangles ``x0 z0 x1 z1`` that make up the room, shape [R, 4] [m]."""
    floor_y: float = 0.0
    """Height of the room's floor [m]; if it has a ramp, at the lower end."""
    ramp: Ramp | None = None
    """Stairs to a room on another storey."""


# --- things that open --------------------------------------------------------------------------------------------------
JointKind = Literal["revolute", "prismatic"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """Joint of an articulated object, whose part moves about or along an axis.

    At position 0 it is closed, as in Habitat.

    Axis and origin are in the frame of the object, with all joints at ``rest``.
    """

    kind: JointKind
    axis: NDArray[np.float64]
    """Direction of the axis, shape [3], made a unit vector; a ``revolute`` joint turns about it by the right-hand
    rule."""
    lower: float
    """Lower limit of the position [rad or m]."""
    upper: float
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """Position of a point on the axis, shape [3] [m]; a ``prismatic`` joint needs none."""
    rest: float = 0.0
    """Position at which instances have the poses that the scene gives [rad or m]."""

    def __post_init__(self) -> None:
        axis, origin = (np.asarray(v, np.float64) for v in (self.axis, self.origin))
        numbers = (self.lower, self.upper, self.rest)
        if self.kind not in get_args(JointKind):
            raise SceneError(
                f"Unknown kind of joint {self.kind!r}. Expected one of: {', '.join(get_args(JointKind))}.",
                code="H3-SCENE-038",
            )
        if axis.shape != (3,) or not np.isfinite(axis).all() or not np.any(axis):
            raise SceneError(
                f"The axis of a joint must be 3 finite numbers, not all 0; got {axis.tolist()}.", code="H3-SCENE-039"
            )
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise SceneError(
                f"The origin of a joint must be 3 finite numbers; got {origin.tolist()}.", code="H3-SCENE-040"
            )
        if not np.isfinite(numbers).all():
            raise SceneError(f"Limits and rest position of a joint must be finite; got {numbers}.", code="H3-SCENE-041")
        if self.lower == self.upper:
            raise SceneError(
                f"A joint with equal limits ({self.lower:g}) cannot move. Hint: make its part fixed.",
                code="H3-SCENE-042",
            )
        if self.lower > self.upper:
            raise SceneError(
                f"The limits of a joint are reversed: lower {self.lower:g} is above upper {self.upper:g}.",
                code="H3-SCENE-043",
            )
        if not self.lower <= self.rest <= self.upper:
            raise SceneError(
                f"The rest position of a joint, {self.rest:g}, is outside its limits {self.lower:g} to {self.upper:g}.",
                code="H3-SCENE-044",
            )
        length = float(np.linalg.norm(axis))  # a unit vector stays as it is, to the bit
        object.__setattr__(self, "axis", axis if abs(length - 1.0) < 1e-12 else axis / length)
        object.__setattr__(self, "origin", origin)

    @property
    def closed(self) -> float:
        """Position nearest to 0, at which the part is closed [rad or m]."""
        return min(max(0.0, self.lower), self.upper)

    @property
    def opened(self) -> float:
        """Limit farther from `closed` [rad or m]."""
        # a door that opens both ways is open on the side on which it opens farther
        return self.upper if self.upper - self.closed >= self.closed - self.lower else self.lower


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Moving part of an articulated object: a door or a drawer, with the objects in it."""

    name: str
    """Name of the part, unique in the object; ``thing/part`` is the name of the joint in the scene."""
    joint: Joint
    instances: tuple[str, ...]
    """Instances that move with the joint: the part itself, and objects that lie on it in the scene."""
    parent: str = ""
    """Name of the part to which this part is attached; empty for the static body of the object."""
    encloses: tuple[str, ...] = ()
    """Receptacles (``instance|receptacle``) that are out of reach unless the part is open."""
    handle: NDArray[np.float64] | None = None
    """Point at which a hand takes hold, in the frame of the object with all joints at rest, shape [3] [m]; None if unknown."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Articulation:
    """Object with moving parts, such as a fridge; parts come after the parts that carry them."""

    name: str
    pose: NDArray[np.float64]
    """Pose (pose7) of the frame of the object in the world, shape [7]; in metres, without scale."""
    parts: tuple[Part, ...]
    base: str = ""
    """Name of the instance that stands still; empty if there is none."""


LightKind = Literal["point", "directional", "spot"]
LightFrame = Literal["global", "camera", "object"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightSource:
    """Light source: a lamp or the sun, as in a Habitat lighting config.

    Baked light uses the sources in the global frame.
    """

    name: str
    kind: LightKind
    vector: NDArray[np.float64]
    """Direction in which the light of a ``directional`` source travels, else the position [m]; shape [3]."""
    color: NDArray[np.float64]
    """RGB, usually 0..1, shape [3]."""
    intensity: float
    """Factor on the colour; negative values subtract light, as in Habitat."""
    frame: LightFrame = "global"
    """Frame of reference of ``vector``."""
    cone_rad: tuple[float, float] = (0.0, 0.0)
    """Half angles of a spot: full light inside the first, none outside the second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Scene or home: assets, their instances, rooms and lights, in the world frame (+Y up, metres)."""

    name: str
    assets: Mapping[str, Asset]
    instances: tuple[Instance, ...]
    rooms: tuple[Room, ...] = ()
    lights: tuple[LightSource, ...] | None = None
    """Light sources; None if unknown, empty if there are no lamps (Habitat then shows flat colours)."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Source from which the scene can be generated or read again, such as
    ``{"kind": "home", "preset": "small", "seed": 7}``, or Habitat's files."""
    articulations: tuple[Articulation, ...] = ()
    """Objects with doors or drawers; `h3data.scene.articulation` poses them."""

    def __post_init__(self) -> None:
        unknown = sorted({i.asset for i in self.instances} - set(self.assets))
        if unknown:
            raise SceneError(
                f"Scene {self.name!r}: instances refer to assets that it does not have: {unknown[:5]}.",
                code="H3-SCENE-045",
            )
        # recordings, joints and receptacles refer to instances by name
        names = [i.name for i in self.instances]
        if len(set(names)) != len(names):
            repeated = sorted({n for n in names if names.count(n) > 1})
            raise SceneError(
                f"Scene {self.name!r}: instance names must be unique, these are not: {repeated[:5]}.",
                code="H3-SCENE-046",
            )
        if self.articulations and (fault := self._articulation_fault()):
            raise SceneError(f"Scene {self.name!r}: {fault}.", code="H3-SCENE-047")

    @property
    def static_instances(self) -> tuple[Instance, ...]:
        """Instances that never move."""
        return tuple(i for i in self.instances if i.motion == "static")

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Minimum and maximum corner of all instances, shape [2, 3] [m]."""
        # a mesh without vertices has a box at its origin, in which there is nothing
        boxes = [instance_bounds(self, i) for i in self.instances if len(self.assets[i.asset].mesh.vertices)]
        if not boxes:
            return np.zeros((2, 3))
        return np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)])

    def receptacles(self) -> Iterator[tuple[Instance, Receptacle]]:
        """Yield every usable receptacle of every static instance; Habitat names them ``instance|receptacle``."""
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

    def _articulation_fault(self) -> str:
        """Return the first fault of the scene's articulated things, or nothing."""
        # ``moved`` goes through all things and ``before`` through the parts of one: names of parts repeat from thing to thing
        names, moved = {i.name for i in self.instances}, set[str]()
        if len({a.name for a in self.articulations}) < len(self.articulations):
            return "articulated things must have different names"
        for thing in self.articulations:
            if np.shape(thing.pose) != (7,) or not np.isfinite(thing.pose).all():
                return f"the pose of {thing.name!r} must be 7 finite numbers"
            if not thing.parts:
                return f"{thing.name!r} has no moving parts"
            if thing.base and thing.base not in names:
                return f"the base of {thing.name!r} is no instance: {thing.base!r}"
            before: set[str] = set()
            for part in thing.parts:
                joint = f"{thing.name}/{part.name}"
                if part.name in before:
                    return f"two parts are called {joint!r}"
                if part.parent and part.parent not in before:
                    return f"{joint!r} hangs on {part.parent!r}, which is no part before it"
                if unknown := sorted(set(part.instances) - names):
                    return f"{joint!r} moves instances that do not exist: {unknown[:5]}"
                if twice := sorted(
                    moved.intersection((*part.instances, thing.base)) | ({thing.base} & set(part.instances))
                ):
                    return f"{joint!r} moves what another part moves or what stands still: {twice[:5]}"
                if part.handle is not None and (np.shape(part.handle) != (3,) or not np.isfinite(part.handle).all()):
                    return f"the handle of {joint!r} must be 3 finite numbers"
                before.add(part.name)
                moved |= set(part.instances)
        return ""


def instance_matrix(instance: Instance) -> NDArray[np.float64]:
    """Return the 4x4 matrix from the frame of the asset to the world, scale included."""
    matrix = pose_to_matrix(instance.pose).astype(np.float64)
    # columns: the scale is along the axes of the asset, before it is turned
    matrix[:3, :3] *= instance.scale
    return matrix


def instance_bounds(scene: Scene, instance: Instance) -> NDArray[np.float64]:
    """Return the axis-aligned box in the world around the bounding box of the instance's mesh, shape [2, 3] [m]."""
    lo, hi = scene.assets[instance.asset].mesh.bounds
    matrix = instance_matrix(instance)
    center = matrix[:3, :3] @ ((lo + hi) / 2) + matrix[:3, 3]
    # the box around the turned box, without its eight corners
    half = np.abs(matrix[:3, :3]) @ ((hi - lo) / 2)
    return np.stack([center - half, center + half])
