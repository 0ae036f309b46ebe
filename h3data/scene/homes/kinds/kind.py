"""`Kind`: one kind of thing as a table of parts, with its class, mass, grasp and surfaces; and what is made from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh
from h3data.scene.homes.furnishing.furniture import Furniture, box_part, cylinder_part, surface
from h3data.scene.homes.kinds import parts as shapes
from h3data.scene.homes.kinds.colours import colours_of
from h3data.scene.homes.kinds.parts import Nested, Part, flat
from h3data.scene.homes.solids import MeshBuilder
from h3data.scene.homes.style import Style
from h3data.scene.records import Asset, Shape

Grasp = Literal["body", "rim", "handle", "top", "edge", "none"]
"""What a hand takes hold of: the whole thing around its middle, the rim of an open vessel, a handle, its top, a flat edge
(plates, books, boards); nothing, if it is too heavy or fixed."""
Solid = Literal["box", "round", "parts", "none"]
"""Collision parts: the bounding box, an upright cylinder, the upright boxes and rods among the parts, or nothing."""
Role = Literal["thing", "furniture", "wall", "building"]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A receptacle of a kind: middle of the surface, its full size along x and z, free height above it [m]."""

    name: str
    at: tuple[float, float, float]
    size: tuple[float, float]
    clearance: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Kind:
    """One kind of thing. Frame of its parts: +Y up, front +Z, standing at y = 0; wall things have their back at z = 0."""

    name: str
    """Its semantic class (`Asset.category`)."""
    semantic_id: int
    role: Role
    mass_kg: float
    """A typical mass."""
    grasp: Grasp
    hold_m: tuple[float, float, float] | None = None
    """Where a handle is; None = the place that follows from ``grasp``."""
    parts: tuple[Part, ...] = ()
    """Empty for kinds of the first generation, which functions make."""
    solid: Solid = "box"
    blocks: tuple[tuple[float, float, float, float, float, float], ...] = ()
    """Collision boxes (x, underside, z, width, height, depth), instead of those of ``solid``."""
    surfaces: tuple[Surface, ...] = ()
    front_m: float = 0.0
    wall_gap_m: float = 0.02
    scale: tuple[tuple[float, float], ...] = ((0.94, 1.06),)
    """Range of sizes: one for all axes, or one each for x, y and z."""
    aligned: bool = False
    """Whether it stands parallel to the edges of what it stands on."""


def thing(
    name: str,
    mass_kg: float,
    grasp: Grasp,
    *parts: Nested,
    solid: Solid = "box",
    hold: tuple[float, float, float] | None = None,
    scale: tuple[float, float] = (0.94, 1.06),
    aligned: bool = False,
) -> Kind:
    """A small, movable thing; its id is given by its place in the table (`numbered`)."""
    return Kind(
        name=name,
        semantic_id=0,
        role="thing",
        mass_kg=mass_kg,
        grasp=grasp,
        hold_m=hold,
        parts=flat(parts),
        solid=solid,
        scale=(scale,),
        aligned=aligned,
    )


def piece(
    name: str,
    mass_kg: float,
    *parts: Nested,
    solid: Solid = "box",
    blocks: Sequence[tuple[float, float, float, float, float, float]] = (),
    surfaces: Sequence[Surface] = (),
    front: float = 0.0,
    wall_gap: float = 0.02,
    scale: tuple[tuple[float, float], ...] = ((0.96, 1.04),),
    role: Role = "furniture",
    grasp: Grasp = "none",
) -> Kind:
    """A piece of furniture, or with the role ``wall`` a thing on a wall."""
    return Kind(
        name=name,
        semantic_id=0,
        role=role,
        mass_kg=mass_kg,
        grasp=grasp,
        parts=flat(parts),
        solid=solid,
        blocks=tuple(blocks),
        surfaces=tuple(surfaces),
        front_m=front,
        wall_gap_m=wall_gap,
        scale=scale,
    )


def top(x: float, y: float, z: float, w: float, d: float, clearance: float = 1.0, *, name: str = "top") -> Surface:
    """A surface at height ``y``."""
    return Surface(name=name, at=(x, y, z), size=(w, d), clearance=clearance)


def numbered(first: int, kinds: Sequence[Kind]) -> Mapping[str, Kind]:
    """Kinds by name with consecutive ids. Recorded images contain these numbers: append to a table, never reorder."""
    return {k.name: replace(k, semantic_id=first + i) for i, k in enumerate(kinds)}


# --- what is made from a kind -----------------------------------------------------------------------------------------
@cache
def extent(kind: Kind) -> NDArray[np.float64]:
    """Bounding box of a kind's parts at scale 1, shape [2, 3] [m]."""
    mesh = MeshBuilder()
    for part in kind.parts:
        shapes.add(mesh, part, (128, 128, 128), np.ones(3))
    return mesh.mesh().bounds.astype(float)


def grasp_point(kind: Kind) -> NDArray[np.float64]:
    """Point that a hand takes hold of, in the frame of the kind's parts at scale 1, shape [3] [m]."""
    return np.array(kind.hold_m) if kind.hold_m is not None else grasp_point_in(kind.grasp, extent(kind))


def grasp_point_in(grasp: Grasp, bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Point that a hand takes hold of in a thing with this box [2, 3] [m], +Y up; its middle where a handle is not known."""
    low, high = bounds
    middle = (low + high) / 2
    if grasp == "rim":
        return np.array([high[0], high[1], middle[2]])
    if grasp == "edge":
        return np.array([middle[0], middle[1], high[2]])
    if grasp == "top":
        return np.array([middle[0], high[1], middle[2]])
    return middle


def _sampled_scale(kind: Kind, rng: np.random.Generator) -> NDArray[np.float64]:
    ranges = kind.scale * 3 if len(kind.scale) == 1 else kind.scale
    if len(kind.scale) == 1:
        return np.full(3, rng.uniform(*ranges[0]))
    return np.array([rng.uniform(*r) for r in ranges])


class KindBuilder(MeshBuilder):
    """A model whose parts are collected only when its mesh is asked for: most pieces are tried and discarded."""

    def __init__(self, kind_parts: Sequence[Part], seed: int, style: Style, scale: NDArray[np.float64]) -> None:
        super().__init__()
        self._later = kind_parts, seed, style, scale

    def mesh(self) -> Mesh:
        """Mesh of the model, built at the first call."""
        if self._mesh is None:
            parts, seed, style, scale = self._later
            color = colours_of(np.random.default_rng(seed), style)
            for part in parts:
                shapes.add(self, part, color(part.color), scale)
        return super().mesh()


def builder_of(
    kind_parts: Sequence[Part], rng: np.random.Generator, style: Style, scale: NDArray[np.float64]
) -> MeshBuilder:
    """The model of some parts in random colours of a style."""
    return KindBuilder(kind_parts, int(rng.integers(1 << 62)), style, scale)


def _collision(kind: Kind, scale: NDArray[np.float64], origin: NDArray[np.float64]) -> tuple[Shape, ...]:
    """Collision parts in a frame with another origin."""
    if kind.blocks:
        found = []
        for x, y, z, w, h, d in kind.blocks:
            center, size = np.array((x, y + h / 2, z)) * scale, np.array((w, h, d)) * scale
            found.append(box_part((center - origin).tolist(), size.tolist()))
        return tuple(found)
    low, high = extent(kind) * scale
    middle, size = (low + high) / 2 - origin, high - low
    if kind.solid == "box":
        return (box_part(middle, size),)
    if kind.solid == "round":
        return (cylinder_part(middle, float(max(size[0], size[2])) / 2, float(size[1])),)
    if kind.solid == "none":
        return ()
    out: list[Shape] = []
    for part in kind.parts:
        if part.shape not in ("box", "rod") or any(part.turn):
            continue
        h = part.size[1] * float(scale[1])
        center = np.array(part.at) * scale + (0, h / 2, 0) - origin
        if part.shape == "box":
            out.append(box_part(center, np.array(part.size[:3]) * scale))
        else:
            out.append(cylinder_part(center, max(part.size[0], part.size[2]) * float(min(scale[0], scale[2])), h))
    return tuple(out)


def furniture_of(kind: Kind, rng: np.random.Generator, style: Style) -> Furniture:
    """A piece of furniture or a wall thing of this kind, with random size and colours."""
    scale = _sampled_scale(kind, rng)
    low, high = extent(kind) * scale
    w, d = 2 * max(-low[0], high[0]), 2 * max(-low[2], high[2])
    if kind.role == "wall":
        d = high[2]
    tall = high[1] - (low[1] if kind.role == "wall" else 0.0)
    receptacles = [
        surface(
            s.name,
            np.array(s.at) * scale,
            (np.array(s.size) * scale[[0, 2]]).tolist(),
            s.clearance * (float(scale[1]) if s.clearance < 0.6 else 1.0),
        )
        for s in kind.surfaces
    ]
    return Furniture(
        category=kind.name,
        builder=builder_of(kind.parts, rng, style, scale),
        shapes=_collision(kind, scale, np.zeros(3)),
        receptacles=tuple(receptacles),
        size=(float(w), float(tall), float(d)),
        front_m=kind.front_m,
        wall_gap_m=kind.wall_gap_m,
    )


def thing_of(kind: Kind, rng: np.random.Generator, style: Style, name: str) -> Asset:
    """A small thing as an asset whose origin is the middle of its bounding box."""
    scale = _sampled_scale(kind, rng)
    mesh = builder_of(kind.parts, rng, style, scale).mesh()
    middle = mesh.bounds.astype(float).mean(0)
    mesh = replace(mesh, vertices=mesh.vertices - middle.astype(np.float32))
    return Asset(name=name, mesh=mesh, category=kind.name, shapes=_collision(kind, scale, middle))
