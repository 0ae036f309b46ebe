"""Exact optical flow, computed from the poses at two times."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.colors import MISS_COLOR
from h3data.render.outputs import Poses
from h3data.render.scene import RenderScene


def optical_flow(
    scene: RenderScene,
    picture: Mapping[str, NDArray],
    camera: Camera,
    before: Poses,
    camera_after: Camera,
    after: Poses,
) -> NDArray[np.float32]:
    """Compute the displacement (right, down) of each pixel's surface point until the next image, float32 [H, W, 2] [px].

    Points move with their instance, or on deformable meshes with their triangle. Points that are hidden in the next
    image have flow, too. The background counts as infinitely far away. NaN marks points that are no longer in front of
    the camera or no longer exist.

    Args:
        scene: The rendered scene.
        picture: Result of `Renderer.render` for ``camera`` with the outputs ``depth``, ``instance`` and ``triangle``.
        camera: Camera of ``picture``.
        before: `Renderer.poses` at the time of ``picture``.
        camera_after: Camera of the next image.
        after: `Renderer.poses` at the time of the next image.

    Raises:
        InputError: an output is missing.
    """
    missing = [name for name in ("depth", "instance", "triangle") if name not in picture]
    if missing:
        raise InputError(
            f"Optical flow needs the outputs depth, instance and triangle; missing: {', '.join(missing)}.",
            code="H3-RENDER-012",
        )
    depth, ids, triangle = (np.asarray(picture[name]) for name in ("depth", "instance", "triangle"))
    start, directions = camera.rays()
    turn, eye = camera.pose[:3, :3], camera.pose[:3, 3]
    points = (start + directions * depth[..., None].astype(np.float64)) @ turn.T + eye
    index = _index_of(np.where(before.visible, scene.ids, -2), ids)
    hit = index >= 0
    moved = np.full_like(points, np.nan)
    for k in np.unique(index[hit]):
        at = index == k
        moved[at] = _moved(scene, int(k), points[at], triangle[at], before, after)
    moved_pixels = camera_after.to_pixels(camera_after.to_camera(moved.reshape(-1, 3)))
    far = (directions @ turn.T).reshape(-1, 3) @ camera_after.pose[:3, :3]
    if camera.projection == "orthographic":  # parallel rays: the background has no defined position
        far_pixels = np.full((len(far), 2), np.nan)
    else:
        far_pixels = camera_after.to_pixels(far)
    pixels = np.where(hit.reshape(-1, 1), moved_pixels, far_pixels).reshape(*ids.shape, 2)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    flow = pixels - np.stack([u, v], -1)
    if camera_after.projection == "equirectangular":  # the shorter way around
        turn_px = 2 * np.pi * camera_after.fx
        flow[..., 0] = (flow[..., 0] + turn_px / 2) % turn_px - turn_px / 2
    return flow.astype(np.float32)


def _index_of(ids_of_instances: NDArray[np.int32], ids: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return the index of the instance with each id in an image; -1 in the background."""
    order = np.argsort(ids_of_instances, kind="stable")
    place = np.searchsorted(ids_of_instances, ids, sorter=order) if len(order) else np.zeros(ids.shape, np.intp)
    return np.where(ids >= 0, order[np.minimum(place, len(order) - 1)] if len(order) else -1, -1)


def _moved(
    scene: RenderScene, instance: int, points: NDArray, triangle: NDArray, before: Poses, after: Poses
) -> NDArray[np.float64]:
    """Return the world points [N, 3] on an instance after its motion."""
    slot = int(scene.instance_mesh[instance])
    old, new = before.matrix[instance], after.matrix[instance]
    if slot not in scene.deformable:
        local = (points - old[:, 3]) @ np.linalg.pinv(old[:, :3]).T
        return local @ new[:, :3].T + new[:, 3]
    mesh = scene.meshes[slot]
    corners = mesh.faces[triangle]
    was, now = (poses.vertices.get(slot, mesh.vertices).astype(np.float64) for poses in (before, after))
    was, now = was @ old[:, :3].T + old[:, 3], now @ new[:, :3].T + new[:, 3]
    a, b, c = (was[corners[:, k]] for k in range(3))
    p, q, r = b - a, c - a, points - a
    pp, pq, qq, rp, rq = ((x * y).sum(1) for x, y in ((p, p), (p, q), (q, q), (r, p), (r, q)))
    area = np.maximum(pp * qq - pq * pq, 1e-30)
    second, third = ((qq * rp - pq * rq) / area)[:, None], ((pp * rq - pq * rp) / area)[:, None]
    return now[corners[:, 0]] * (1 - second - third) + now[corners[:, 1]] * second + now[corners[:, 2]] * third


def flow_to_rgb(flow: ArrayLike, *, longest_px: float | None = None) -> NDArray[np.uint8]:
    """Convert flow [H, W, 2] [px] to RGB [H, W, 3]; hue is direction (red to the right), white no motion, dark NaN.

    Colours are saturated at ``longest_px``, by default the 99th percentile of the lengths of flow vectors.
    """
    import cv2

    f = np.asarray(flow, np.float32)
    valid = np.asarray(np.isfinite(f).all(-1))
    f = np.where(valid[..., None], f, 0)
    length = np.linalg.norm(f, axis=-1)
    longest = longest_px or float(max(np.percentile(length[valid], 99) if valid.any() else 0, 1e-3))
    hue = np.degrees(np.arctan2(f[..., 1], f[..., 0])) % 360
    hsv = np.stack([hue, np.minimum(length / longest, 1), np.ones_like(hue)], -1).astype(np.float32)
    rgb = np.rint(255 * np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))).astype(np.uint8)
    rgb[~valid] = MISS_COLOR
    return rgb
