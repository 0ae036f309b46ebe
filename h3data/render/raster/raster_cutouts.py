"""The rasteriser's last pass: triangles with holes, filled exactly, with a look-up in the texture for each pixel."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel_part
from h3data.render.raster.raster_draw import (
    CLUSTER,
    INSTANCE,
    OCCLUSION_MARGIN,
    PACKET_BYTES,
    TILE_X0,
    TILE_X1,
    TILE_Y0,
    TILE_Y1,
    has_near_plane,
    hidden,
    lane_hidden,
    nearness_of,
    screen_words,
)
from h3data.render.raster.raster_fill import camera_corners, cut_exact, edge_functions, visible_box
from h3data.render.raster.raster_simd import (
    NEAR_M,
    SETUP_ROWS,
    X0,
    X1,
    Y0,
    Y1,
    count_trailing_zeros,
    setup_parallel_triangles,
    setup_triangles,
)
from h3data.render.shade.cutouts import is_solid


@kernel_part()
def draw_cutouts(geometry, cutouts, view, target, order):
    """Draw the clusters with holes in the given order, clipped at the near plane."""
    row_bytes = np.uintp(target.inv_z.shape[1] * 4)
    inv_z_at = np.uintp(target.inv_z.ctypes.data)
    matrices_at = np.uintp(target.pixel_from_mesh.ctypes.data)
    shared_count = len(geometry.shared_packets)
    screen = screen_words(view)
    table = np.empty((SETUP_ROWS, 8), np.float32)
    boxes = table.view(np.int32)
    table_at = np.uintp(table.ctypes.data)
    corners = np.empty(9)
    bounds, stale = target.tile_inv_z, target.tile_stale
    for draw in order:
        instance, cluster = target.draws[draw, INSTANCE], target.draws[draw, CLUSTER]
        row = cutouts.first[cluster]
        if row < 0:
            continue
        tile_x0, tile_x1 = target.draws[draw, TILE_X0], target.draws[draw, TILE_X1]
        tile_y0, tile_y1 = target.draws[draw, TILE_Y0], target.draws[draw, TILE_Y1]
        near = target.near[draw]
        if near > 0 or view.parallel:
            nearest = np.float32(nearness_of(near, view)) * OCCLUSION_MARGIN
            if hidden(tile_x0, tile_x1, tile_y0, tile_y1, nearest, bounds, stale, inv_z_at, row_bytes):
                continue
        first, end = geometry.cluster_packets[cluster]
        soup = geometry.shared_packets
        if first >= shared_count:
            soup, first, end = geometry.own_packets, first - shared_count, end - shared_count
        soup_at, matrix_at = np.uintp(soup.ctypes.data), matrices_at + np.uintp(instance * 48)
        for packet in range(first, end):
            packet_at = soup_at + np.uintp(packet * PACKET_BYTES)
            # the address is taken here, so that numba keeps the array until the last packet
            if view.parallel:
                masks = setup_parallel_triangles(packet_at, matrix_at, np.uintp(screen.ctypes.data), table_at)
            else:
                masks = setup_triangles(packet_at, matrix_at, np.uintp(screen.ctypes.data), table_at)
            # holes are looked up per pixel, so small, medium and large triangles take the same filler here
            left = (masks | masks >> 8 | masks >> 16) & 255
            while left:
                lane = count_trailing_zeros(left)
                left &= left - 1
                place = row + packet - first
                texture = cutouts.textures[place, lane]
                nearest_z = camera_corners(soup[packet, :, lane], target.camera_from_mesh[instance], corners)
                is_near = nearest_z < NEAR_M * 1.001 and not view.parallel
                if texture < 0 or (not is_near and lane_hidden(table, boxes, lane, bounds, stale, inv_z_at, row_bytes)):
                    continue
                word = np.int32(draw * 128 + (packet - first) * 8 + lane)
                fill_cutout(corners, view, is_near, boxes[:, lane], target, word, cutouts, place, lane)
        for ty in range(tile_y0, tile_y1 + 1):
            for tx in range(tile_x0, tile_x1 + 1):
                stale[ty, tx] = 1


@kernel_part(error_model="numpy")
def fill_cutout(p, view, is_near, box, target, word, cutouts, place, lane):
    """Fill a triangle like `raster_fill.fill_large`, but only where its texture is solid and behind the near plane."""
    x0, x1, y0, y1 = np.int64(box[X0]), np.int64(box[X1]), np.int64(box[Y0]), np.int64(box[Y1])
    if is_near:
        x0, x1, y0, y1 = visible_box(p, view)
    if x1 < x0 or y1 < y0:
        return
    found, (e0, e1, e2, inv_z), (d0, d1, d2, dw), (c0, c1, c2, cw) = edge_functions(p, view, x0, y0)
    if not found:
        return
    limit = np.float32(nearness_of(view.near, view) if has_near_plane(view) else np.inf)
    uv, texture = cutouts.uv[place], cutouts.textures[place, lane]
    s, t = float(uv[0, lane]), float(uv[1, lane])
    s1, t1, s2, t2 = uv[2, lane] - s, uv[3, lane] - t, uv[4, lane] - s, uv[5, lane] - t
    last = float(x1 - x0)
    inverse0, inverse1, inverse2 = -1 / d0, -1 / d1, -1 / d2
    for y in range(y0, y1 + 1):
        low, high = cut_exact(0.0, last, e0, d0, inverse0)
        low, high = cut_exact(low, high, e1, d1, inverse1)
        low, high = cut_exact(low, high, e2, d2, inverse2)
        if high >= 0 and high >= low - 1:
            for k in range(int(low), int(high) + 1):
                # depth before texture: most pixels of leaves and curtains are hidden, and a look-up costs
                # more
                nearness = np.float32(inv_z + dw * k)
                if not target.inv_z[y, x0 + k] < nearness <= limit:
                    continue
                b1, b2 = e1 + d1 * k, e2 + d2 * k
                if not (e0 + d0 * k >= 0 and b1 >= 0 and b2 >= 0):
                    continue
                if not view.parallel:
                    # texture coordinates are linear in space, not on the screen; the edge functions
                    # hold them over z
                    b1, b2 = b1 / (inv_z + dw * k), b2 / (inv_z + dw * k)
                if is_solid(cutouts.maps, cutouts.opacity, texture, s + b1 * s1 + b2 * s2, t + b1 * t1 + b2 * t2):
                    target.inv_z[y, x0 + k] = nearness
                    target.words[y, x0 + k] = word
        e0 += c0
        e1 += c1
        e2 += c2
        inv_z += cw
