"""Numba kernels on a walking surface, which consists of convex polygons in space that share edges.

All kernels go from polygon to polygon through shared edges. Floors may therefore lie above each other, and nothing gets
through a wall, however thin the wall or long the step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

REACH_M = np.array([2.0, 4.0, 2.0])
"""Half extents x, y, z of the box in which the nearest polygon is sought (spec/habitat.md 6.7)."""
VISITED_MAX = 256
"""Largest number of polygons that one step visits (Detour: 64, but a `FreeSpace` in triangles has more and smaller ones)."""
SEARCH_SLACK_M = 0.001
"""Distance beyond the circle around start and end in which a step searches, as Detour's moveAlongSurface [m]."""
TOUCH_M = 1e-6
"""Distance from an edge below which a point is in the polygons of both sides [m]."""
SQUARE_SLACK = 1e-9
"""Tolerance for rounding [m2] when polygons are discarded that are too far away to be nearest."""
ON_WALL_M = 1e-9
"""Distance below which a point lies on a wall [m]."""
ANGLE_EPS = 1e-9
"""Sine of the angle by which a corner may lie outside a cone of view and still be seen."""
TAUT_EPS = 1e-9
"""Cross product [m2] below which points count as collinear."""


class Surface(NamedTuple):
    """Polygons as flat arrays; corner s of polygon p: ``start[p] <= s < start[p + 1]``, counter-clockwise in (x, z)."""

    start: NDArray[np.int32]
    """First corner of each polygon, shape [P + 1]."""
    corner: NDArray[np.float64]
    """Positions of the corners (x, y, z), shape [S, 3] [m]."""
    neighbour: NDArray[np.int32]
    """Polygon across the edge from each corner to the next, -1 at a wall, shape [S]."""
    island: NDArray[np.int32]
    """Island of each polygon, shape [P]."""
    box: NDArray[np.float64]
    """Lower and upper corner of each polygon, shape [P, 6]."""
    triangle_start: NDArray[np.int32]
    """First triangle of each polygon, shape [P + 1]."""
    triangle: NDArray[np.float64]
    """Triangles of the ground under each polygon, shape [T, 3, 3] [m]."""
    climb: NDArray[np.float64]
    """Largest vertical distance between a point and a polygon that it touches, shape [1] [m]."""
    bucket_first: NDArray[np.int32]
    """First entry of each bucket, shape [bx, bz]: bucket (i, j) has the polygons
    ``bucket_polygon[bucket_first[i, j]:bucket_first[i, j] + bucket_count[i, j]]``."""
    bucket_count: NDArray[np.int32]
    bucket_polygon: NDArray[np.int32]
    bucket: NDArray[np.float64]
    """Lower corner (x, z) of bucket (0, 0) and the side of a bucket, shape [3] [m]."""
    corner_node: NDArray[np.int32]
    """Node of the path graph at each corner, -1: none, shape [S]."""
    node: NDArray[np.float64]
    """Points at which a path may bend, (x, y, z), shape [n, 3]."""
    node_polygon: NDArray[np.int32]
    """Number of a polygon that has the node as a corner, shape [n]."""
    node_side: NDArray[np.float64]
    """Wall corners (x, z) before and after each node, shape [n, 4]."""
    link_start: NDArray[np.int64]
    """First link of each node, shape [n + 1]: node i has the links ``link_start[i]:link_start[i + 1]``."""
    link_node: NDArray[np.int64]
    link_length: NDArray[np.float64]
    """Length of each link in space [m]."""


@kernel(error_model="numpy")
def _cross(ax: float, az: float, bx: float, bz: float) -> float:
    return ax * bz - az * bx


@kernel(error_model="numpy")
def contains(surface: Surface, polygon: int, x: float, z: float) -> bool:
    """Return whether a point (x, z) is in a polygon, including its border."""
    first, last = surface.start[polygon], surface.start[polygon + 1]
    ax, az = surface.corner[last - 1, 0], surface.corner[last - 1, 2]
    for s in range(first, last):
        bx, bz = surface.corner[s, 0], surface.corner[s, 2]
        if _cross(bx - ax, bz - az, x - ax, z - az) < 0.0:
            return False
        ax, az = bx, bz
    return True


@kernel(error_model="numpy")
def height(surface: Surface, polygon: int, x: float, z: float) -> float:
    """Return the height [m] of a polygon's ground at (x, z), from the triangle that contains the point best."""
    best = -np.inf
    y = surface.corner[surface.start[polygon], 1]
    triangle = surface.triangle
    for t in range(surface.triangle_start[polygon], surface.triangle_start[polygon + 1]):
        ax, az, bx, bz = triangle[t, 0, 0], triangle[t, 0, 2], triangle[t, 1, 0], triangle[t, 1, 2]
        cx, cz = triangle[t, 2, 0], triangle[t, 2, 2]
        area = _cross(bx - ax, bz - az, cx - ax, cz - az)
        if area == 0.0 or best >= 0.0:  # no break: numba then counts references for all arrays of the surface
            continue
        v = _cross(x - ax, z - az, cx - ax, cz - az) / area
        w = _cross(bx - ax, bz - az, x - ax, z - az) / area
        u = 1.0 - v - w
        inside = min(u, v, w)
        if inside > best:
            best = inside
            y = u * triangle[t, 0, 1] + v * triangle[t, 1, 1] + w * triangle[t, 2, 1]
    return y


@kernel(error_model="numpy")
def _on_segment(x: float, z: float, ax: float, az: float, bx: float, bz: float) -> float:
    """Return the position, 0 to 1, of the point on the segment a-b that is nearest to (x, z)."""
    dx, dz = bx - ax, bz - az
    square = dx * dx + dz * dz
    if square <= 0.0:
        return 0.0
    return min(max(((x - ax) * dx + (z - az) * dz) / square, 0.0), 1.0)


@kernel(error_model="numpy")
def _nearest_edge(corner: NDArray, first: int, last: int, x: float, z: float) -> tuple[float, float, float]:
    """Return (square of the distance on the floor [m2], x, z) of the point nearest to (x, z) on a polygon's border."""
    near, qx, qz = np.inf, x, z
    ax, az = corner[last - 1, 0], corner[last - 1, 2]
    for s in range(first, last):
        bx, bz = corner[s, 0], corner[s, 2]
        t = _on_segment(x, z, ax, az, bx, bz)
        ex, ez = ax + t * (bx - ax), az + t * (bz - az)
        d = (x - ex) ** 2 + (z - ez) ** 2
        if d < near:
            near, qx, qz = d, ex, ez
        ax, az = bx, bz
    return near, qx, qz


@kernel(error_model="numpy")
def _outside(value: float, low: float, high: float) -> float:
    """Return the distance of a number from an interval, 0 inside."""
    return max(low - value, value - high, 0.0)


@kernel(error_model="numpy")
def _box_square(box: NDArray, polygon: int, x: float, y: float, z: float) -> float:
    """Return square of the distance [m2] to the box of a polygon; infinity if it is outside the box of `REACH_M`."""
    dx = _outside(x, box[polygon, 0], box[polygon, 3])
    dy = _outside(y, box[polygon, 1], box[polygon, 4])
    dz = _outside(z, box[polygon, 2], box[polygon, 5])
    if dx > REACH_M[0] or dy > REACH_M[1] or dz > REACH_M[2]:
        return np.inf
    return dx * dx + dy * dy + dz * dz


@kernel(error_model="numpy")
def nearest(surface: Surface, x: float, y: float, z: float, island: int) -> tuple[int, float, float, float]:
    """Return the nearest point of the surface to a point, as (polygon, x, y, z); polygon -1 if there is none in reach.

    As in Detour's findNearestPoly, candidates are polygons whose box touches the box of `REACH_M`, points straight
    above or below count less the climb, and the first of equals is taken.

    With ``island`` >= 0 only polygons of that island count. Polygons straight below or above are tested first, then
    rings of buckets around them, as far out as a nearer one may be.
    """
    best, found, fx, fy, fz = np.inf, -1, np.nan, np.nan, np.nan
    # NaN would become any bucket: turning it into a whole number is undefined
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return found, fx, fy, fz
    rows, columns = surface.bucket_count.shape
    left, low, size = surface.bucket[0], surface.bucket[1], surface.bucket[2]
    i = int(np.floor(min(max((x - left) / size, -1.0), rows)))
    j = int(np.floor(min(max((z - low) / size, -1.0), columns)))
    if 0 <= i < rows and 0 <= j < columns:
        for k in range(surface.bucket_first[i, j], surface.bucket_first[i, j] + surface.bucket_count[i, j]):
            p = surface.bucket_polygon[k]
            if (island < 0 or surface.island[p] == island) and contains(surface, p, x, z):
                h = height(surface, p, x, z)
                # Detour: a polygon that the agent could climb to counts as touched
                d = max(abs(h - y) - surface.climb[0], 0.0) ** 2
                if d == 0.0:
                    return p, x, h, z
                if d < best and _box_square(surface.box, p, x, y, z) < np.inf:
                    best, found, fx, fy, fz = d, p, x, h, z
    for ring in range(int(REACH_M[0] / size) + 3):
        # all buckets of this ring are at least so far away
        if ring > 1 and ((ring - 1) * size) ** 2 > best + SQUARE_SLACK:
            break
        for r in range(max(i - ring, 0), min(i + ring + 1, rows)):
            gap = _outside(x, left + r * size, left + (r + 1) * size) ** 2
            for c in range(max(j - ring, 0), min(j + ring + 1, columns)):
                # the border of the square alone: what is inside came with smaller rings
                inner = max(abs(r - i), abs(c - j)) < ring
                if inner or gap + _outside(z, low + c * size, low + (c + 1) * size) ** 2 > best + SQUARE_SLACK:
                    continue
                for k in range(surface.bucket_first[r, c], surface.bucket_first[r, c] + surface.bucket_count[r, c]):
                    p = surface.bucket_polygon[k]
                    counts = island < 0 or surface.island[p] == island
                    nearer = _box_square(surface.box, p, x, y, z) < best + SQUARE_SLACK
                    if not (counts and nearer) or contains(surface, p, x, z):
                        continue
                    near, qx, qz = _nearest_edge(surface.corner, surface.start[p], surface.start[p + 1], x, z)
                    if near <= best:
                        h = height(surface, p, qx, qz)
                        d = near + (h - y) ** 2
                        # of equally near ones the first polygon, as Detour takes it, in whatever order they come
                        if d < best or (d == best and p < found):
                            best, found, fx, fy, fz = d, p, qx, h, qz
    return found, fx, fy, fz


@kernel(error_model="numpy")
def slide(
    surface: Surface, polygon: int, x: float, z: float, tx: float, tz: float, rise: float
) -> tuple[int, float, float]:
    """Return the nearest point to a target that can be reached from (x, z), as (polygon, x, z).

    It is the target itself, or a point on the walls within the circle whose diameter is the path to the target. This is
    Detour's moveAlongSurface, whose circle has the length of the path in space as diameter: a target that is ``rise``
    [m] above the floor widens it (Habitat's base action does that).
    """
    if contains(surface, polygon, tx, tz):
        return polygon, tx, tz
    visited = np.empty(VISITED_MAX, np.int32)
    visited[0] = polygon
    count = 1
    mx, mz = (x + tx) / 2, (z + tz) / 2
    # in space, as Detour: a goal above the floor lets a step search further along walls
    radius = np.sqrt((tx - x) ** 2 + (tz - z) ** 2 + rise * rise) / 2 + SEARCH_SLACK_M
    best, found, fx, fz = np.inf, polygon, x, z
    head = 0
    while head < count:
        p = visited[head]
        head += 1
        if contains(surface, p, tx, tz):
            return p, tx, tz
        first, last = surface.start[p], surface.start[p + 1]
        for s in range(first, last):
            r = s + 1 if s + 1 < last else first
            ax, az, bx, bz = surface.corner[s, 0], surface.corner[s, 2], surface.corner[r, 0], surface.corner[r, 2]
            beyond = surface.neighbour[s]
            if beyond < 0:
                t = _on_segment(tx, tz, ax, az, bx, bz)
                ex, ez = ax + t * (bx - ax), az + t * (bz - az)
                d = (tx - ex) ** 2 + (tz - ez) ** 2
                if d < best:
                    best, found, fx, fz = d, p, ex, ez
                continue
            t = _on_segment(mx, mz, ax, az, bx, bz)
            if np.hypot(mx - ax - t * (bx - ax), mz - az - t * (bz - az)) > radius or count == VISITED_MAX:
                continue
            known = False
            for k in range(count):
                known |= visited[k] == beyond
            if not known:
                visited[count] = beyond
                count += 1
    return found, fx, fz


@kernel(error_model="numpy")
def straight(surface: Surface, polygon: int, x: float, z: float, tx: float, tz: float) -> tuple[int, float, float]:
    """Return the end of a straight path from (x, z) to the target, or to the first wall, as (polygon, x, z).

    As in habitat-sim, a wall on which the path starts counts, even if the path leads away from it.
    """
    dx, dz = tx - x, tz - z
    reached = 0.0
    p = polygon
    for _ in range(len(surface.island) + 1):
        first, last = surface.start[p], surface.start[p + 1]
        leave, edge = np.inf, -1
        for s in range(first, last):
            r = s + 1 if s + 1 < last else first
            ex, ez = surface.corner[r, 0] - surface.corner[s, 0], surface.corner[r, 2] - surface.corner[s, 2]
            out = _cross(dx, dz, ex, ez)  # positive: the way goes out through this edge
            side = _cross(surface.corner[s, 0] - x, surface.corner[s, 2] - z, ex, ez)
            if p == polygon and out != 0.0 and surface.neighbour[s] < 0 and abs(side) <= ON_WALL_M * np.hypot(ex, ez):
                on = (x - surface.corner[s, 0]) * ex + (z - surface.corner[s, 2]) * ez
                if 0.0 <= on <= ex * ex + ez * ez:
                    return p, x, z
            if out <= 0.0:
                continue
            # share of the path at which it leaves through this edge
            t = side / out
            if t < leave:
                leave, edge = t, s
        if edge < 0 or leave >= 1.0:
            return p, tx, tz
        # never back: rounding may put the next edge a little before the last one
        reached = max(reached, leave)
        if surface.neighbour[edge] < 0:
            break
        p = surface.neighbour[edge]
    return p, x + reached * dx, z + reached * dz


@kernel(error_model="numpy")
def try_step(
    surface: Surface, x: float, y: float, z: float, tx: float, ty: float, tz: float, sliding: bool
) -> tuple[float, float, float]:
    """Return where a step from (x, y, z) to (tx, ty, tz) ends: PathFinder::tryStep of habitat-sim (spec/habitat.md 1.3)."""
    p, nx, ny, nz = nearest(surface, x, y, z, -1)
    q = nearest(surface, tx, ty, tz, -1)[0]
    # as in habitat-sim, also where the goal is off the navmesh: the step does not happen
    if p < 0 or q < 0 or surface.island[p] != surface.island[q]:
        return x, y, z
    if sliding:
        last, fx, fz = slide(surface, p, nx, nz, tx, tz, ty - ny)
    else:
        last, fx, fz = straight(surface, p, nx, nz, tx, tz)
    fy = height(surface, last, fx, fz)
    other = nearest(surface, fx, fy, fz, -1)[0]
    if other < 0 or surface.island[other] != surface.island[p]:  # on an edge of another island: 0.1 mm into ours
        first, after = surface.start[last], surface.start[last + 1]
        mx, mz = surface.corner[first:after, 0].mean() - fx, surface.corner[first:after, 2].mean() - fz
        length = np.hypot(mx, mz)
        if length > 0.0:
            fx += 1e-4 * mx / length
            fz += 1e-4 * mz / length
    return fx, fy, fz


@kernel(error_model="numpy")
def wall(surface: Surface, polygon: int, x: float, z: float, radius: float) -> tuple[float, NDArray]:
    """Return the distance [m] on the floor to the nearest wall that is reached without crossing another, and its point [3].

    They are ``radius`` and NaN if there is none within ``radius``. This is Detour's findDistanceToWall.
    """
    hit = np.full(3, np.nan)
    seen = np.zeros(len(surface.island), np.bool_)
    stack = np.empty(len(surface.island), np.int32)
    stack[0] = polygon
    seen[polygon] = True
    top = 1
    best = radius
    while top > 0:
        top -= 1
        p = stack[top]
        first, last = surface.start[p], surface.start[p + 1]
        for s in range(first, last):
            r = s + 1 if s + 1 < last else first
            a, b = surface.corner[s], surface.corner[r]
            t = _on_segment(x, z, a[0], a[2], b[0], b[2])
            d = np.hypot(x - a[0] - t * (b[0] - a[0]), z - a[2] - t * (b[2] - a[2]))
            if d > best:
                continue
            beyond = surface.neighbour[s]
            if beyond >= 0:
                if not seen[beyond]:
                    seen[beyond] = True
                    stack[top] = beyond
                    top += 1
            # a wall at exactly the search radius is found too
            elif d < best or np.isnan(hit[0]):
                best = d
                for k in range(3):
                    hit[k] = a[k] + t * (b[k] - a[k])
    return best, hit


@kernel(error_model="numpy")
def navigable(surface: Surface, x: float, y: float, z: float, delta: float) -> int:
    """Return the polygon of a point, at most ``delta`` [m] above or below and 1 cm beside it; -1 if there is none."""
    p, nx, ny, nz = nearest(surface, x, y, z, -1)
    if p < 0 or abs(ny - y) > delta or np.hypot(nx - x, nz - z) > 1e-2:
        return -1
    return p


@kernel(error_model="numpy")
def island_map(surface: Surface, x0: float, z0: float, step: float, y: float, delta: float, out: NDArray) -> None:
    """Fill int32 [rows, columns] with the islands at the points (x0 + column * step, y, z0 + row * step), -1 for none."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            p = navigable(surface, x0 + j * step, y, z0 + i * step, delta)
            out[i, j] = surface.island[p] if p >= 0 else -1
