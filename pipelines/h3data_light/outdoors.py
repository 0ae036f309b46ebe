"""Views through window panes: sky, hills, trees and a lawn, painted on the panes.

The horizon is at eye height from every position in a room, so the picture on a pane has the right height everywhere.
Sideways it moves with the window.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import transform_points
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.mesh_operations import face_texture_indices, flat_shaded
from h3data.srgb import linear_to_bytes

EYE_M = 1.55
"""Height of the horizon above the lowest surface of a scene, if a window allows it."""
_WIDE_M, _HIGH_M = 9.0, 4.5
"""Width and height of the picture [m], with the horizon in its middle."""
_PIXELS = (512, 256)
_PLANE_M = 0.02
"""Distance of panes from the middle plane of their window, at most [m]."""


def with_view(mesh: Mesh, matrix: NDArray[np.float64], *, floor_y: float, shown: float) -> Mesh:
    """Return a window's mesh with a picture of the outdoors on its panes.

    ``shown`` is the factor from linear colours to vertex colours. Panes are the faces in the middle plane of the
    axis-aligned window. A mesh without panes is returned unchanged.
    """
    mesh = flat_shaded(mesh) if mesh.normals is None else mesh
    place = transform_points(matrix, mesh.vertices.astype(np.float64))
    low, high = place.min(0), place.max(0)
    across = 0 if high[0] - low[0] < high[2] - low[2] else 2
    corners = place[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normal[:, across]) > 0.99 * np.linalg.norm(normal, axis=1)
    area = np.linalg.norm(normal, axis=1)
    if not flat.any() or not area[flat].sum() > 0:
        return mesh
    middle = np.average(corners[flat].mean(1)[:, across], weights=area[flat])
    panes = flat & (np.abs(corners[:, :, across] - middle).max(1) < _PLANE_M)
    if not panes.any():
        return mesh
    used, faces = np.unique(mesh.faces[panes], return_inverse=True)
    horizon = np.clip(floor_y + EYE_M, *(low[1] + share * (high[1] - low[1]) for share in (0.3, 0.6)))
    along = place[used, 2 - across] / _WIDE_M + (0.37 if across else 0.0)
    up = 0.5 - (place[used, 1] - horizon) / _HIGH_M
    uv = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uv is None else mesh.uv
    textures = np.concatenate([face_texture_indices(mesh)[~panes], np.full(panes.sum(), len(mesh.textures))])
    if not mesh.textures:
        textures[: (~panes).sum()] = -1
    colors = np.broadcast_to(linear_to_bytes(np.array([min(shown, 1.0)] * 3)), (len(used), 3))
    assert mesh.normals is not None
    return Mesh(
        vertices=np.concatenate([mesh.vertices, mesh.vertices[used]]),
        faces=np.concatenate([mesh.faces[~panes], faces.reshape(-1, 3) + len(mesh.vertices)]).astype(np.int32),
        colors=np.concatenate([mesh.colors, colors]),
        normals=np.concatenate([mesh.normals, mesh.normals[used]]),
        uv=np.concatenate([uv, np.column_stack([along, up]).astype(np.float32)]),
        textures=(*mesh.textures, outdoors()),
        face_textures=textures.astype(np.int16),
    )


@lru_cache(maxsize=1)
def outdoors() -> Texture:
    """Return the picture of the outdoors, which repeats sideways."""
    width, height = _PIXELS
    x = np.arange(width) / width * 2 * np.pi
    metres = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * _HIGH_M  # above the horizon
    haze = np.clip(metres / (0.5 * _HIGH_M), 0, 1)[..., None] ** 0.7
    picture = (1 - haze) * np.array([0.80, 0.88, 0.95]) + haze * np.array([0.36, 0.58, 0.88])
    picture = np.broadcast_to(picture, (height, width, 3)).copy()
    cloud = sum(np.sin(k * x + p) / k for k, p in ((2, 0.3), (3, 1.9), (5, 4.0), (9, 2.2)))
    band = np.exp(-(((metres - 0.75 - 0.1 * np.sin(3 * x + 1)) / (0.12 + 0.05 * np.sin(2 * x))) ** 2))
    picture += 0.35 * (np.clip(cloud, 0, 1) * band)[..., None] * (1 - picture)
    hills = 0.16 + 0.07 * np.sin(2 * x + 0.5) + 0.04 * np.sin(5 * x + 2)
    _over(picture, metres, hills, np.array([0.44, 0.58, 0.62]))
    _over(picture, metres, 0.08 + 0.05 * np.sin(3 * x + 4) + 0.02 * np.sin(7 * x), np.array([0.34, 0.50, 0.40]))
    crowns = sum(0.05 * np.abs(np.sin(k * x + p)) for k, p in ((4, 0.2), (7, 1.3), (11, 0.7), (17, 2.9)))
    trees = -0.08 + np.clip(1.6 * np.sin(2 * x + 2.6), -0.2, 1) * 0.22 + crowns
    _over(picture, metres, trees, np.array([0.16, 0.30, 0.14]), top=np.array([0.27, 0.42, 0.19]), deep=0.3)
    _over(picture, metres, -0.1 + 0 * x, np.array([0.30, 0.46, 0.18]), top=np.array([0.38, 0.52, 0.25]), deep=1.2)
    _over(picture, metres, -0.5 + 0.03 * np.abs(np.sin(23 * x)), np.array([0.14, 0.27, 0.11]), deep=0.25)
    pixels = np.full((height, width, 4), 255, np.uint8)
    pixels[..., :3] = linear_to_bytes(picture)
    return Texture(pixels=pixels, name="outdoors")


def _over(
    picture: NDArray[np.float64],
    metres: NDArray[np.float64],
    outline: NDArray[np.float64],
    color: NDArray[np.float64],
    *,
    top: NDArray[np.float64] | None = None,
    deep: float = 1.0,
) -> None:
    """Paint what reaches up to an outline [W] [m]; its edge is soft, and ``top`` turns into ``color`` ``deep`` below."""
    below = outline - metres
    cover = np.clip(below / 0.035 + 0.5, 0, 1)[..., None]
    share = np.clip(below / deep, 0, 1)[..., None]
    picture[:] = (1 - cover) * picture + cover * (share * color + (1 - share) * (color if top is None else top))
