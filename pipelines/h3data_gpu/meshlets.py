"""Division of meshes into clusters of at most 64 triangles and 128 vertices, and groups of at most 32 clusters.

Splits minimise the surface of bounding boxes (the surface area heuristic of ray tracing). Meshes are split into groups
at binned positions (Wald 2007), and each group into clusters at multiples of 64 triangles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part

CLUSTER_TRIANGLES, CLUSTER_VERTICES, GROUP_CLUSTERS = 64, 128, 32
GROUP_TRIANGLES = 1792
"""Largest number of triangles of a group, so small that a group seldom has more than 32 clusters. In measurements,
larger groups were no faster.
"""
_BINS = 16


class Meshlets(NamedTuple):
    """Clusters of a mesh."""

    vertices: NDArray[np.int32]
    """Index of the mesh vertex of each cluster vertex, one cluster after another, shape [N]."""
    triangles: NDArray[np.uint32]
    """Three vertex indices within the cluster for each triangle, 8 bits each, 0 = none, shape [C, 64]."""
    faces: NDArray[np.int32]
    """Index of the mesh triangle for each triangle of a cluster, -1 = none, shape [C, 64]."""
    first_vertex: NDArray[np.int32]
    """First row in ``vertices`` of each cluster, followed by the total number of rows, shape [C + 1]."""
    triangle_count: NDArray[np.int32]
    """Number of triangles of each meshlet, shape [C]."""
    low: NDArray[np.float32]
    """Minimum corners of the clusters' bounding boxes in the frame of the mesh, shape [C, 3] [m]."""
    high: NDArray[np.float32]
    """Maximum corners of the clusters' bounding boxes in the frame of the mesh, shape [C, 3] [m]."""
    cut_out: NDArray[np.bool_]
    """Flags of clusters whose triangles may have holes (`h3data.render.shade.cutouts`), shape [C]."""
    group_first: NDArray[np.int32]
    """First cluster of each group, followed by the total number of clusters, shape [G + 1]."""


def build_meshlets(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], cut_out: NDArray[np.bool_] | None = None
) -> Meshlets:
    """Return the clusters of a mesh with vertices [V, 3] and triangles [F, 3].

    Triangles with holes (``cut_out`` [F]) get clusters of their own.
    """
    low, high = _triangle_boxes(vertices, faces)
    cut = np.zeros(len(faces), np.bool_) if cut_out is None else cut_out
    order, starts, groups = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    for chosen in (np.flatnonzero(~cut), np.flatnonzero(cut)):
        part_order, part_starts, part_groups = _cut(faces[chosen], low[chosen], high[chosen])
        starts = np.concatenate([starts, part_starts + len(order)])
        groups = np.concatenate([groups, part_groups + groups.max(initial=-1) + 1])
        order = np.concatenate([order, chosen[part_order]])
    ends = np.append(starts[1:], len(faces)).astype(np.int64)
    parts = _pack(vertices, faces, order, starts, ends)
    # A group is a run of clusters; runs of more than 32 are divided.
    first: list[int] = []
    for cluster, group in enumerate(groups):
        if not first or group != groups[cluster - 1] or cluster - first[-1] == GROUP_CLUSTERS:
            first.append(cluster)
    return Meshlets(*parts, cut_out=cut[order[starts]], group_first=np.array([*first, len(groups)], np.int32))


@kernel()
def _triangle_boxes(vertices, faces):
    low, high = np.empty((len(faces), 3), np.float32), np.empty((len(faces), 3), np.float32)
    for f in range(len(faces)):
        for axis in range(3):
            a, b, c = vertices[faces[f, 0], axis], vertices[faces[f, 1], axis], vertices[faces[f, 2], axis]
            low[f, axis], high[f, axis] = min(a, b, c), max(a, b, c)
    return low, high


@kernel_part()
def _clear(box):
    box[:3] = np.inf
    box[3:] = -np.inf


@kernel_part()
def _grow(box, low, high):
    for axis in range(3):
        box[axis] = min(box[axis], low[axis])
        box[3 + axis] = max(box[3 + axis], high[axis])


@kernel_part()
def _surface(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@kernel_part()
def _binned_split(order, low, high, start, end):
    """Reorder ``order[start:end]`` at the cheapest boundary between bins; return the index of the split."""
    centers = np.empty(6)
    _clear(centers)
    for k in order[start:end]:
        middle = 0.5 * (low[k] + high[k])
        _grow(centers, middle, middle)
    cheapest, best_axis, best_bin = np.inf, -1, 0
    counts, boxes, box = np.empty(_BINS, np.int64), np.empty((_BINS, 6)), np.empty(6)
    after, behind = np.empty(_BINS), np.empty(_BINS, np.int64)
    for axis in range(3):
        extent = centers[3 + axis] - centers[axis]
        if extent <= 1e-9:
            continue
        scale = _BINS * 0.9999 / extent
        counts[:] = 0
        for b in range(_BINS):
            _clear(boxes[b])
        for k in order[start:end]:
            b = int((0.5 * (low[k, axis] + high[k, axis]) - centers[axis]) * scale)
            counts[b] += 1
            _grow(boxes[b], low[k], high[k])
        _clear(box)
        count = 0
        for b in range(_BINS - 1, 0, -1):
            count += counts[b]
            _grow(box, boxes[b, :3], boxes[b, 3:])
            after[b], behind[b] = (_surface(box) if count else 0.0), count
        _clear(box)
        count = 0
        for b in range(_BINS - 1):
            count += counts[b]
            _grow(box, boxes[b, :3], boxes[b, 3:])
            if count and behind[b + 1]:
                cost = _surface(box) * count + after[b + 1] * behind[b + 1]
                if cost < cheapest:
                    cheapest, best_axis, best_bin = cost, axis, b
    if best_axis < 0:
        return (start + end) // 2
    scale = _BINS * 0.9999 / (centers[3 + best_axis] - centers[best_axis])
    i, j = start, end - 1
    while i <= j:
        k = order[i]
        if int((0.5 * (low[k, best_axis] + high[k, best_axis]) - centers[best_axis]) * scale) <= best_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@kernel_part()
def _sorted_split(order, low, high, start, end):
    """Sort ``order[start:end]`` along the axis of the cheapest split at whole clusters; return the index of the split."""
    count = end - start
    step = CLUSTER_TRIANGLES if count > CLUSTER_TRIANGLES else max(1, count // 2)
    cheapest, split, box = np.inf, step, np.empty(6)
    given = order[start:end].copy()
    after = np.empty(count)
    for axis in range(3):
        along = given[np.argsort(low[given, axis] + high[given, axis], kind="mergesort")]
        _clear(box)
        for i in range(count - 1, 0, -1):
            _grow(box, low[along[i]], high[along[i]])
            after[i] = _surface(box)
        _clear(box)
        for i in range(count - 1):
            _grow(box, low[along[i]], high[along[i]])
            if (i + 1) % step == 0:
                cost = _surface(box) * (i + 1) + after[i + 1] * (count - i - 1)
                if cost < cheapest:
                    cheapest, split = cost, i + 1
                    order[start:end] = along
    return start + split


@kernel_part()
def _vertex_count(order, faces, start, end, seen):
    """Return the number of distinct vertices of triangles ``order[start:end]``; ``seen`` is scratch for 3 * 64 vertices."""
    count = 0
    for i in range(start, end):
        for corner in range(3):
            v = faces[order[i], corner]
            known = False
            for k in range(count):
                known |= seen[k] == v
            if not known:
                seen[count] = v
                count += 1
    return count


@kernel()
def _cut(faces, low, high):
    """Return the order of the triangles [F], the start of each cluster in it [C], and the group of each cluster [C]."""
    total = len(faces)
    order = np.arange(total)
    capacity = total // 8 + 64
    starts, groups = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    clusters, group = 0, -1
    pending = np.empty((total // 64 + 256, 3), np.int64)  # start, end, whether inside a group
    pending[0, 0], pending[0, 1], pending[0, 2] = 0, total, 0
    waiting = 1 if total else 0
    seen = np.empty(3 * CLUSTER_TRIANGLES, np.int64)
    while waiting:
        waiting -= 1
        start, end, within = pending[waiting]
        if end - start > GROUP_TRIANGLES:
            middle = _binned_split(order, low, high, start, end)
        else:
            if not within:
                group += 1
            few = end - start <= CLUSTER_TRIANGLES
            if few and _vertex_count(order, faces, start, end, seen) <= CLUSTER_VERTICES:
                starts[clusters], groups[clusters] = start, group
                clusters += 1
                continue
            within = 1
            middle = _sorted_split(order, low, high, start, end)
        pending[waiting, 0], pending[waiting, 1], pending[waiting, 2] = middle, end, within
        pending[waiting + 1, 0], pending[waiting + 1, 1], pending[waiting + 1, 2] = start, middle, within
        waiting += 2
    return order, starts[:clusters], groups[:clusters]


@kernel()
def _pack(vertices, faces, order, starts, ends):
    """Return the first seven fields of `Meshlets`, for clusters ``order[starts:ends]``."""
    count = len(starts)
    used = np.empty(3 * len(faces), np.int32)
    triangles = np.zeros((count, CLUSTER_TRIANGLES), np.uint32)
    mesh_faces = np.full((count, CLUSTER_TRIANGLES), -1, np.int32)
    first, triangle_count = np.zeros(count + 1, np.int32), np.zeros(count, np.int32)
    low, high = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    for c in range(count):
        begin, known = first[c], 0
        low[c], high[c] = np.inf, -np.inf
        triangle_count[c] = ends[c] - starts[c]
        for i in range(starts[c], ends[c]):
            word = np.uint32(0)
            for corner in range(3):
                v = faces[order[i], corner]
                local = 0
                while local < known and used[begin + local] != v:
                    local += 1
                if local == known:
                    used[begin + known] = v
                    known += 1
                    for axis in range(3):
                        low[c, axis] = min(low[c, axis], vertices[v, axis])
                        high[c, axis] = max(high[c, axis], vertices[v, axis])
                word |= np.uint32(local) << np.uint32(8 * corner)
            triangles[c, i - starts[c]] = word
            mesh_faces[c, i - starts[c]] = order[i]
        first[c + 1] = begin + known
    return used[: first[count]].copy(), triangles, mesh_faces, first, triangle_count, low, high
