"""Optical flow from poses, and where things are in a picture: boxes and masks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.pictures import Poses
from h3data.render.scene import RenderScene


def optical_flow(
    scene: RenderScene,
    picture: Mapping[str, NDArray],
    camera: Camera,
    before: Poses,
    camera_after: Camera,
    after: Poses,
) -> NDArray[np.float32]:
    """Where each pixel's point goes until the next picture: right and down, float32 [H, W, 2] [px].

    ``picture`` is what `Renderer.render` gave for ``camera`` with the outputs ``depth``, ``instance`` and ``triangle``;
    ``before`` and ``after`` come from `Renderer.poses`. Points move with their instance, on deformable meshes with their
    triangle; what is hidden afterwards has flow, too. The background lies infinitely far away. NaN: no longer in front of
    the camera, or not there any more.

    Raises:
        InputError: an output is missing.
    """
    missing = [name for name in ("depth", "instance", "triangle") if name not in picture]
    if missing:
        raise InputError(f"Optical flow needs the outputs depth, instance and triangle; missing: {', '.join(missing)}.")
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
    if camera.projection == "orthographic":  # an infinitely far point has no place of its own there
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
    """Instances by their ids in pictures; -1 where nothing is."""
    order = np.argsort(ids_of_instances, kind="stable")
    place = np.searchsorted(ids_of_instances, ids, sorter=order) if len(order) else np.zeros(ids.shape, np.intp)
    return np.where(ids >= 0, order[np.minimum(place, len(order) - 1)] if len(order) else -1, -1)


def _moved(
    scene: RenderScene, instance: int, points: NDArray, triangle: NDArray, before: Poses, after: Poses
) -> NDArray[np.float64]:
    """World points [N, 3] of an instance, after its motion."""
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
    """Flow [H, W, 2] [px] as colours [H, W, 3]: hue is the direction (red: to the right), white none, NaN nearly black.

    ``longest_px`` has full colour; by default the 99th percentile.
    """
    import cv2

    f = np.asarray(flow, np.float32)
    known = np.asarray(np.isfinite(f).all(-1))
    f = np.where(known[..., None], f, 0)
    length = np.linalg.norm(f, axis=-1)
    most = longest_px or float(max(np.percentile(length[known], 99) if known.any() else 0, 1e-3))
    hue = np.degrees(np.arctan2(f[..., 1], f[..., 0])) % 360
    hsv = np.stack([hue, np.minimum(length / most, 1), np.ones_like(hue)], -1).astype(np.float32)
    rgb = np.rint(255 * np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))).astype(np.uint8)
    rgb[~known] = (18, 18, 22)
    return rgb


# --- boxes --------------------------------------------------------------------------------------------------------------
class Boxes(NamedTuple):
    """What of each id is visible in a picture, in the order of ids."""

    ids: NDArray[np.int32]
    """Shape [B]."""
    boxes: NDArray[np.int32]
    """First column, first row, end column, end row (exclusive) [px], shape [B, 4]."""
    pixels: NDArray[np.int64]
    """How many it covers, shape [B]."""


def visible_boxes(ids: ArrayLike, *, groups: ArrayLike | None = None) -> Boxes:
    """Boxes around the visible pixels of each id in a picture [H, W] of instances or semantic ids.

    ``groups`` maps an id (0, 1, ...) to that of the body which it belongs to, e.g. the links of a robot to the robot; -1
    leaves it out.
    """
    i = _grouped(ids, groups)
    found, inverse = np.unique(i, return_inverse=True)
    rows, columns = np.indices(i.shape).reshape(2, -1)
    inverse = inverse.reshape(-1)
    low, high = np.full((len(found), 2), 2**31 - 1), np.full((len(found), 2), -1)
    for axis, values in enumerate((columns, rows)):
        np.minimum.at(low[:, axis], inverse, values)
        np.maximum.at(high[:, axis], inverse, values)
    keep = found >= 0
    boxes = np.concatenate([low, high + 1], axis=1)[keep].astype(np.int32)
    return Boxes(found[keep].astype(np.int32), boxes, np.bincount(inverse, minlength=len(found))[keep])


def visible_masks(ids: ArrayLike, wanted: ArrayLike, *, groups: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Where each of the ``wanted`` ids [B] is visible, shape [B, H, W]; ``groups`` as in `visible_boxes`."""
    return _grouped(ids, groups)[None] == np.asarray(wanted).reshape(-1, 1, 1)


def _grouped(ids: ArrayLike, groups: ArrayLike | None) -> NDArray[np.integer]:
    i = np.asarray(ids)
    if i.ndim != 2 or i.dtype.kind not in "iu":
        raise InputError(f"Expected a picture of integer ids [H, W], got {i.dtype} {list(i.shape)}.")
    if groups is None:
        return i
    table = np.append(np.asarray(groups, np.int64), -1)
    if i.max(initial=-1) >= len(table) - 1:
        raise InputError(f"The groups cover the ids 0 to {len(table) - 2}; the picture holds {i.max()}.")
    return table[np.maximum(i, -1)]
