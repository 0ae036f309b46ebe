"""The rasteriser: clusters of triangles to a buffer of 1/z and a visibility buffer. One thread per picture, no GIL.

One picture: (1) instances, then their clusters, against the view frustum; (2) the survivors sorted front to back by a
counting sort; (3) each against the coarse depth of 8x8-pixel tiles, kept lazily; (4) eight triangles at a time set up
in SIMD (`raster_simd.setup_triangles`); (5) three fillers: small boxes (one block of 8 pixels a row), medium ones (float32
spans), and everything large, thin or near (homogeneous edge functions in double, which need no clipping: there is no
near plane). A pixel's word is ``draw * 128 + triangle within the cluster``, -1 where nothing is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from h3data.kernels import kernel
from h3data.render.raster_simd import (
    E0,
    E0_DX,
    E0_DY,
    E1,
    E1_DX,
    E1_DY,
    E2,
    E2_DX,
    E2_DY,
    INV_Z,
    INV_Z_DX,
    INV_Z_DY,
    INV_Z_MAX,
    NEAR_M,
    SETUP_ROWS,
    X0,
    X1,
    Y0,
    Y1,
    blend_block,
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
                _fill_small(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while medium:
                lane = count_trailing_zeros(medium)
                medium &= medium - 1
                if not _lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    _fill_medium(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while large:
                lane = count_trailing_zeros(large)
                large &= large - 1
                soup = geometry.shared_packets
                p = first + packet
                if first >= shared_count:
                    soup, p = geometry.own_packets, p - shared_count
                is_near = _camera_corners(soup[p, :, lane], target.camera_from_mesh[instance], corners)
                if is_near or not _lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    _fill_large(corners, view, is_near, boxes[:, lane], inv_z_at, words_at, stride, word + lane)
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


@njit(nogil=True, forceinline=True)
def _fill_small(table, boxes, lane, inv_z_at, words_at, stride, word):
    """At most 8 pixels wide: one block a row."""
    e0, e1, e2, inv_z = table[E0, lane], table[E1, lane], table[E2, lane], table[INV_Z, lane]
    e0_dx, e1_dx, e2_dx, inv_z_dx = table[E0_DX, lane], table[E1_DX, lane], table[E2_DX, lane], table[INV_Z_DX, lane]
    y0, y1 = boxes[Y0, lane], boxes[Y1, lane]
    offset = np.uintp((np.int64(y0) * stride + boxes[X0, lane]) * 4)
    for _ in range(y0, y1 + 1):
        blend_block(
            inv_z_at + offset, words_at + offset, e0, e1, e2, inv_z, e0_dx, e1_dx, e2_dx, inv_z_dx, np.int32(word)
        )
        e0 += table[E0_DY, lane]
        e1 += table[E1_DY, lane]
        e2 += table[E2_DY, lane]
        inv_z += table[INV_Z_DY, lane]
        offset += np.uintp(stride * 4)


@njit(nogil=True, forceinline=True, error_model="numpy")
def _cut(low, high, edge, step, minus_inverse):
    """Cut the span low..high to where ``edge + step * x >= 0``. A zero step gives -inf or +inf (never NaN > or <)."""
    crossing = edge * minus_inverse
    if step >= 0:
        if crossing > low:
            low = crossing
    elif crossing < high:
        high = crossing
    return low, high


@njit(nogil=True, forceinline=True, error_model="numpy")
def _fill_medium(table, boxes, lane, inv_z_at, words_at, stride, word):
    """Up to 64 pixels: the row's span in float32, then blocks over it (which test exactly)."""
    e0, e1, e2, inv_z = table[E0, lane], table[E1, lane], table[E2, lane], table[INV_Z, lane]
    e0_dx, e1_dx, e2_dx, inv_z_dx = table[E0_DX, lane], table[E1_DX, lane], table[E2_DX, lane], table[INV_Z_DX, lane]
    minus_one, zero = np.float32(-1), np.float32(0)
    inverse0, inverse1, inverse2 = minus_one / e0_dx, minus_one / e1_dx, minus_one / e2_dx
    y0, y1 = boxes[Y0, lane], boxes[Y1, lane]
    last = np.float32(boxes[X1, lane] - boxes[X0, lane])
    row = np.uintp((np.int64(y0) * stride + boxes[X0, lane]) * 4)
    for _ in range(y0, y1 + 1):
        low, high = _cut(zero, last, e0, e0_dx, inverse0)
        low, high = _cut(low, high, e1, e1_dx, inverse1)
        low, high = _cut(low, high, e2, e2_dx, inverse2)
        if high >= 0 and high >= low + minus_one:
            x, end = np.int32(low), np.int32(high)
            while x <= end:
                s = np.float32(x)
                offset = row + np.uintp(np.int64(x) * 4)
                blend_block(
                    inv_z_at + offset,
                    words_at + offset,
                    e0 + e0_dx * s,
                    e1 + e1_dx * s,
                    e2 + e2_dx * s,
                    inv_z + inv_z_dx * s,
                    e0_dx,
                    e1_dx,
                    e2_dx,
                    inv_z_dx,
                    np.int32(word),
                )
                x += np.int32(8)
        e0 += table[E0_DY, lane]
        e1 += table[E1_DY, lane]
        e2 += table[E2_DY, lane]
        inv_z += table[INV_Z_DY, lane]
        row += np.uintp(stride * 4)


@njit(nogil=True, forceinline=True)
def _camera_corners(soup, to_camera, corners):
    """Write the triangle's corners in camera space [9]; returns whether it comes near the eye's plane."""
    near = False
    for v in range(3):
        for r in range(3):
            corners[3 * v + r] = (
                to_camera[r, 0] * soup[3 * v]
                + to_camera[r, 1] * soup[3 * v + 1]
                + to_camera[r, 2] * soup[3 * v + 2]
                + to_camera[r, 3]
            )
        near |= corners[3 * v + 2] < NEAR_M * 1.001
    return near


@njit(nogil=True)
def _visible_box(p, view):
    """Pixel box (x0, x1, y0, y1; inclusive, empty if x1 < x0) of the part of a triangle in front of the eye's plane."""
    fx, fy, cx, cy = view.intrinsics
    left, right, top, bottom = 1e30, -1e30, 1e30, -1e30
    smallest_z = 1e-4
    for v in range(3):
        ax, ay, az = p[3 * v], p[3 * v + 1], p[3 * v + 2]
        n = 3 * ((v + 1) % 3)
        bx, by, bz = p[n], p[n + 1], p[n + 2]
        if az >= smallest_z:
            x, y = fx * ax / az + cx, fy * ay / az + cy
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if (az >= smallest_z) != (bz >= smallest_z):
            s = (smallest_z - az) / (bz - az)
            x = fx * (ax + s * (bx - ax)) / smallest_z + cx
            y = fy * (ay + s * (by - ay)) / smallest_z + cy
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    if not (left <= right and top <= bottom):
        return 0, -1, 0, -1
    x0 = int(np.ceil(min(max(left, 0.0), view.width + 1.0) - 0.5))
    x1 = int(np.floor(max(min(right, float(view.width)), -1.0) - 0.5))
    y0 = int(np.ceil(min(max(top, 0.0), view.height + 1.0) - 0.5))
    y1 = int(np.floor(max(min(bottom, float(view.height)), -1.0) - 0.5))
    return x0, x1, y0, y1


@njit(nogil=True, forceinline=True)
def _cut_exact(low, high, edge, step, minus_inverse):
    """As `_cut`, in double; a zero step keeps all or nothing."""
    crossing = edge * minus_inverse
    if step > 0:
        return (crossing if crossing > low else low), high
    if step < 0:
        return low, (crossing if crossing < high else high)
    return low, (high if edge >= 0 else -1.0)


@njit(nogil=True, error_model="numpy")
def _fill_large(p, view, is_near, box, inv_z_at, words_at, stride, word):
    """Any triangle [9] in camera space: homogeneous edge functions in double (Olano & Greer 1997), without clipping.

    The rows of the inverse of [p0 p1 p2] give each barycentric over z as a linear function of the ray (u, v, 1).
    """
    fx, fy, cx, cy = view.intrinsics
    x0, x1, y0, y1 = np.int64(box[X0]), np.int64(box[X1]), np.int64(box[Y0]), np.int64(box[Y1])
    if is_near:
        x0, x1, y0, y1 = _visible_box(p, view)
    if x1 < x0 or y1 < y0:
        return
    ax, ay, az = p[4] * p[8] - p[5] * p[7], p[5] * p[6] - p[3] * p[8], p[3] * p[7] - p[4] * p[6]
    bx, by, bz = p[7] * p[2] - p[8] * p[1], p[8] * p[0] - p[6] * p[2], p[6] * p[1] - p[7] * p[0]
    gx, gy, gz = p[1] * p[5] - p[2] * p[4], p[2] * p[3] - p[0] * p[5], p[0] * p[4] - p[1] * p[3]
    determinant = p[0] * ax + p[1] * ay + p[2] * az
    if determinant == 0:
        return
    k = 1 / determinant
    # 1/z from the edge vectors: their normal does not suffer from cancellation
    sx, sy, sz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    tx, ty, tz = p[6] - p[0], p[7] - p[1], p[8] - p[2]
    nx, ny, nz = (sy * tz - sz * ty) * k, (sz * tx - sx * tz) * k, (sx * ty - sy * tx) * k
    per_x, per_y = 1 / fx, 1 / fy
    u, v = (x0 + 0.5 - cx) * per_x, (y0 + 0.5 - cy) * per_y
    d0, d1, d2, dw = ax * k * per_x, bx * k * per_x, gx * k * per_x, nx * per_x
    c0, c1, c2, cw = ay * k * per_y, by * k * per_y, gy * k * per_y, ny * per_y
    # generous by 1e-5 pixel, against cracks
    e0 = (ax * u + ay * v + az) * k + 1e-5 * (abs(d0) + abs(c0))
    e1 = (bx * u + by * v + bz) * k + 1e-5 * (abs(d1) + abs(c1))
    e2 = (gx * u + gy * v + gz) * k + 1e-5 * (abs(d2) + abs(c2))
    inv_z = nx * u + ny * v + nz
    last = float(x1 - x0)
    inverse0, inverse1, inverse2 = -1 / d0, -1 / d1, -1 / d2
    f0, f1, f2, fw = np.float32(d0), np.float32(d1), np.float32(d2), np.float32(dw)
    row = np.uintp((y0 * stride + x0) * 4)
    for _ in range(y0, y1 + 1):
        low, high = _cut_exact(0.0, last, e0, d0, inverse0)
        low, high = _cut_exact(low, high, e1, d1, inverse1)
        low, high = _cut_exact(low, high, e2, d2, inverse2)
        if high >= 0 and high >= low - 1:
            x, end = int(low), int(high)
            while x <= end:
                offset = row + np.uintp(x * 4)
                blend_block(
                    inv_z_at + offset,
                    words_at + offset,
                    np.float32(e0 + d0 * x),
                    np.float32(e1 + d1 * x),
                    np.float32(e2 + d2 * x),
                    np.float32(inv_z + dw * x),
                    f0,
                    f1,
                    f2,
                    fw,
                    np.int32(word),
                )
                x += 8
        e0 += c0
        e1 += c1
        e2 += c2
        inv_z += cw
        row += np.uintp(stride * 4)


# --- results --------------------------------------------------------------------------------------------------------
@kernel(error_model="numpy", boundscheck=False)
def read_depth(inv_z, depth):
    """Write z-depth [H, W] [m], 0 where nothing is."""
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            w = inv_z[y, x]
            depth[y, x] = np.float32(1) / w if w > 0 else np.float32(0)


@kernel(boundscheck=False)
def read_ids(words, draws, ids_of_instances, ids):
    """Write an id per pixel [H, W] from a table per instance [I]; -1 where nothing is."""
    for y in range(ids.shape[0]):
        for x in range(ids.shape[1]):
            word = words[y, x]
            ids[y, x] = ids_of_instances[draws[word >> 7, INSTANCE]] if word >= 0 else np.int32(-1)


@kernel(boundscheck=False)
def read_triangles(words, draws, cluster_packets, packet_triangles, triangles):
    """Write the mesh's triangle per pixel [H, W]; -1 where nothing is."""
    for y in range(triangles.shape[0]):
        for x in range(triangles.shape[1]):
            word = words[y, x]
            triangles[y, x] = -1
            if word >= 0:
                packet = cluster_packets[draws[word >> 7, CLUSTER], 0] + ((word & 127) >> 3)
                triangles[y, x] = packet_triangles[packet, word & 7]
