"""Kernels that read depth, ids and triangles from a rendered target."""

from __future__ import annotations

import numpy as np

from h3data.kernels import kernel
from h3data.render.raster.raster import CLUSTER, INSTANCE


@kernel(error_model="numpy", boundscheck=False)
def read_depth(inv_z, depth):
    """Fill ``depth`` [H, W] with the z-depth of each pixel [m]; 0 in the background."""
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            w = inv_z[y, x]
            depth[y, x] = np.float32(1) / w if w > 0 else np.float32(0)


@kernel(boundscheck=False)
def read_parallel_depth(nearness, reach, depth):
    """Fill ``depth`` [H, W] with the z-depth of each pixel [m] for an orthographic camera; 0 in the background."""
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            w = nearness[y, x]
            depth[y, x] = np.float32(reach - w) if w > 0 else np.float32(0)


@kernel(boundscheck=False)
def read_ids(words, draws, ids_of_instances, ids):
    """Fill ``ids`` [H, W] with the id of each pixel, from a table of instances [I]; -1 in the background."""
    last, found = np.int32(-1), np.int32(-1)
    for y in range(ids.shape[0]):
        for x in range(ids.shape[1]):
            word = words[y, x]
            if word != last:  # neighbours mostly show the same triangle
                last = word
                found = ids_of_instances[draws[word >> 7, INSTANCE]] if word >= 0 else np.int32(-1)
            ids[y, x] = found


@kernel(boundscheck=False)
def read_triangles(words, draws, cluster_packets, packet_triangles, triangles):
    """Fill ``triangles`` [H, W] with the index of each pixel's triangle in its mesh; -1 in the background."""
    for y in range(triangles.shape[0]):
        for x in range(triangles.shape[1]):
            word = words[y, x]
            triangles[y, x] = -1
            if word >= 0:
                packet = cluster_packets[draws[word >> 7, CLUSTER], 0] + ((word & 127) >> 3)
                triangles[y, x] = packet_triangles[packet, word & 7]
