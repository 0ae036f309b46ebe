"""The rasteriser: from clusters of triangles to a nearness buffer and a visibility buffer.

Each image is rendered by one thread without the GIL.

Stages of one image:

1. Cull instances, then their clusters, against the view frustum.
2. Sort the remaining clusters front to back (counting sort).
3. Cull each against the coarse depth of 8x8-pixel tiles, which is updated lazily.
4. Set up eight triangles at a time in SIMD (`raster_simd.setup_triangles`).
5. Fill them (`raster_fill`): small boxes by one block of 8 pixels per row; medium ones by float32 spans; large, thin or
   near ones by homogeneous edge functions in double. These need no clipping, so there is no near plane unless the
   camera asks for one.
6. Last, draw the triangles with holes (`raster_cutouts`).

A pixel's word in the visibility buffer is ``draw * 128 + triangle within the cluster``, or -1 in the background; a draw
is a cluster of an instance, with the same number in every image. Nearness is linear on the screen and increases towards
the camera: 1/z, or ``reach - z`` for orthographic cameras.

For a static camera, only the tiles in which a changed instance is or was visible are rendered again (`rasterise`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data.render.raster.raster_cutouts import draw_cutouts
from h3data.render.raster.raster_draw import (
    CLUSTER,
    INSTANCE,
    TILE,
    TILE_X0,
    TILE_X1,
    TILE_Y0,
    TILE_Y1,
    draw_clusters,
    draw_cut,
    has_near_plane,
    nearness_of,
)
from h3data.render.raster.raster_simd import NEAR_M

FAR_PADDING = 1e30
"""Nearness of the padding around the image, larger than any other, so that padding never fails an occlusion test."""


class Geometry(NamedTuple):
    """Triangles of all meshes, and bounding boxes of meshes and clusters."""

    shared_packets: NDArray[np.float32]
    """Packets of the meshes that never change, shape [P, 9, 8]; shared by all renderers."""
    own_packets: NDArray[np.float32]
    """Packets of the deformable meshes, numbered after the shared ones, shape [Q, 9, 8]."""
    cluster_packets: NDArray[np.int32]
    """First packet and end (exclusive) of each cluster, shape [C, 2]."""
    center: NDArray[np.float64]
    """Centres of the clusters' boxes, shape [C, 3] [m]."""
    half: NDArray[np.float64]
    """Half sizes of the clusters' boxes, shape [C, 3] [m]."""
    mesh_first: NDArray[np.int32]
    """First cluster of each mesh, followed by the number of clusters, shape [M + 1]."""
    mesh_center: NDArray[np.float64]
    """Centres of the meshes' boxes, shape [M, 3] [m]."""
    mesh_half: NDArray[np.float64]
    """Half sizes of the meshes' boxes, shape [M, 3] [m]."""


class Placement(NamedTuple):
    """Transforms and visibility of the instances."""

    mesh: NDArray[np.int32]
    """Mesh of each instance, shape [I]."""
    matrix: NDArray[np.float64]
    """Matrix from mesh to world of each instance, shape [I, 3, 4]."""
    shown: NDArray[np.bool_]
    """True if the instance is drawn, shape [I]."""


class View(NamedTuple):
    """Camera in the form that kernels read."""

    axes: NDArray[np.float64]
    """Rotation, camera to world, shape [3, 3]."""
    eye: NDArray[np.float64]
    """Position of the eye, shape [3] [m]."""
    intrinsics: NDArray[np.float64]
    """``fx fy cx cy`` [px; orthographic: fx and fy in px/m], shape [4]."""
    width: int
    height: int
    parallel: bool = False
    """True if the camera is orthographic."""
    near: float = 0.0
    """Depth z below which surfaces are cut away [m]."""
    far: float = float("inf")
    """Depth z above which surfaces count as background [m]."""
    reach: float = 0.0
    """Depth z beyond all instances, for orthographic cameras [m] (`reach_of`)."""


class Target(NamedTuple):
    """Buffers for one image size, with padded rows and columns so that blocks of 8 pixels may overrun."""

    inv_z: NDArray[np.float32]
    """Nearness of each pixel, 0 = background, shape [rows, stride] [1/m, orthographic: m]."""
    words: NDArray[np.int32]
    """Visibility buffer with the word of each pixel, shape [rows, stride]."""
    tile_inv_z: NDArray[np.float32]
    """Lower bound of nearness in each tile, shape [rows / 8, ceil(width / 8)]."""
    tile_stale: NDArray[np.uint8]
    """Flag of each tile: 1 if something was drawn since its bound was computed."""
    tile_drawn: NDArray[np.uint8]
    """Flag of each tile: 1 if the tile was rendered in the last image, 0 if it was copied from the image before."""
    draws: NDArray[np.int32]
    """Clusters of all instances, ordered by instance (columns: INSTANCE, CLUSTER, TILE_...), shape [D, 6]."""
    near: NDArray[np.float32]
    """Smallest z of each draw, 0 = at the eye, -1 = not in the image, shape [D] [m]."""
    order: NDArray[np.int32]
    """Indices of the draws in the order of rendering, followed by -1, shape [D]."""
    camera_from_mesh: NDArray[np.float64]
    """Matrix from mesh to camera of each instance, shape [I, 3, 4]."""
    pixel_from_mesh: NDArray[np.float32]
    """The matrices `camera_from_mesh` with the first two rows times the focal lengths; for orthographic cameras the last row
    maps to nearness. Shape [I, 3, 4]."""


def new_target(width: int, height: int, *, draws: int, instances: int) -> Target:
    """Allocate buffers for images of ``width`` x ``height`` with at most ``draws`` clusters of ``instances`` instances."""
    rows, columns = -(-height // TILE) * TILE, -(-width // TILE) * TILE
    stride = columns + TILE
    return Target(
        np.zeros((rows, stride), np.float32),
        np.zeros((rows, stride), np.int32),
        np.zeros((rows // TILE, columns // TILE), np.float32),
        np.zeros((rows // TILE, columns // TILE), np.uint8),
        np.zeros((rows // TILE, columns // TILE), np.uint8),
        np.zeros((draws, 6), np.int32),
        np.full(draws, -1, np.float32),
        np.full(draws, -1, np.int32),
        np.zeros((instances, 3, 4)),
        np.zeros((instances, 3, 4), np.float32),
    )


def reach_of(geometry: Geometry, placement: Placement, view: View) -> float:
    """Return a depth z [m] slightly beyond all visible instances or ``view.far``, whichever is nearer."""
    forward = view.axes[:, 2]
    rows = np.einsum("r,irc->ic", forward, placement.matrix)
    with np.errstate(all="ignore"):
        center, half = geometry.mesh_center[placement.mesh], geometry.mesh_half[placement.mesh]
        z = (rows[:, :3] * center + np.abs(rows[:, :3]) * half).sum(1) + rows[:, 3] - forward @ view.eye
    farthest = z[placement.shown & np.isfinite(z)].max(initial=0.0)
    # slightly beyond, because nearness 0 is the background and nothing that is drawn may have it
    return float(min(farthest, view.far)) * 1.00001 + 0.001


@kernel(error_model="numpy", boundscheck=False)
def rasterise(geometry, cutouts, placement, view, target, changed):
    """Render one image into ``target``; return the number of clusters in the frustum.

    ``changed`` [I] marks the instances that differ from the last image in ``target``, which has the same view. Only the
    tiles in which these instances are or were visible are rendered again. If its length is 0, all tiles are rendered.

    The result is bit-identical to a full rendering. In unchanged tiles, no instance that is rendered again is nearer
    than the present surfaces, and of two equally near surfaces the first one wins as before. Only another order of the
    unchanged instances could change this, and in that case all tiles are rendered.
    """
    again = len(changed) > 0
    if again:
        target.tile_drawn[:] = 0
        _mark_tiles(geometry, placement, target, changed)
    listed = _collect(geometry, placement, view, target)
    order = _front_to_back(target.near, listed)
    if again and _same_order(order, target, changed):
        _mark_tiles(geometry, placement, target, changed)
        _clear_tiles(target, view.width, view.height)
    else:
        target.tile_drawn[:] = 1
        _clear(target, view.width, view.height)
    target.order[: len(order)] = order
    target.order[len(order) :] = -1
    cut_first = cutouts.first
    draw_clusters(geometry, cut_first, view, target, order)
    if has_near_plane(view):
        draw_cut(geometry, cut_first, view, target, order)
    if len(cutouts.uv):
        draw_cutouts(geometry, cutouts, view, target, order)
    if view.far < np.inf:
        _cut_far(view, target)
    return len(listed)


@kernel()
def _clear(target, width, height):
    target.inv_z[:height, :width] = 0
    # the padding counts as drawn, or no tile on the border would ever hide anything
    target.inv_z[:height, width:] = FAR_PADDING
    target.inv_z[height:] = FAR_PADDING
    target.words[:] = -1
    target.tile_inv_z[:] = 0
    target.tile_stale[:] = 0


@kernel_part()
def _clear_tiles(target, width, height):
    """Clear the tiles that are drawn, as `_clear` does; the others hide everything."""
    for ty in range(target.tile_drawn.shape[0]):
        for tx in range(target.tile_drawn.shape[1]):
            target.tile_stale[ty, tx] = 0
            # a tile that is kept is nearer than everything, so every cluster in it is culled before any work
            target.tile_inv_z[ty, tx] = FAR_PADDING
            if target.tile_drawn[ty, tx]:
                target.tile_inv_z[ty, tx] = 0
                for y in range(ty * TILE, min((ty + 1) * TILE, height)):
                    for x in range(tx * TILE, min((tx + 1) * TILE, width)):
                        target.inv_z[y, x] = 0
                        target.words[y, x] = -1


@kernel_part()
def _mark_tiles(geometry, placement, target, changed):
    """Mark the tiles of the draws of changed instances."""
    draws, drawn, first = target.draws, target.tile_drawn, 0
    for i in range(len(changed)):
        mesh = placement.mesh[i]
        end = first + geometry.mesh_first[mesh + 1] - geometry.mesh_first[mesh]
        if changed[i]:
            for draw in range(first, end):
                # a draw that was outside the image marked no tile: its columns are those of an earlier
                # image
                if target.near[draw] >= 0:
                    for ty in range(draws[draw, TILE_Y0], draws[draw, TILE_Y1] + 1):
                        for tx in range(draws[draw, TILE_X0], draws[draw, TILE_X1] + 1):
                            drawn[ty, tx] = 1
        first = end


@kernel_part()
def _cut_far(view, target):
    limit = nearness_of(view.far, view)
    for y in range(view.height):
        for x in range(view.width):
            if target.inv_z[y, x] < limit:
                target.inv_z[y, x] = 0
                target.words[y, x] = -1


# --- frustum --------------------------------------------------------------------------------------------------------
@kernel_part(forceinline=True)
def _outside(planes, center, half, box):
    """Return whether a box lies entirely behind one of the 5 planes [5, 4]; NaN counts as outside."""
    for k in range(5):
        distance = planes[k, 3]
        for a in range(3):
            distance += planes[k, a] * center[box, a] + abs(planes[k, a]) * half[box, a]
        # written so that NaN, of a matrix without sense, is culled
        if not distance >= 0:
            return True
    return False


@kernel_part(forceinline=True)
def _pixel_span(middle, extent, near, far, focal, principal, size):
    """Return the range of pixels covered by a camera-space interval at depths near..far, clipped to the image."""
    low, high = middle - extent, middle + extent
    # what is left of the middle reaches farthest when it is near, what is right of it when it is far
    low = low / (near if low < 0 else far) * focal + principal
    high = high / (near if high > 0 else far) * focal + principal
    span_margin_px = 0.01
    return max(low - span_margin_px, 0.0), min(high + span_margin_px, size - 0.5)


@kernel_part()
def _place(i, matrix, view, target, planes):
    """Fill an instance's matrices to camera space and to pixels, and the frustum planes in its mesh's frame."""
    fx, fy, cx, cy = view.intrinsics
    to_camera, to_pixel = target.camera_from_mesh[i], target.pixel_from_mesh[i]
    for c in range(4):
        for r in range(3):
            total = 0.0
            for a in range(3):
                total += view.axes[a, r] * (matrix[a, c] - (view.eye[a] if c == 3 else 0.0))
            to_camera[r, c] = total
        x, y, z = to_camera[0, c], to_camera[1, c], to_camera[2, c]
        to_pixel[0, c], to_pixel[1, c], to_pixel[2, c] = fx * x, fy * y, z
        planes[0, c] = z
        planes[1, c] = fx * x + cx * z
        planes[2, c] = (view.width - cx) * z - fx * x
        planes[3, c] = fy * y + cy * z
        planes[4, c] = (view.height - cy) * z - fy * y
    planes[0, 3] -= view.near


@kernel_part()
def _place_parallel(i, view, target, planes):
    """Adapt the result of `_place` to an orthographic camera, whose pixels do not depend on z.

    Kept apart from `_place`, so that its loop stays four columns in one vector.
    """
    fx, fy, cx, cy = view.intrinsics
    to_camera, to_pixel = target.camera_from_mesh[i], target.pixel_from_mesh[i]
    for c in range(4):
        x, y, one = fx * to_camera[0, c], fy * to_camera[1, c], 1.0 if c == 3 else 0.0
        to_pixel[2, c] = view.reach * one - to_camera[2, c]
        planes[1, c], planes[2, c] = x + cx * one, (view.width - cx) * one - x
        planes[3, c], planes[4, c] = y + cy * one, (view.height - cy) * one - y


@kernel_part()
def _collect(geometry, placement, view, target):
    """Fill the draws inside the frustum, their tiles and smallest z; return their numbers."""
    fx, fy, cx, cy = view.intrinsics
    width, height = float(view.width), float(view.height)
    draws, near, center, half = target.draws, target.near, geometry.center, geometry.half
    planes = np.empty((5, 4))
    box = np.empty((3, 2))  # camera-space centre and half extent, per axis
    # the numbers of draws are fixed by instance and cluster, so that pixels can be compared between images
    listed = np.empty(len(near), np.int32)
    near[:] = -1
    count = following = 0
    for i in range(len(placement.mesh)):
        mesh = placement.mesh[i]
        first_cluster, end_cluster = geometry.mesh_first[mesh], geometry.mesh_first[mesh + 1]
        first_draw, following = following, following + end_cluster - first_cluster
        if not placement.shown[i]:
            continue
        _place(i, placement.matrix[i], view, target, planes)
        if view.parallel:
            _place_parallel(i, view, target, planes)
        # the whole mesh first: in a home most of them are in other rooms
        if _outside(planes, geometry.mesh_center, geometry.mesh_half, mesh):
            continue
        to_camera = target.camera_from_mesh[i]
        for cluster in range(first_cluster, end_cluster):
            if _outside(planes, center, half, cluster):
                continue
            for r in range(3):
                box[r, 0], box[r, 1] = to_camera[r, 3], 0.0
                for a in range(3):
                    box[r, 0] += to_camera[r, a] * center[cluster, a]
                    # the box around a turned box: exact enough, and nothing needs its eight corners
                    box[r, 1] += abs(to_camera[r, a]) * half[cluster, a]
            z0, z1 = max(box[2, 0] - box[2, 1], view.near), box[2, 0] + box[2, 1]
            left, right, top, bottom = 0.0, width - 0.5, 0.0, height - 0.5
            if z0 < NEAR_M and not view.parallel:
                z0 = 0.0  # at the eye: may cover any pixel, and is never culled
            else:
                w0, w1 = (1.0, 1.0) if view.parallel else (z0, z1)
                left, right = _pixel_span(box[0, 0], box[0, 1], w0, w1, fx, cx, width)
                top, bottom = _pixel_span(box[1, 0], box[1, 1], w0, w1, fy, cy, height)
                if not (left <= right and top <= bottom):
                    continue
            draw = first_draw + cluster - first_cluster
            draws[draw, INSTANCE], draws[draw, CLUSTER] = i, cluster
            draws[draw, TILE_X0], draws[draw, TILE_X1] = int(left) >> 3, int(right) >> 3
            draws[draw, TILE_Y0], draws[draw, TILE_Y1] = int(top) >> 3, int(bottom) >> 3
            near[draw] = z0
            listed[count] = draw
            count += 1
    return listed[:count]


@kernel_part()
def _front_to_back(near, listed):
    """Return the listed draws by smallest z (counting sort, which is stable, so that images are reproducible)."""
    furthest = np.float32(1e-6)
    for draw in listed:
        furthest = max(furthest, near[draw])
    sort_bins = 1024
    # bins are enough: the order is for culling only, and pixels do not depend on it except where surfaces coincide
    scale = np.float32(sort_bins - 1) / furthest
    begin = np.zeros(sort_bins + 1, np.int32)
    for draw in listed:
        begin[int(near[draw] * scale) + 1] += 1
    for b in range(sort_bins):
        begin[b + 1] += begin[b]
    order = np.empty(len(listed), np.int32)
    for draw in listed:
        b = int(near[draw] * scale)
        order[begin[b]] = draw
        begin[b] += 1
    return order


@kernel_part()
def _same_order(order, target, changed):
    """Return whether all instances other than the changed ones are drawn in the same order as before."""
    k, count = 0, len(target.order)
    for draw in order:
        if changed[target.draws[draw, INSTANCE]]:
            continue
        while k < count and target.order[k] >= 0 and changed[target.draws[target.order[k], INSTANCE]]:
            k += 1
        # equally near surfaces go to the first one drawn, so another order could change pixels in tiles that are
        # kept
        if k == count or target.order[k] != draw:
            return False
        k += 1
    return True
