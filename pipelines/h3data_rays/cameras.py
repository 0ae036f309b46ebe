"""Images by ray casting: fisheye and equirectangular cameras, and every camera of the back end ``rays``.

Depth, ids and normals are exact, from one ray per pixel. Colours of a non-planar camera are resampled from the six
faces of a cube around it, which the rasteriser renders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.render.camera import Camera, pinhole
from h3data_rays.rays import RayCaster

_MARGIN_PX = 2
"""Margin around the faces of the cube, for interpolation."""
_LARGEST_FACE_PX = 4096


def cast_picture(caster: RayCaster, camera: Camera, results: Mapping[str, NDArray]) -> None:
    """Fill every output [H, W, ...] except ``rgb`` by ray casting, for a camera of any projection."""
    start, directions = camera.rays()
    turn, eye = camera.pose[:3, :3], camera.pose[:3, 3]
    origins, directions = (start + camera.near * directions) @ turn.T + eye, directions @ turn.T
    hits = caster.cast(origins, directions, max_m=camera.far - camera.near)
    hit, scene = hits.instance >= 0, caster.scene
    if "depth" in results:
        results["depth"][:] = np.where(hit, hits.distance + np.float32(camera.near), 0)
    if "triangle" in results:
        results["triangle"][:] = hits.triangle
    for name, table in (("instance", scene.ids), ("semantic", scene.semantic_ids)):
        if name in results:
            results[name][:] = np.append(table, np.int32(-1))[hits.instance]
    if "normal" in results:
        results["normal"][:] = caster.normals(hits, -np.nan_to_num(directions))


def picture_from_cube(
    camera: Camera, render_face: Callable[[Camera], NDArray[np.uint8]], rgb: NDArray[np.uint8]
) -> None:
    """Fill ``rgb`` [H, W, 3] of a non-planar camera, where ``render_face`` renders a perspective camera."""
    import cv2

    size = int(min(2 * np.ceil(max(camera.fx, camera.fy)), _LARGEST_FACE_PX)) + 2 * _MARGIN_PX
    focal = size / 2 - _MARGIN_PX
    _, d = camera.rays()
    axis = np.abs(np.nan_to_num(d)).argmax(-1)
    side = 2 * axis + (np.take_along_axis(d, axis[..., None], -1)[..., 0] < 0)
    rgb[:] = 0
    for k in range(6):
        mask = (side == k) & np.isfinite(d).all(-1)
        if not mask.any():
            continue
        turn = _face(k)
        face = pinhole(size, size, hfov_deg=float(np.degrees(2 * np.arctan(size / 2 / focal))))
        pose = camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ turn
        picture = render_face(replace(face, pose=pose, hidden_layers=camera.hidden_layers, name=camera.name))
        local = np.where(mask[..., None], d @ turn, (0.0, 0.0, 1.0))
        x, y = ((local[..., a] / local[..., 2] * focal + size / 2 - 0.5).astype(np.float32) for a in (0, 1))
        rgb[mask] = cv2.remap(picture, x, y, cv2.INTER_LINEAR)[mask]


def _face(k: int) -> NDArray[np.float64]:
    """Return the rotation [3, 3] from face k to the camera; faces look along +x, -x, +y, -y, +z, -z."""
    turn = np.zeros((3, 3))
    axis, sign = k // 2, 1.0 - 2 * (k % 2)
    turn[axis, 2] = sign
    turn[(axis + 1) % 3, 0] = 1.0
    turn[:, 1] = np.cross(turn[:, 2], turn[:, 0])
    return turn
