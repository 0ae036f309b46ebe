"""Construction of a navmesh's walking surface: orientation, buckets, and the corners where paths bend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data_habitat.navmesh._surface import Surface
from h3data_habitat.navmesh._surface_paths import link_nodes
from h3data_habitat.navmesh.navmesh import NavMesh

BUCKET_M = 0.5
"""Side of a bucket of polygons; larger where a mesh would have more than `BUCKETS_MAX` on a side."""
BUCKETS_MAX = 512
STRAIGHT_SINE = 0.1
"""Sine of the inward turn below which a wall corner is a node too: from a point a hair outside a wall, only the next
corner of the wall is visible along it."""


def build_surface(navmesh: NavMesh) -> Surface:
    """Build the surface of the polygons of a navmesh that can be walked on, without path graph (see `with_graph`).

    Polygon k of the surface is the k-th of `NavMesh.enabled`.
    """
    kept = np.flatnonzero(navmesh.enabled)
    # one more, so that neighbour -1, a wall, stays -1
    new = np.full(len(navmesh.flags) + 1, -1, np.int32)
    new[kept] = np.arange(len(kept))
    count = np.diff(navmesh.polygon_start)[kept]
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    vertex, neighbour = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    for k, p in enumerate(kept):
        inside = slice(navmesh.polygon_start[p], navmesh.polygon_start[p + 1])
        v, n = navmesh.polygon_vertices[inside], new[navmesh.polygon_neighbours[inside]]
        x, z = navmesh.vertices[v, 0].astype(float), navmesh.vertices[v, 2].astype(float)
        if np.dot(x - x[0], np.roll(z, -1) - np.roll(z, 1)) < 0:  # clockwise; edge k of the reversed ring was n - 2 - k
            v, n = v[::-1], np.roll(n[::-1], -1)
        vertex[start[k] : start[k + 1]], neighbour[start[k] : start[k + 1]] = v, n
    corner = navmesh.vertices[vertex].astype(np.float64)
    triangle = navmesh.detail_triangles[np.repeat(navmesh.enabled, np.diff(navmesh.detail_start))].astype(np.float64)
    triangles = np.diff(navmesh.detail_start)[kept]
    triangle_start = np.concatenate([[0], np.cumsum(triangles)]).astype(np.int32)
    # also of the detail triangles, whose heights may leave those of the corners
    low = np.minimum(np.minimum.reduceat(corner, start[:-1]), np.minimum.reduceat(triangle.min(1), triangle_start[:-1]))
    high = np.maximum(
        np.maximum.reduceat(corner, start[:-1]), np.maximum.reduceat(triangle.max(1), triangle_start[:-1])
    )
    none = np.zeros(0, np.int32)
    return Surface(
        start=start,
        corner=corner,
        neighbour=neighbour,
        island=navmesh.islands[kept].astype(np.int32),
        box=np.concatenate([low, high], axis=1),
        triangle_start=triangle_start,
        triangle=triangle,
        climb=np.array([navmesh.settings.agent_max_climb]),
        **_buckets(low, high),
        corner_node=np.full(len(corner), -1, np.int32),
        node=np.zeros((0, 3)),
        node_polygon=none,
        node_side=np.zeros((0, 4)),
        link_start=np.zeros(1, np.int64),
        link_node=np.zeros(0, np.int64),
        link_length=np.zeros(0),
    )


def with_graph(surface: Surface) -> Surface:
    """Return the surface with the graph of its wall corners, in which a taut string can follow every link."""
    last = np.repeat(surface.start[1:] - 1, np.diff(surface.start))
    first = np.repeat(surface.start[:-1], np.diff(surface.start))
    at = np.arange(len(last))
    following = np.where(at == last, first, at + 1)
    previous = np.where(at == first, last, at - 1)
    polygon = np.repeat(np.arange(len(surface.island), dtype=np.int32), np.diff(surface.start))
    node_of = np.full(len(at), -1, np.int32)
    nodes, sides = [], []
    for s in np.flatnonzero(surface.neighbour < 0):
        fan = _fan(surface, int(s), following, previous, polygon)
        v, after = surface.corner[s, ::2], surface.corner[following[s], ::2]
        before = surface.corner[previous[fan[-1]], ::2]
        u, w = v - before, after - v
        # a path only bends at corners of walls that point into the free floor
        if u[0] * w[1] - u[1] * w[0] > STRAIGHT_SINE * np.hypot(*u) * np.hypot(*w):
            continue
        node_of[fan] = len(nodes)
        nodes.append(s)
        sides.append([*before, *after])
    at_node = np.array(nodes, np.int64)
    surface = surface._replace(
        corner_node=node_of,
        node=surface.corner[at_node],
        node_polygon=polygon[at_node],
        node_side=np.array(sides, np.float64).reshape(-1, 4),
    )
    start, links = link_nodes(surface)
    owner = np.repeat(np.arange(len(nodes)), np.diff(start))
    length = np.linalg.norm(surface.node[links] - surface.node[owner], axis=1)
    return surface._replace(link_start=start, link_node=links, link_length=length)


def _fan(surface: Surface, s: int, following: NDArray, previous: NDArray, polygon: NDArray) -> list[int]:
    """Return the corners around one vertex, from corner s, whose edge is a wall, to the one whose edge before it is a wall."""
    fan = [s]
    while True:
        before = previous[fan[-1]]
        beyond = surface.neighbour[before]
        if beyond < 0:
            return fan
        mine = polygon[before]
        inside = range(surface.start[beyond], surface.start[beyond + 1])
        point = surface.corner[s]
        # by place and neighbour: polygons may share several vertices
        following_corner = [t for t in inside if surface.neighbour[t] == mine and (surface.corner[t] == point).all()]
        if not following_corner or following_corner[0] in fan:
            return fan
        fan.append(following_corner[0])


def _buckets(low: NDArray, high: NDArray) -> dict[str, NDArray]:
    """Return a grid of floor squares with the polygons whose boxes touch each."""
    origin = low[:, ::2].min(0)
    extent = high[:, ::2].max(0) - origin
    # a mesh of many kilometres must not make a grid that fills the memory
    size = max(BUCKET_M, float(extent.max()) / BUCKETS_MAX)
    shape = np.floor(extent / size).astype(int) + 1
    lower = np.clip(np.floor((low[:, ::2] - origin) / size).astype(int), 0, shape - 1)
    upper = np.clip(np.floor((high[:, ::2] - origin) / size).astype(int), 0, shape - 1)
    spans = zip(range(len(low)), lower.tolist(), upper.tolist(), strict=True)
    pairs = [np.zeros((0, 2), np.int64)]
    for p, (i0, j0), (i1, j1) in spans:
        flat = np.add.outer(np.arange(i0, i1 + 1) * shape[1], np.arange(j0, j1 + 1)).reshape(-1)
        pairs.append(np.stack([flat, np.full(len(flat), p)], axis=1))
    both = np.concatenate(pairs)
    # stable, so that polygons stay in their order: of equally near ones the first is taken
    both = both[np.argsort(both[:, 0], kind="stable")]
    count = np.bincount(both[:, 0], minlength=int(shape[0] * shape[1]))
    return {
        "bucket_first": (np.cumsum(count) - count).astype(np.int32).reshape(shape),
        "bucket_count": count.astype(np.int32).reshape(shape),
        "bucket_polygon": both[:, 1].astype(np.int32),
        "bucket": np.array([*origin, size]),
    }
