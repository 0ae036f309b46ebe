"""Reduction of a navmesh's polygons by joining neighbours in one plane while they stay convex, as Recast does.

habitat-sim's ``findPath`` gives up after 256 polygons and searches at most 2,048 nodes, so a large home in thousands of
triangles has pairs of points without a path there.
"""

from __future__ import annotations

import heapq

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

CORNERS_MAX = 6
"""Largest number of corners of a Detour polygon (``DT_VERTS_PER_POLYGON``)."""
OUTLINE_M = 0.03
"""Distance by which outlines may move [m]: a corner of an obstacle is rounded by a dozen points, and Recast's voxels
are 0.05 m wide."""
_STRAIGHT = 1e-9


def plain_outline(area: MultiPolygon) -> MultiPolygon:
    """Return the area with fewer points on its outlines, each within `OUTLINE_M` of them; parts and their order stay."""
    parts = []
    for part in area.geoms:
        plain = part.simplify(OUTLINE_M, preserve_topology=True)
        # a part that falls apart or vanishes keeps its outline
        parts.append(plain if isinstance(plain, Polygon) and plain.is_valid and plain.area > 0 else part)
    if shapely.union_all(parts).area < sum(part.area for part in parts) - 1e-6:
        return area  # parts that nearly touch have come to overlap
    return MultiPolygon(parts)


def merged_polygons(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> list[list[int]]:
    """Merge triangles into convex polygons of at most `CORNERS_MAX` corners, as lists of vertices.

    The method is greedy, longest shared edge first, as in Recast's ``mergePolyMeshPolys``.

    Args:
        points: Vertices on the floor (x, z), shape [V, 2].
        triangles: Vertex indices of the triangles, shape [M, 3], all with the same orientation.
    """
    polygons: dict[int, list[int]] = dict(enumerate(triangles.tolist()))
    sides: dict[tuple[int, int], int] = {}  # directed edge -> its polygon
    heap: list[tuple[float, int, int]] = []
    turn = np.sign(_cross(points, triangles[0])) if len(triangles) else 1.0

    def enter(key: int) -> None:
        corners = polygons[key]
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            sides[a, b] = key
            if (b, a) in sides:
                heapq.heappush(heap, (-float(np.hypot(*(points[a] - points[b]))), min(a, b), max(a, b)))

    for key in list(polygons):
        enter(key)
    while heap:
        _, a, b = heapq.heappop(heap)
        # edges of the heap may be gone by now: their polygons were joined over another one
        one, other = sides.get((a, b), -1), sides.get((b, a), -1)
        if one < 0 or other < 0 or one == other:
            continue
        joined = _joined(polygons[one], polygons[other], a, b)
        if len(joined) > CORNERS_MAX or not _convex(points, joined, turn):
            continue
        # the other directed edges keep their entries, which `enter` sets to the joined polygon
        del polygons[other], sides[a, b], sides[b, a]
        polygons[one] = joined
        enter(one)
    return list(polygons.values())


def _joined(one: list[int], other: list[int], a: int, b: int) -> list[int]:
    """Return the outline of two polygons that share the edge a-b: one runs it from a to b, the other from b to a."""
    i, j = one.index(b), other.index(a)
    return (one[i:] + one[:i])[:-1] + (other[j:] + other[:j])[:-1]


def _convex(points: NDArray[np.float64], corners: list[int], turn: float) -> bool:
    # two polygons that share more than one edge would touch themselves
    if len(set(corners)) < len(corners):
        return False
    following = corners[1:] + corners[:1]
    after = following[1:] + following[:1]
    return all(_cross(points, c) * turn > _STRAIGHT for c in zip(corners, following, after, strict=True))


def _cross(points: NDArray[np.float64], corner: tuple[int, int, int] | NDArray[np.int32]) -> float:
    (ax, az), (bx, bz), (cx, cz) = points[corner[0]], points[corner[1]], points[corner[2]]
    return float((bx - ax) * (cz - bz) - (bz - az) * (cx - bx))
