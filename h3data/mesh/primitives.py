"""Meshes of simple solids, and of Magnum's primitives, which Habitat recordings name (``cylinderSolid_rings_1_...``)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import SceneError
from h3data.geometry import Array, normalized
from h3data.mesh.gltf_primitives import DEFAULT_COLOR
from h3data.mesh.mesh import Mesh

_NAME = re.compile(r"^(cube|capsule3D|cylinder|cone|uvSphere|icosphere)(Solid|Wireframe)(_|$)")


def is_primitive(name: str) -> bool:
    """Return whether a recorded asset name is one of Magnum's primitives, not a file."""
    return _NAME.match(name) is not None


@lru_cache(maxsize=256)
def primitive_mesh(name: str) -> Mesh:
    """Return the mesh of habitat-sim's primitive with a name such as ``capsule3DSolid_hemiRings_4_..._halfLen_0.75_...``.

    All have radius (or half edge) 1 and the y axis as their axis; ``halfLen`` is half the length of the straight part.
    Segments start at +Z, as in Magnum. Wireframes consist of lines and become a mesh without triangles.
    """
    match = _NAME.match(name)
    if match is None:
        raise SceneError(
            f"Not a primitive: {name!r}. Expected cube, capsule3D, cylinder, cone, uvSphere or icosphere, then Solid.",
            code="H3-MESH-029",
        )
    kind, style, _ = match.groups()
    if style == "Wireframe":
        return _mesh(np.zeros((0, 3)), np.zeros((0, 3)))
    # limited, as a length that float32 cannot hold would make a mesh of infinities
    segments, half = _count(name, "segments", 12, least=3), min(_number(name, "halfLen", 1.0), 1e6)
    rings = _count(name, "rings", 1)
    if kind == "cube":
        return box_mesh((1, 1, 1))
    if kind == "icosphere":
        return _icosphere(_count(name, "subdivs", 1, least=0))
    if kind == "uvSphere":
        angles = np.linspace(-np.pi / 2, np.pi / 2, _count(name, "rings", 8, least=2) + 1)
        return _lathe(np.cos(angles), np.sin(angles), _count(name, "segments", 16, least=3), smooth=True)
    if kind == "capsule3D":
        quarter = np.linspace(0, np.pi / 2, _count(name, "hemiRings", 4) + 1)
        radii = np.concatenate([np.cos(quarter[::-1]), np.cos(quarter)])
        heights = np.concatenate([-half - np.sin(quarter[::-1]), half + np.sin(quarter)])
        return _lathe(radii, heights, segments, smooth=True)
    heights = np.linspace(-half, half, rings + 1)
    radii = np.ones(rings + 1) if kind == "cylinder" else np.linspace(1, 0, rings + 1)
    if kind == "cylinder" and "capEnds_false" not in name:
        radii, heights = np.r_[0, radii, 0], np.r_[-half, heights, half]
    elif kind == "cone" and "capEnd_false" not in name:
        radii, heights = np.r_[0, radii], np.r_[-half, heights]
    return _lathe(radii, heights, segments, smooth=False)


def box_mesh(half_extents: ArrayLike, *, center: ArrayLike = (0, 0, 0), color: Sequence[int] = DEFAULT_COLOR) -> Mesh:
    """Return an axis-aligned box, shaded flat."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return _mesh(corners * np.asarray(half_extents, np.float64) + np.asarray(center, np.float64), faces, color=color)


def capsule_mesh(start: ArrayLike, end: ArrayLike, radius: float, *, color: Sequence[int] = DEFAULT_COLOR) -> Mesh:
    """Return a capsule around the line segment from ``start`` to ``end``, with 12 segments."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length if length > 0 else np.array([0.0, 1.0, 0.0])
    # any direction across, but not one along the axis, whose cross product would vanish
    side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 0, 1.0])
    side /= np.linalg.norm(side)
    rotation = np.stack([side, axis, np.cross(side, axis)], axis=1)
    unit = primitive_mesh(f"capsule3DSolid_hemiRings_4_cylRings_1_segments_12_halfLen_{length / 2 / radius:.6f}")
    assert unit.normals is not None
    return Mesh(
        vertices=(unit.vertices * radius @ rotation.T + (a + b) / 2).astype(np.float32),
        faces=unit.faces,
        colors=np.broadcast_to(np.asarray(color, np.uint8), unit.vertices.shape).copy(),
        normals=(unit.normals @ rotation.T).astype(np.float32),
    )


def round_mesh(
    radius: float, length: float, color: tuple[int, int, int], *, caps: bool, segments: int = 20, rings: int = 6
) -> Mesh:
    """Return a capsule (``caps``) or a cylinder along z, centred at the origin, with smooth normals.

    A capsule of length 0 is a sphere.
    """
    half = length / 2
    if caps:
        angle = np.linspace(-np.pi / 2, np.pi / 2, 2 * rings)
        profile = np.stack([radius * np.cos(angle), radius * np.sin(angle) + np.where(angle > 0, half, -half)], axis=1)
        slope = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:  # rim vertices twice: once for the flat end, once for the side
        profile = np.array([[0, -half], [radius, -half], [radius, -half], [radius, half], [radius, half], [0, half]])
        slope = np.array([[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1.0]])
    turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)

    def swept(rows: Array) -> Array:
        flat = rows[:, None, :1] * ring
        return np.concatenate([flat, np.broadcast_to(rows[:, None, 1:], (*flat.shape[:2], 1))], axis=2).reshape(-1, 3)

    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(segments), indexing="ij")
    a, b = i * segments + j, i * segments + (j + 1) % segments
    quads = np.stack([np.stack([a, b, b + segments], -1), np.stack([a, b + segments, a + segments], -1)])
    return _mesh(swept(profile), quads.reshape(-1, 3), normals=normalized(swept(slope)), color=color)


def _count(name: str, key: str, default: int, *, least: int = 1) -> int:
    # at most 256: a name in a file must not decide how much memory is allocated
    return int(min(max(_number(name, key, default), least), 256))


def _number(name: str, key: str, default: float) -> float:
    match = re.search(rf"(?:^|_){key}_(\d+(?:\.\d+)?(?:e[-+]?\d+)?)", name)
    return float(match.group(1)) if match else default


def _mesh(
    vertices: ArrayLike, faces: ArrayLike, *, normals: ArrayLike | None = None, color: Sequence[int] = DEFAULT_COLOR
) -> Mesh:
    v = np.asarray(vertices, np.float32).reshape(-1, 3)
    return Mesh(
        vertices=v,
        faces=np.asarray(faces, np.int32).reshape(-1, 3),
        colors=np.broadcast_to(np.asarray(color, np.uint8), v.shape).copy(),
        normals=None if normals is None else np.asarray(normals, np.float32),
    )


def _lathe(radii: NDArray[np.float64], heights: NDArray[np.float64], segments: int, *, smooth: bool) -> Mesh:
    """Return a profile (bottom to top) revolved about the y axis; ``smooth`` adds the normals of a sphere-ended profile."""
    angle = np.arange(segments) * 2 * np.pi / segments
    circle = np.stack([np.sin(angle), np.zeros(segments), np.cos(angle)], -1)
    ring = radii[:, None, None] * circle + heights[:, None, None] * np.array([0, 1.0, 0])
    low = np.arange(len(radii) - 1)[:, None] * segments
    i, j = np.arange(segments), (np.arange(segments) + 1) % segments
    lower = np.stack(np.broadcast_arrays(low + i, low + j, low + segments + j), -1)
    upper = np.stack(np.broadcast_arrays(low + i, low + segments + j, low + segments + i), -1)
    # triangles at a pole or in a cap's centre have no area: drop them
    keep_lower, keep_upper = radii[:-1] > 1e-9, radii[1:] > 1e-9
    faces = np.concatenate([lower[keep_lower].reshape(-1, 3), upper[keep_upper].reshape(-1, 3)])
    normals = None
    if smooth:  # on spheres and capsules the profile radius is the sine of the polar angle
        up = np.sqrt(np.clip(1 - radii**2, 0, 1)) * np.sign(np.arange(len(radii)) - (len(radii) - 1) / 2)
        normals = (radii[:, None, None] * circle + up[:, None, None] * np.array([0, 1.0, 0])).reshape(-1, 3)
    return _mesh(ring.reshape(-1, 3), faces, normals=normals)


def _icosphere(subdivisions: int) -> Mesh:
    """Return Magnum's icosahedron, each triangle split into four ``subdivisions`` times and pushed out to radius 1."""
    from scipy.spatial import ConvexHull

    # edges of an icosahedron in the unit sphere: 1 and the golden ratio, scaled to length 1
    s, l = 0.525731112119133606, 0.850650808352039932
    base = np.array([(0, a * s, b * l) for a in (1, -1) for b in (1, -1)])
    points = np.concatenate([base, base[:, [2, 0, 1]], base[:, [1, 2, 0]]])
    faces = ConvexHull(points).simplices
    for _ in range(min(subdivisions, 6)):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].mean(1)
        ab, bc, ca = inverse.reshape(3, -1) + len(points)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, -1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    corners = points[faces]
    # the hull gives its triangles in any order of corners
    inside_out = np.sum(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners[:, 0], -1) < 0
    faces[inside_out] = faces[inside_out][:, ::-1]
    return _mesh(points, faces, normals=points)
