"""Clusters in front-to-back order: occlusion culling against the coarse depth, and dispatch of triangles to the fillers."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel_part
from h3data.render.raster.raster_fill import camera_corners, clip_near, fill_large, fill_medium, fill_small
from h3data.render.raster.raster_simd import (
    CENTER_X,
    CENTER_Y,
    INV_Z_MAX,
    NEAR_M,
    SCREEN_HEIGHT,
    SCREEN_WIDTH,
    SCREEN_WORDS,
    SETUP_ROWS,
    X0,
    X1,
    Y0,
    Y1,
    count_trailing_zeros,
    setup_parallel_triangles,
    setup_triangles,
    tile_minimum,
)

TILE = 8
PACKET_BYTES = 9 * 8 * 4
OCCLUSION_MARGIN = np.float32(1.00001)
"""Factor on nearness in occlusion tests, so that rounding never culls a visible triangle."""

# Columns of `Target.draws`.
INSTANCE, CLUSTER, TILE_X0, TILE_X1, TILE_Y0, TILE_Y1 = range(6)


@kernel_part(forceinline=True, error_model="numpy")
def nearness_of(z, view):
    """Return the nearness at depth ``z``."""
    return view.reach - z if view.parallel else 1 / z


@kernel_part()
def screen_words(view):
    """Return the camera's parameters as words for `setup_triangles`."""
    screen = np.empty(SCREEN_WORDS, np.float32)
    screen[CENTER_X], screen[CENTER_Y] = view.intrinsics[2], view.intrinsics[3]
    screen[SCREEN_WIDTH], screen[SCREEN_HEIGHT] = view.width, view.height
    return screen


@kernel_part()
def hidden(tile_x0, tile_x1, tile_y0, tile_y1, inv_z, bounds, stale, inv_z_at, row_bytes):
    """Return whether all pixels in a range of tiles are nearer than ``inv_z``; update stale bounds as needed."""
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


@kernel_part()
def draw_clusters(geometry, cut_first, view, target, order):
    """Draw the clusters in the given order, without clusters that cross the near plane or have holes (``cut_first`` >= 0)."""
    stride = target.inv_z.shape[1]
    row_bytes = np.uintp(stride * 4)
    inv_z_at, words_at = np.uintp(target.inv_z.ctypes.data), np.uintp(target.words.ctypes.data)
    shared_at = np.uintp(geometry.shared_packets.ctypes.data)
    own_at = np.uintp(geometry.own_packets.ctypes.data)
    shared_count = len(geometry.shared_packets)
    matrices_at = np.uintp(target.pixel_from_mesh.ctypes.data)
    screen = screen_words(view)
    table = np.empty((SETUP_ROWS, 8), np.float32)
    boxes = table.view(np.int32)
    table_at = np.uintp(table.ctypes.data)
    corners = np.empty(9)
    cuts, cuts_out = has_near_plane(view), len(cut_first) > 0
    bounds, stale = target.tile_inv_z, target.tile_stale
    # what is farther away is cut off at the end of the image, and hides nothing that is not
    beyond = np.float32(view.far) * OCCLUSION_MARGIN
    for draw in order:
        instance, cluster = target.draws[draw, INSTANCE], target.draws[draw, CLUSTER]
        tile_x0, tile_x1 = target.draws[draw, TILE_X0], target.draws[draw, TILE_X1]
        tile_y0, tile_y1 = target.draws[draw, TILE_Y0], target.draws[draw, TILE_Y1]
        near = target.near[draw]
        if (cuts and near <= np.float32(view.near)) or near > beyond:
            continue  # the former are left to `draw_cut`
        if cuts_out and cut_first[cluster] >= 0:
            continue  # left to `draw_cutouts`
        if near > 0 or view.parallel:
            nearest = np.float32(nearness_of(near, view)) * OCCLUSION_MARGIN
            if hidden(tile_x0, tile_x1, tile_y0, tile_y1, nearest, bounds, stale, inv_z_at, row_bytes):
                continue
        first, end = geometry.cluster_packets[cluster]
        packet_at = shared_at + np.uintp(first * PACKET_BYTES)
        if first >= shared_count:
            packet_at = own_at + np.uintp((first - shared_count) * PACKET_BYTES)
        matrix_at = matrices_at + np.uintp(instance * 48)
        word = np.int32(draw * 128)
        for packet in range(end - first):
            # the address is taken here, so that numba keeps the array until the last packet
            if view.parallel:
                masks = setup_parallel_triangles(packet_at, matrix_at, np.uintp(screen.ctypes.data), table_at)
            else:
                masks = setup_triangles(packet_at, matrix_at, np.uintp(screen.ctypes.data), table_at)
            small, large, medium = masks & 255, (masks >> 8) & 255, masks >> 16
            while small:
                lane = count_trailing_zeros(small)
                small &= small - 1
                fill_small(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while medium:
                lane = count_trailing_zeros(medium)
                medium &= medium - 1
                if not lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    fill_medium(table, boxes, lane, inv_z_at, words_at, stride, word + lane)
            while large:
                lane = count_trailing_zeros(large)
                large &= large - 1
                soup = geometry.shared_packets
                p = first + packet
                if first >= shared_count:
                    soup, p = geometry.own_packets, p - shared_count
                nearest = camera_corners(soup[p, :, lane], target.camera_from_mesh[instance], corners)
                is_near = nearest < NEAR_M * 1.001 and not view.parallel
                if is_near or not lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
                    column = boxes[:, lane]
                    fill_large(corners, view, is_near, column, inv_z_at, words_at, stride, np.int32(word + lane))
            packet_at += np.uintp(PACKET_BYTES)
            word += np.int32(8)
        for ty in range(tile_y0, tile_y1 + 1):
            for tx in range(tile_x0, tile_x1 + 1):
                stale[ty, tx] = 1


@kernel_part(forceinline=True)
def has_near_plane(view):
    """Return whether triangles are clipped; perspective cameras without a near plane see everything up to the eye."""
    return view.near > 0 or view.parallel


@kernel_part()
def draw_cut(geometry, cut_first, view, target, order):
    """Draw the clusters that cross the near plane, which `draw_clusters` skips.

    Their triangles are clipped and filled one by one.
    """
    stride = target.inv_z.shape[1]
    inv_z_at, words_at = np.uintp(target.inv_z.ctypes.data), np.uintp(target.words.ctypes.data)
    shared_count = len(geometry.shared_packets)
    pieces = np.empty((2, 9))
    no_box = np.zeros((SETUP_ROWS, 8), np.int32)[:, 0]  # a column too, so that `fill_large` is compiled once
    for draw in order:
        instance, cluster = target.draws[draw, INSTANCE], target.draws[draw, CLUSTER]
        if target.near[draw] > np.float32(view.near) or (len(cut_first) and cut_first[cluster] >= 0):
            continue
        first, end = geometry.cluster_packets[cluster]
        for packet in range(first, end):
            soup, p = geometry.shared_packets, packet
            if first >= shared_count:
                soup, p = geometry.own_packets, packet - shared_count
            for lane in range(8):
                camera_corners(soup[p, :, lane], target.camera_from_mesh[instance], pieces[0])
                word = np.int32(draw * 128 + (packet - first) * 8 + lane)
                for k in range(clip_near(pieces, view.near)):
                    fill_large(pieces[k], view, True, no_box, inv_z_at, words_at, stride, word)


@kernel_part(forceinline=True)
def lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes):
    """Return whether the tiles of one triangle of a packet are occluded (`hidden`), after its set-up."""
    nearest = table[INV_Z_MAX, lane] * OCCLUSION_MARGIN
    x0, x1, y0, y1 = boxes[X0, lane] >> 3, boxes[X1, lane] >> 3, boxes[Y0, lane] >> 3, boxes[Y1, lane] >> 3
    return hidden(x0, x1, y0, y1, nearest, bounds, stale, inv_z_at, row_bytes)
