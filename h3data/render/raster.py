"""The rasteriser: clusters of triangles to a buffer of 1/z and a visibility buffer. One thread per picture, no GIL.

One picture: (1) instances, then their clusters, against the view frustum; (2) the survivors sorted front to back by a
counting sort; (3) each against the coarse depth of 8x8-pixel tiles, kept lazily; (4) eight triangles at a time set up
in SIMD (`raster_simd.setup_triangles`); (5) three fillers: small boxes (one block of 8 pixels a row), medium ones (float32
spans), and everything large, thin or near (homogeneous edge functions in double, which need no clipping: there is no
near plane), all in `raster_fill`. A pixel's word is ``draw * 128 + triangle within the cluster``, -1 where nothing is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.render.raster_fill import camera_corners, fill_large, fill_medium, fill_small
from h3data.render.raster_simd import (
    INV_Z_MAX,
    NEAR_M,
    SETUP_ROWS,
    X0,
    X1,
    Y0,
    Y1,
    count_trailing_zeros,
    setup_triangles,
    tile_minimum,
)

TILE = 8
PACKET_BYTES = 9 * 8 * 4
SORT_BINS = 1024
FAR_PADDING = 1e30
"""1/z of the padding around the picture: nearer than everything, so it never counts as seen through."""
OCCLUSION_MARGIN = np.float32(1.00001)
"""Only what is hidden by more than rounding is skipped."""
SPAN_MARGIN_PX = 0.01

# Columns of `Target.draws`.
INSTANCE, CLUSTER, TILE_X0, TILE_X1, TILE_Y0, TILE_Y1 = range(6)


class Geometry(NamedTuple):
    """The triangles of all meshes, and where their clusters lie."""

    shared_packets: NDArray[np.float32]
    """Soup of the meshes that never change, shape [P, 9, 8]; shared by all renderers."""
    own_packets: NDArray[np.float32]
    """Soup of the deformable meshes, numbered after the shared ones, shape [Q, 9, 8]."""
    cluster_packets: NDArray[np.int32]
    """First packet and end (exclusive) of each cluster, shape [C, 2]."""
    center: NDArray[np.float64]
    """Boxes of the clusters: centre, shape [C, 3] [m]."""
    half: NDArray[np.float64]
    """And half size, shape [C, 3] [m]."""
    mesh_first: NDArray[np.int32]
    """First cluster of each mesh and, at the end, the number of clusters, shape [M + 1]."""
    mesh_center: NDArray[np.float64]
    """Boxes of the meshes: centre, shape [M, 3] [m]."""
    mesh_half: NDArray[np.float64]
    """And half size, shape [M, 3] [m]."""


class Placement(NamedTuple):
    """Where the instances are."""

    mesh: NDArray[np.int32]
    """Mesh of each instance, shape [I]."""
    matrix: NDArray[np.float64]
    """Mesh to world, shape [I, 3, 4]."""
    shown: NDArray[np.bool_]
    """Shape [I]."""


class View(NamedTuple):
    """A camera as the kernels read it."""

    axes: NDArray[np.float64]
    """Rotation, camera to world, shape [3, 3]."""
    eye: NDArray[np.float64]
    """Shape [3] [m]."""
    intrinsics: NDArray[np.float64]
    """``fx fy cx cy`` [px], shape [4]."""
    width: int
    height: int


class Target(NamedTuple):
    """Buffers of one picture size. Rows and columns are padded, so that blocks of 8 pixels may overrun."""

    inv_z: NDArray[np.float32]
    """1/z, 0 = nothing, shape [rows, stride] [1/m]."""
    words: NDArray[np.int32]
    """Visibility buffer, shape [rows, stride]."""
    tile_inv_z: NDArray[np.float32]
    """Lower bound of 1/z in each tile, shape [rows / 8, ceil(width / 8)]."""
    tile_stale: NDArray[np.uint8]
    """1 where something was drawn since that bound was taken."""
    draws: NDArray[np.int32]
    """The clusters of this picture (columns: INSTANCE, CLUSTER, TILE_...), shape [D, 6]."""
    near: NDArray[np.float32]
    """Nearest z of each, 0 = at the eye, shape [D] [m]."""
    camera_from_mesh: NDArray[np.float64]
    """Mesh to camera, per instance, shape [I, 3, 4]."""
    pixel_from_mesh: NDArray[np.float32]
    """The same, its first two rows times the focal lengths, shape [I, 3, 4]."""


def new_target(width: int, height: int, *, draws: int, instances: int) -> Target:
    """Buffers for pictures of ``width`` x ``height`` with at most ``draws`` clusters of ``instances`` instances."""
    rows, columns = -(-height // TILE) * TILE, -(-width // TILE) * TILE
    stride = columns + TILE
    return Target(
        np.zeros((rows, stride), np.float32),
        np.zeros((rows, stride), np.int32),
        np.zeros((rows // TILE, columns // TILE), np.float32),
        np.zeros((rows // TILE, columns // TILE), np.uint8),
        np.zeros((draws, 6), np.int32),
        np.zeros(draws, np.float32),
        np.zeros((instances, 3, 4)),
        np.zeros((instances, 3, 4), np.float32),
    )


@kernel(error_model="numpy", boundscheck=False)
def rasterise(geometry, placement, view, target):
    """Draw one picture into ``target``; returns the number of clusters in the frustum."""
    _clear(target, view.width, view.height)
    count = _collect(geometry, placement, view, target)
    order = _front_to_back(target.near, count)
    _draw(geometry, view, target, order)
    return count


@kernel()
def _clear(target, width, height):
    target.inv_z[:height, :width] = 0
    target.inv_z[:height, width:] = FAR_PADDING
    target.inv_z[height:] = FAR_PADDING
    target.words[:] = -1
    target.tile_inv_z[:] = 0
    target.tile_stale[:] = 0


# --- frustum --------------------------------------------------------------------------------------------------------
@njit(nogil=True, forceinline=True)
def _outside(planes, center, half, box):
    """Whether a box lies wholly behind one of the 5 planes [5, 4]. NaN counts as outside."""
    for k in range(5):
        distance = planes[k, 3]
        for a in range(3):
            distance += planes[k, a] * center[box, a] + abs(planes[k, a]) * half[box, a]
        if not distance >= 0:
            return True
    return False


@njit(nogil=True, forceinline=True)
def _pixel_span(middle, extent, near, far, focal, principal, size):
    """Pixel coordinates between which a camera-space interval at depths near..far appears, cut to the picture."""
    low, high = middle - extent, middle + extent
    low = low / (near if low < 0 else far) * focal + principal
    high = high / (near if high > 0 else far) * focal + principal
    return max(low - SPAN_MARGIN_PX, 0.0), min(high + SPAN_MARGIN_PX, size - 0.5)


@njit(nogil=True)
def _place(i, matrix, view, target, planes):
    """Write the instance's matrices to camera space and the frustum's planes in its mesh's frame."""
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


@njit(nogil=True)
def _collect(geometry, placement, view, target):
    """List the clusters inside the frustum with their tiles and nearest z; returns how many."""
    fx, fy, cx, cy = view.intrinsics
    width, height = float(view.width), float(view.height)
    draws, near, center, half = target.draws, target.near, geometry.center, geometry.half
    planes = np.empty((5, 4))
    box = np.empty((3, 2))  # camera-space middle and extent, per axis
    count = 0
    for i in range(len(placement.mesh)):
        if not placement.shown[i]:
            continue
        mesh = placement.mesh[i]
        _place(i, placement.matrix[i], view, target, planes)
        if _outside(planes, geometry.mesh_center, geometry.mesh_half, mesh):
            continue
        to_camera = target.camera_from_mesh[i]
        for cluster in range(geometry.mesh_first[mesh], geometry.mesh_first[mesh + 1]):
            if _outside(planes, center, half, cluster):
                continue
            for r in range(3):
                box[r, 0], box[r, 1] = to_camera[r, 3], 0.0
                for a in range(3):
                    box[r, 0] += to_camera[r, a] * center[cluster, a]
                    box[r, 1] += abs(to_camera[r, a]) * half[cluster, a]
            z0, z1 = box[2, 0] - box[2, 1], box[2, 0] + box[2, 1]
            left, right, top, bottom = 0.0, width - 0.5, 0.0, height - 0.5
            if z0 < NEAR_M:
                z0 = 0.0  # at the eye: it may cover anything and is never skipped
            else:
                left, right = _pixel_span(box[0, 0], box[0, 1], z0, z1, fx, cx, width)
                top, bottom = _pixel_span(box[1, 0], box[1, 1], z0, z1, fy, cy, height)
                if not (left <= right and top <= bottom):
                    continue
            draws[count, INSTANCE], draws[count, CLUSTER] = i, cluster
            draws[count, TILE_X0], draws[count, TILE_X1] = int(left) >> 3, int(right) >> 3
            draws[count, TILE_Y0], draws[count, TILE_Y1] = int(top) >> 3, int(bottom) >> 3
            near[count] = z0
            count += 1
    return count


@njit(nogil=True)
def _front_to_back(near, count):
    """Indices of the draws by nearest z (counting sort: stable, so the same picture every time)."""
    furthest = np.float32(1e-6)
    for k in range(count):
        furthest = max(furthest, near[k])
    scale = np.float32(SORT_BINS - 1) / furthest
    begin = np.zeros(SORT_BINS + 1, np.int32)
    for k in range(count):
        begin[int(near[k] * scale) + 1] += 1
    for b in range(SORT_BINS):
        begin[b + 1] += begin[b]
    order = np.empty(count, np.int32)
    for k in range(count):
        b = int(near[k] * scale)
        order[begin[b]] = k
        begin[b] += 1
    return order


# --- drawing --------------------------------------------------------------------------------------------------------
@njit(nogil=True)
def _hidden(tile_x0, tile_x1, tile_y0, tile_y1, inv_z, bounds, stale, inv_z_at, row_bytes):
    """Whether everything in these tiles is nearer than ``inv_z``; refreshes stale tiles on the way."""
    for ty in range(tile_y0, tile_y1 + 1):
        for tx in range(tile_x0, tile_x1 + 1):
            if bounds[ty, tx] >= inv_z:
                continue
            if not stale[ty, tx]:
                return False
            bounds[ty, tx] = tile_minimum(inv_z_at + np.uintp(ty * TILE * row_bytes + tx * TILE * 4), row_bytes)
            stale[ty, tx] = 0
            if bounds[ty, tx] < inv_z:
                return False
    return True


@njit(nogil=True)
def _draw(geometry, view, target, order):
    """Draw the clusters in this order."""
    stride = target.inv_z.shape[1]
    row_bytes = np.uintp(stride * 4)
    inv_z_at, words_at = np.uintp(target.inv_z.ctypes.data), np.uintp(target.words.ctypes.data)
    shared_at = np.uintp(geometry.shared_packets.ctypes.data)
    own_at = np.uintp(geometry.own_packets.ctypes.data)
    shared_count = len(geometry.shared_packets)
    matrices_at = np.uintp(target.pixel_from_mesh.ctypes.data)
    screen = np.array(
        [view.intrinsics[2], view.intrinsics[3], float(view.width), float(view.height)],
    ).astype(np.float32)
    table = np.empty((SETUP_ROWS, 8), np.float32)
    boxes = table.view(np.int32)
    screen_at, table_at = np.uintp(screen.ctypes.data), np.uintp(table.ctypes.data)
    corners = np.empty(9)
    bounds, stale = target.tile_inv_z, target.tile_stale
    for draw in order:
        instance, cluster = target.draws[draw, INSTANCE], target.draws[draw, CLUSTER]
        tile_x0, tile_x1 = target.draws[draw, TILE_X0], target.draws[draw, TILE_X1]
        tile_y0, tile_y1 = target.draws[draw, TILE_Y0], target.draws[draw, TILE_Y1]
        near = target.near[draw]
        if near > 0:
            nearest = OCCLUSION_MARGIN / near
            if _hidden(tile_x0, tile_x1, tile_y0, tile_y1, nearest, bounds, stale, inv_z_at, row_bytes):
                continue
        first, end = geometry.cluster_packets[cluster]
        packet_at = shared_at + np.uintp(first * PACKET_BYTES)
        if first >= shared_count:
            packet_at = own_at + np.uintp((first - shared_count) * PACKET_BYTES)
        matrix_at = matrices_at + np.uintp(instance * 48)
        word = np.int32(draw * 128)
        for packet in range(end - first):
            masks = setup_triangles(packet_at, matrix_at, screen_at, table_at)
            small, large, medium = masks & 255, (masks >> 8) & 255, masks >> 16
            while small:
                lane = count_trailing_zeros(small)
                small &= small - 1
                fill_small(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while medium:
                lane = count_trailing_zeros(medium)
                medium &= medium - 1
                if not _lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    fill_medium(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while large:
                lane = count_trailing_zeros(large)
                large &= large - 1
                soup = geometry.shared_packets
                p = first + packet
                if first >= shared_count:
                    soup, p = geometry.own_packets, p - shared_count
                is_near = camera_corners(soup[p, :, lane], target.camera_from_mesh[instance], corners)
                if is_near or not _lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    fill_large(corners, view, is_near, boxes[:, lane], inv_z_at, words_at, stride, word + lane)
            packet_at += np.uintp(PACKET_BYTES)
            word += np.int32(8)
        for ty in range(tile_y0, tile_y1 + 1):
            for tx in range(tile_x0, tile_x1 + 1):
                stale[ty, tx] = 1


@njit(nogil=True, forceinline=True)
def _lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
    nearest = table[INV_Z_MAX, lane] * OCCLUSION_MARGIN
    x0, x1, y0, y1 = boxes[X0, lane] >> 3, boxes[X1, lane] >> 3, boxes[Y0, lane] >> 3, boxes[Y1, lane] >> 3
    return _hidden(x0, x1, y0, y1, nearest, bounds, stale, inv_z_at, row_bytes)
