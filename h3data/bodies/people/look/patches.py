"""Patches: meshes of skin, garments or hair that lie over the base mesh of any body.

All bodies have the same base vertices at different positions. A vertex of a patch is offset from a point of the base
along the normal there and in a fixed direction, in units of the size of the body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import normalized

UNIT_M = 1e-4
SHARE_UNIT = 1 / 255
SHADE_UNIT = 1 / 128

Floats = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Mesh of skin, a garment or hair that lies over the base mesh of a body."""

    corners: NDArray[np.uint16]
    """Three vertices of the base under each vertex, shape [V, 3]."""
    shares: Floats
    """Weights of the three base vertices, which sum to 1, shape [V, 3]."""
    lift: Floats
    """Distance of each vertex along the base's normal [m], shape [V]."""
    offset: Floats | None
    """Offset of each vertex along the axes of the rest pose, for a body whose ruler has the length ``ruler_m`` [m],
    shape [V, 3]."""
    ruler: tuple[int, int]
    """Indices of two vertices of the base, whose distance is the length of the ruler."""
    ruler_m: float
    faces: NDArray[np.int32]
    joints: NDArray[np.uint8]
    """Joints that move each vertex, shape [V, 4]."""
    weights: Floats
    """Weights of the joints that move each vertex, which sum to 1, shape [V, 4]."""
    slots: NDArray[np.uint8]
    """Index into `SLOTS` of the colour that each vertex has, shape [V]."""
    shade: Floats
    """Factor on the colour of each vertex, shape [V]."""
    paint: NDArray[np.uint8]
    """Strength of each layer of `PAINTS` on skin, 0..255, shape [V, `PAINTS`]; cloth has no columns."""
    body_normals: bool
    """True if the patch is shaded with the normals of the base instead of its own."""

    def placed(self, vertices: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Return the vertices [V, 3] [m] and normals of the patch over a base mesh [B, 3] [m] with normals."""
        point = np.einsum("vk,vkj->vj", self.shares, vertices[self.corners])
        up = normalized(np.einsum("vk,vkj->vj", self.shares, normals[self.corners])).astype(np.float32)
        point += self.lift[:, None] * up
        if self.offset is not None:
            length = np.linalg.norm(vertices[self.ruler[0]] - vertices[self.ruler[1]])
            point += np.float32(length / self.ruler_m) * self.offset
        return point, up if self.body_normals else vertex_normals(point, self.faces)


def read_patch(data: Mapping[str, NDArray[Any]], prefix: str) -> Patch:
    """Return the patch whose arrays in a file have names with ``prefix``."""
    shares = data[f"{prefix}/shares"].astype(np.float32)
    # the third one is what is left of 255, so that files hold two
    shares = np.concatenate([shares, 255 - shares.sum(axis=1, keepdims=True)], axis=1) * np.float32(SHARE_UNIT)
    weights = data[f"{prefix}/weights"].astype(np.float32)
    offset = data.get(f"{prefix}/offset")
    ruler = data.get(f"{prefix}/ruler", np.array([0, 1]))
    return Patch(
        corners=data[f"{prefix}/corners"],
        shares=shares,
        lift=data[f"{prefix}/lift"].astype(np.float32) * np.float32(UNIT_M),
        offset=None if offset is None else offset.astype(np.float32) * np.float32(UNIT_M),
        ruler=(int(ruler[0]), int(ruler[1])),
        ruler_m=float(data.get(f"{prefix}/ruler_m", np.array(1.0))),
        faces=unpack_faces(data[f"{prefix}/faces"]),
        joints=data[f"{prefix}/joints"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        slots=data[f"{prefix}/slots"],
        shade=data[f"{prefix}/shade"].astype(np.float32) * np.float32(SHADE_UNIT),
        paint=data.get(f"{prefix}/paint", np.zeros((len(shares), 0), np.uint8)),
        body_normals=f"{prefix}/paint" in data,
    )


def unpack_faces(planes: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the triangles [F, 3] in planes of bytes [3, 2, F] of small differences, of which wardrobes consist."""
    steps = planes[:, 0].astype(np.uint16) | planes[:, 1].astype(np.uint16) << np.uint16(8)
    # sums wrap at 16 bits, as the differences did
    first = np.cumsum(steps[0], dtype=np.uint16)
    return np.stack([first, first + steps[1], first + steps[2]], axis=1).astype(np.int32)


def vertex_normals(vertices: Floats, faces: NDArray[np.int32], surface: NDArray[np.integer] | None = None) -> Floats:
    """Return unit normals per vertex [V, 3], the mean of the adjacent faces weighted by their areas.

    Normals at degenerate faces point up. Vertices with the same number in ``surface`` [V] share a normal.
    """
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    corners = faces.ravel() if surface is None else surface[faces.ravel()]
    count = len(vertices) if surface is None else int(surface.max()) + 1
    total = np.stack([np.bincount(corners, cross[:, k], minlength=count) for k in range(3)], axis=1)
    total[np.abs(total).max(axis=1) < 1e-12] = (0, 1, 0)
    own = normalized(total).astype(np.float32)
    return own if surface is None else own[surface]
