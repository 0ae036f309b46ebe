"""Meshes as clusters of triangles, the input of the rasteriser: construction, and refitting after a deformation.

A packet holds 8 triangles, lane by lane: ``float32 [9, 8]``, x y z of the three vertices. A cluster is up to 12 packets
of neighbouring triangles with a bounding box. Unused lanes hold a degenerate triangle, which covers no pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

CLUSTER_TRIANGLES = 96
"""Largest number of triangles in a cluster, at most 128 because a pixel's word has 7 bits for it. Values of 48 and 192
were equally fast."""


class Clusters(NamedTuple):
    """Clusters of the triangles of one mesh."""

    packets: NDArray[np.float32]
    """Vertices of the triangles in packets, shape [P, 9, 8] [m]."""
    triangles: NDArray[np.int32]
    """Mesh triangle of every lane, -1 = padding, shape [P, 8]."""
    first: NDArray[np.int32]
    """First packet of each cluster, followed by the number of packets, shape [C + 1]."""
    center: NDArray[np.float64]
    """Centres of the bounding boxes, shape [C, 3] [m]."""
    half: NDArray[np.float64]
    """Half sizes of the bounding boxes, shape [C, 3] [m]."""
    corners: NDArray[np.uint32]
    """Mesh vertex of each corner of every lane, shape [P, 3, 8]; padding lanes collapse to a vertex of their cluster."""


def build_clusters(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], cut_out: NDArray[np.bool_] | None = None
) -> Clusters:
    """Build the clusters of a mesh [V, 3], [F, 3] by median splits of the triangles' centres along the longest axis.

    Triangles with holes (``cut_out`` [F]) get separate clusters.
    """
    centroids = _centroids(vertices, faces)
    if cut_out is None or not cut_out.any():
        order, starts = _split(centroids)
    else:
        # triangles with holes are drawn in a pass of their own and hide nothing, so they must not share a cluster
        # with solid ones
        plain, cut = np.flatnonzero(~cut_out), np.flatnonzero(cut_out)
        (plain_order, plain_starts), (cut_order, cut_starts) = _split(centroids[plain]), _split(centroids[cut])
        order = np.concatenate([plain[plain_order], cut[cut_order]]).astype(np.int32)
        starts = np.concatenate([plain_starts[:-1], cut_starts + np.int32(len(plain))])
    triangles, first = _lanes(order, starts)
    count = len(first) - 1
    corners = _corners(faces, triangles, first)
    packets = np.zeros((len(triangles), 9, 8), np.float32)
    center, half = np.zeros((count, 3)), np.zeros((count, 3))
    fill_packets(vertices, corners, packets)
    fill_boxes(vertices, corners.reshape(-1), 24 * first, center, half)
    return Clusters(packets, triangles, first, center, half, corners)


@kernel()
def _centroids(vertices, faces):
    out = np.empty((len(faces), 3), np.float32)
    for f in range(len(faces)):
        for axis in range(3):
            total = vertices[faces[f, 0], axis] + vertices[faces[f, 1], axis] + vertices[faces[f, 2], axis]
            out[f, axis] = total * np.float32(1 / 3)
    return out


@kernel()
def _select(order, keys, left, right, k):
    """Reorder ``order[left..right]`` (inclusive) so that element k is in its sorted position by key (quickselect)."""
    while right > left:
        a, b, c = keys[order[left]], keys[order[(left + right) // 2]], keys[order[right]]
        # the median of three: grids come sorted, and the first element as pivot would make that the worst case
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if k <= j:
            right = j
        elif k >= i:
            left = i
        else:
            return


@kernel()
def _split(centroids):
    """Return the order of the triangles [F], and the start of each cluster in it followed by F, shape [C + 1]."""
    count = len(centroids)
    order = np.arange(count).astype(np.int32)
    starts = np.empty(count // 40 + 2, np.int32)  # a split of 97 leaves at least 41
    clusters = 0
    # a stack of a fixed size instead of recursion: one half waits per level, and there are at most 32 levels
    pending = np.empty((64, 2), np.int64)
    pending[0, 0], pending[0, 1] = 0, count
    waiting = 1 if count else 0
    while waiting:
        waiting -= 1
        begin, end = pending[waiting]
        size = end - begin
        if size <= CLUSTER_TRIANGLES:
            starts[clusters] = begin
            clusters += 1
            continue
        axis, longest = 0, np.float32(-1)
        for a in range(3):
            low = high = centroids[order[begin], a]
            for i in range(begin, end):
                value = centroids[order[i], a]
                low, high = min(low, value), max(high, value)
            if high - low > longest:
                axis, longest = a, high - low
        middle = begin + (size // 2 + 7) // 8 * 8  # whole packets
        _select(order, centroids[:, axis], begin, end - 1, middle)
        pending[waiting, 0], pending[waiting, 1] = middle, end
        pending[waiting + 1, 0], pending[waiting + 1, 1] = begin, middle
        waiting += 2
    starts[clusters] = count
    return order, starts[: clusters + 1]


@kernel()
def _lanes(order, starts):
    """Return the triangle in every lane [P, 8], and the first packet of each cluster [C + 1]."""
    first = np.zeros(len(starts), np.int32)
    for c in range(len(starts) - 1):
        first[c + 1] = first[c] + (starts[c + 1] - starts[c] + 7) // 8
    triangles = np.full((first[-1], 8), -1, np.int32)
    for c in range(len(starts) - 1):
        for k in range(starts[c + 1] - starts[c]):
            triangles[first[c] + k // 8, k % 8] = order[starts[c] + k]
    return triangles, first


@kernel()
def _corners(faces, triangles, first):
    """Return `Clusters.corners` as unsigned numbers.

    Kernels then need not test for negative indices, and take half the time.
    """
    corners = np.empty((len(triangles), 3, 8), np.uint32)
    for c in range(len(first) - 1):
        # padding collapses to a vertex of its own cluster, so that the box stays tight when the mesh deforms
        fallback = faces[triangles[first[c], 0], 0]
        for p in range(first[c], first[c + 1]):
            for lane in range(8):
                triangle = triangles[p, lane]
                for k in range(3):
                    corners[p, k, lane] = faces[triangle, k] if triangle >= 0 else fallback
    return corners


def cluster_vertices(clusters: Clusters) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """List the vertices of each cluster once, for meshes that deform; this is a fifth of the corners of triangles.

    Returns:
        Vertices of all clusters in sequence, and the index of the first one of each cluster, followed by their number
        [C + 1].
    """
    sizes = np.diff(clusters.first)
    cluster = np.repeat(np.arange(len(sizes), dtype=np.int64), 24 * sizes)
    pairs = np.unique((cluster << 32) | clusters.corners.reshape(-1).astype(np.int64))
    starts = np.searchsorted(pairs >> 32, np.arange(len(sizes) + 1)).astype(np.int32)
    return (pairs & 0xFFFFFFFF).astype(np.uint32), starts


@kernel(boundscheck=False)
def fill_packets(vertices, corners, packets):
    """Fill packets [P, 9, 8] for vertices [V, 3]; the clusters of deformed meshes do not change."""
    for p in range(len(corners)):
        for k in range(3):
            for lane in range(8):
                v = corners[p, k, lane]
                packets[p, 3 * k, lane] = vertices[v, 0]
                packets[p, 3 * k + 1, lane] = vertices[v, 1]
                packets[p, 3 * k + 2, lane] = vertices[v, 2]


@kernel(boundscheck=False)
def fill_boxes(vertices, members, starts, center, half):
    """Fill the bounding boxes [C, 3] [m] of clusters with the vertices ``members[starts[c] : starts[c + 1]]``."""
    for c in range(len(starts) - 1):
        v = members[starts[c]]
        x0 = x1 = vertices[v, 0]
        y0 = y1 = vertices[v, 1]
        z0 = z1 = vertices[v, 2]
        for i in range(starts[c], starts[c + 1]):
            v = members[i]
            x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
            x0, x1 = min(x0, x), max(x1, x)
            y0, y1 = min(y0, y), max(y1, y)
            z0, z1 = min(z0, z), max(z1, z)
        center[c, 0], half[c, 0] = (float(x0) + float(x1)) / 2, (float(x1) - float(x0)) / 2 + 1e-6
        center[c, 1], half[c, 1] = (float(y0) + float(y1)) / 2, (float(y1) - float(y0)) / 2 + 1e-6
        center[c, 2], half[c, 2] = (float(z0) + float(z1)) / 2, (float(z1) - float(z0)) / 2 + 1e-6


def enclosing_box(center: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre and half size, shape [2, 3] [m], of the box around boxes [C, 3]; zeros if there are no boxes."""
    if not len(center):
        return np.zeros((2, 3))
    low, high = (center - half).min(0), (center + half).max(0)
    return np.stack([(low + high) / 2, (high - low) / 2])


def normal_groups(vertices: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the group of each vertex, shape [V]; vertices with equal positions and normals share a group.

    Vertices that are duplicated for a texture seam therefore have a common normal when the mesh deforms, and vertices
    that are duplicated for a sharp edge do not.
    """
    if not len(vertices):
        return np.zeros(0, np.int32)
    # rounded, because exporters write the two sides of a seam with different last digits
    keys = np.round(np.concatenate([vertices * 1e5, normals * 1e2], axis=1)).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)


@kernel(boundscheck=False)
def smooth_normals(vertices, faces, groups, sums, normals):
    """Fill ``normals`` [V, 3] with unit vertex normals: face normals weighted by area and summed over each group.

    ``sums`` float32 [groups, 3] is a temporary buffer.
    """
    sums[:] = 0
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
        bx, by, bz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            g = groups[v]
            sums[g, 0] += nx
            sums[g, 1] += ny
            sums[g, 2] += nz
    for v in range(len(normals)):
        g = groups[v]
        x, y, z = sums[g, 0], sums[g, 1], sums[g, 2]
        length = np.sqrt(x * x + y * y + z * z)
        scale = np.float32(1) / length if length > 0 else np.float32(0)
        normals[v, 0], normals[v, 1], normals[v, 2] = x * scale, y * scale, z * scale
