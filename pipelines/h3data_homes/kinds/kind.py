"""Furniture and objects made from the models of the catalogue, with random sizes and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh
from h3data.scene.kinds import Kind, grasp_point_in
from h3data.scene.records import Asset, Shape
from h3data_homes.furnishing.furniture import Furniture, box_part, cylinder_part, surface
from h3data_homes.kinds import parts as solids
from h3data_homes.kinds.colours import colours_of
from h3data_homes.kinds.parts import Part
from h3data_homes.kinds.shapes import Model, model_of
from h3data_homes.solids import MeshBuilder
from h3data_homes.style import Style


@cache
def extent(kind: Kind) -> NDArray[np.float64]:
    """Return the bounding box of a kind's parts at scale 1, shape [2, 3] [m]."""
    mesh = MeshBuilder()
    for part in model_of(kind).parts:
        solids.add(mesh, part, (128, 128, 128), np.ones(3))
    return mesh.mesh().bounds.astype(float)


def grasp_point(kind: Kind) -> NDArray[np.float64]:
    """Return the point at which a hand grasps an object of this kind, in the model's frame at scale 1, shape [3] [m]."""
    return np.array(kind.hold_m) if kind.hold_m is not None else grasp_point_in(kind.grasp, extent(kind))


def is_aligned(kind: Kind) -> bool:
    """Return whether an object of this kind stands parallel to the edges of the surface below it."""
    return bool(kind.model) and model_of(kind).aligned


def _sampled_scale(model: Model, rng: np.random.Generator) -> NDArray[np.float64]:
    if len(model.scale) == 1:
        return np.full(3, rng.uniform(*model.scale[0]))
    return np.array([rng.uniform(*r) for r in model.scale])


class KindBuilder(MeshBuilder):
    """Mesh builder of a kind that collects its parts only on request, because most pieces are tried and discarded."""

    def __init__(self, kind_parts: Sequence[Part], seed: int, style: Style, scale: NDArray[np.float64]) -> None:
        super().__init__()
        self._later = kind_parts, seed, style, scale

    def mesh(self) -> Mesh:
        """Return the mesh of the model, built at the first call."""
        if self._mesh is None:
            parts, seed, style, scale = self._later
            color = colours_of(np.random.default_rng(seed), style)
            for part in parts:
                solids.add(self, part, color(part.color), scale)
        return super().mesh()


def builder_of(
    kind_parts: Sequence[Part], rng: np.random.Generator, style: Style, scale: NDArray[np.float64]
) -> MeshBuilder:
    """Return a mesh builder for some parts in random colours of a style."""
    return KindBuilder(kind_parts, int(rng.integers(1 << 62)), style, scale)


def _collision(kind: Kind, scale: NDArray[np.float64], origin: NDArray[np.float64]) -> tuple[Shape, ...]:
    """Return the collision parts in a frame with another origin."""
    model = model_of(kind)
    if model.blocks:
        found = []
        for x, y, z, w, h, d in model.blocks:
            center, size = np.array((x, y + h / 2, z)) * scale, np.array((w, h, d)) * scale
            found.append(box_part((center - origin).tolist(), size.tolist()))
        return tuple(found)
    low, high = extent(kind) * scale
    middle, size = (low + high) / 2 - origin, high - low
    if model.solid == "box":
        return (box_part(middle, size),)
    if model.solid == "round":
        return (cylinder_part(middle, float(max(size[0], size[2])) / 2, float(size[1])),)
    if model.solid == "none":
        return ()
    out: list[Shape] = []
    for part in model.parts:
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
    """Return a piece of furniture or a wall-mounted object of this kind, with random size and colours."""
    model = model_of(kind)
    scale = _sampled_scale(model, rng)
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
        for s in model.surfaces
    ]
    return Furniture(
        category=kind.name,
        builder=builder_of(model.parts, rng, style, scale),
        shapes=_collision(kind, scale, np.zeros(3)),
        receptacles=tuple(receptacles),
        size=(float(w), float(tall), float(d)),
        front_m=model.front_m,
        wall_gap_m=model.wall_gap_m,
    )


def thing_of(kind: Kind, rng: np.random.Generator, style: Style, name: str) -> Asset:
    """Return a small object of this kind as an asset whose origin is the middle of its bounding box."""
    model = model_of(kind)
    scale = _sampled_scale(model, rng)
    mesh = builder_of(model.parts, rng, style, scale).mesh()
    middle = mesh.bounds.astype(float).mean(0)
    mesh = replace(mesh, vertices=mesh.vertices - middle.astype(np.float32))
    return Asset(name=name, mesh=mesh, category=kind.name, shapes=_collision(kind, scale, middle))
