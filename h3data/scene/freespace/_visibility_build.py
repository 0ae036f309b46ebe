"""Construction of the visibility graph of a free area (shapely), in which every edge is checked twice."""

from __future__ import annotations

import logging

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from h3data.errors import SceneError
from h3data.scene.freespace._potentially_visible import potentially_visible
from h3data.scene.freespace._visibility import GROW_M, Graph, bucket_edges, visibility_edges


def polygon_parts(area: shapely.Geometry) -> list[Polygon]:
    """Return the polygons in a shapely geometry of any type, largest first."""
    parts = [p for p in shapely.get_parts(area, return_index=False) if isinstance(p, Polygon) and not p.is_empty]
    nested = [q for p in shapely.get_parts(area) if not isinstance(p, Polygon) for q in shapely.get_parts(p)]
    parts += [q for q in nested if isinstance(q, Polygon) and not q.is_empty]
    return sorted(parts, key=lambda p: -p.area)


def ring_edges(polygon: Polygon) -> NDArray[np.float64]:
    """Return the edges ``x0 z0 x1 z1`` [E, 4] of all rings of a polygon, with the inside on the left."""
    corners = [np.asarray(ring.coords)[:, :2] for ring in _rings(polygon)]
    if not corners:
        return np.zeros((0, 4))
    return np.concatenate([np.concatenate([c[:-1], c[1:]], axis=1) for c in corners])


def area_edges(area: MultiPolygon) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the edges [E, 4] of all polygons of an area, and the index of the polygon of each edge [E]."""
    per_part = [ring_edges(p) for p in area.geoms]
    owner = np.repeat(np.arange(len(per_part), dtype=np.int32), [len(e) for e in per_part])
    return np.concatenate([np.zeros((0, 4)), *per_part]), owner


def build_graph(area: MultiPolygon) -> Graph:
    """Return the visibility graph with all shortest paths of a free area; islands are its polygons, in their order."""
    rings, ring_island = area_edges(area)
    # mitred, because each rounded corner would be several edges
    grown = polygon_parts(area.buffer(GROW_M, join_style="mitre"))
    labels = [_label(area, part) for part in grown]
    edges = np.concatenate([np.zeros((0, 4)), *[ring_edges(p) for p in grown]])
    edge_island = np.repeat(np.array(labels, np.int32), [len(ring_edges(p)) for p in grown])
    nodes, before, after, first = _reflex_corners(area)
    origin, size, label = _buckets(area, grown, labels)
    start, items = bucket_edges(edges, origin, size, *label.shape)
    graph = Graph(
        nodes=nodes,
        before=before,
        after=after,
        first=first,
        distance=np.zeros((0, 0), np.float32),
        previous=np.zeros((0, 0), np.int16),
        rings=rings,
        ring_island=ring_island,
        edges=edges,
        edge_island=edge_island,
        bucket_start=start,
        bucket_edges=items,
        bucket_label=label,
        bucket_origin=origin,
        bucket_size=np.array([size]),
        visible_start=np.zeros(0, np.int32),
        visible_nodes=np.zeros(0, np.int32),
    )
    # also where the middle is not free: part of a bucket with edges may be
    used = (label >= 0) | (np.diff(start) > 0).reshape(label.shape)
    near = potentially_visible(nodes, before, after, first, edges, edge_island, used, origin, size)
    graph = graph._replace(visible_start=near[0], visible_nodes=near[1])
    pairs, lengths = visibility_edges(graph)
    # the kernels test crossings in floating point; shapely decides once more about each edge
    good = edges_inside(area, nodes[pairs[:, 0]], nodes[pairs[:, 1]])
    if not good.all():
        logging.getLogger(__name__).warning(
            "Visibility graph: %d of %d edges leave the free area and are dropped.", (~good).sum(), len(good)
        )
    distance, previous = _all_pairs(len(nodes), pairs[good], lengths[good])
    return graph._replace(distance=distance, previous=previous)


def edges_inside(
    area: MultiPolygon, starts: NDArray, ends: NDArray, *, tolerance_m: float = 2 * GROW_M
) -> NDArray[np.bool_]:
    """Return whether each segment [K, 2]-[K, 2] stays in the area, bool [K], by an independent test with shapely.

    A strict crossing test accepts segments through walls that touch them only at vertices (32 of 4,025 edges in one
    home, with wrong lengths of paths by 15%; research/navigation-and-stepping.md 2.3). Therefore every edge of the
    graph must also pass this test.
    """
    if not len(starts):
        return np.zeros(0, bool)
    room = area.buffer(tolerance_m, join_style="mitre")
    shapely.prepare(room)
    return np.asarray(shapely.covers(room, shapely.linestrings(np.stack([starts, ends], axis=1))))


def _rings(polygon: Polygon) -> list:
    oriented = shapely.orient_polygons(polygon)  # exterior counter-clockwise, holes clockwise: inside on the left
    return [oriented.exterior, *oriented.interiors]


def _label(area: MultiPolygon, grown: Polygon) -> int:
    """Return the polygon that a grown one came from (the largest, if growing joined some)."""
    shapely.prepare(grown)
    for k, part in enumerate(area.geoms):
        # a point inside for certain, which the centroid of a bent polygon may not be
        if grown.intersects(part.representative_point()):
            return k
    return -1


def _reflex_corners(area: MultiPolygon) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return corners where the free area turns around an obstacle, their ring neighbours, and ranges per island."""
    nodes, before, after, first = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros((0, 2))], [0]
    for part in area.geoms:
        count = 0
        for ring in _rings(part):
            c = np.asarray(ring.coords)[:-1, :2]
            prev, following = np.roll(c, 1, axis=0), np.roll(c, -1, axis=0)
            u, v = c - prev, following - c
            # a right turn with the free area on the left; at all other corners a shortest path never bends
            reflex = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0
            nodes.append(c[reflex])
            before.append(prev[reflex])
            after.append(following[reflex])
            count += int(reflex.sum())
        first.append(first[-1] + count)
    return np.concatenate(nodes), np.concatenate(before), np.concatenate(after), np.array(first, np.int64)


def _buckets(area: MultiPolygon, grown: list[Polygon], labels: list[int]) -> tuple[NDArray, float, NDArray]:
    """Return the grid over the area: origin [2], side, and the island at the middle of each bucket int32 [bx, bz]."""
    size = 0.3  # side of a bucket of blocking edges [m]
    if area.is_empty:
        return np.zeros(2), size, np.full((1, 1), -1, np.int32)
    x0, z0, x1, z1 = area.bounds
    origin = np.array([x0 - 1.137 * size, z0 - 1.171 * size])  # odd offsets keep the middles off round coordinates
    nx, nz = int((x1 - origin[0]) / size) + 2, int((z1 - origin[1]) / size) + 2
    x = origin[0] + (np.arange(nx) + 0.5) * size
    z = origin[1] + (np.arange(nz) + 0.5) * size
    label = np.full((nx, nz), -1, np.int32)
    for part, island in zip(grown, labels, strict=True):
        shapely.prepare(part)
        label[shapely.contains_xy(part, x[:, None], z[None, :])] = island
    return origin, size, label


def _all_pairs(n: int, pairs: NDArray, lengths: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int16]]:
    """Return the shortest distances [n, n] and predecessors [n, n] over the edges."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    # predecessors are stored as int16
    if n > np.iinfo(np.int16).max:
        raise SceneError(
            f"The floor has {n} corners, more than {np.iinfo(np.int16).max}. Hint: simplify the scene.",
            code="H3-SCENE-008",
        )
    if n == 0:
        return np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int16)
    matrix = csr_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    distance, previous = dijkstra(matrix, directed=False, return_predecessors=True)
    return distance.astype(np.float32), previous.astype(np.int16)
