"""Habitat's ``.navmesh`` files: Detour tiles behind a small header, little endian (layout: spec/habitat.md 6.7)."""

from __future__ import annotations

import struct
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data_habitat.navmesh.navmesh import NavMesh, NavMeshSettings

SET_MAGIC = 0x4D534554
TILE_MAGIC = 0x444E4156
SET_VERSIONS = (1, 2)
"""Versions of the file that can be read; version 2, which Habitat writes, has the settings."""
TILE_VERSION = 7
BYTES_MAX = 1 << 30
"""Largest size of a file [bytes]; real files have some kilobytes."""
COORDINATE_MAX = 1e6
"""Largest coordinate [m]; larger values indicate damage, and would overflow in products."""
OFF_MESH = 1
"""Type of polygons that represent a jump link, which Habitat does not write."""
EXTERNAL = 0x8000
"""Bit of a neighbour that lies in another tile."""
EDGE_BOUNDARY = 1
"""Bits of detail triangles, two per edge, that mark edges on the border of their polygon."""

_VERTEX = np.dtype("<f4")
_POLYGON = np.dtype(
    [
        ("link", "<u4"),
        ("vertices", "<u2", 6),
        ("neighbours", "<u2", 6),
        ("flags", "<u2"),
        ("count", "u1"),
        ("kind", "u1"),
    ]
)
_DETAIL = np.dtype([("vertex", "<u4"), ("triangle", "<u4"), ("vertices", "u1"), ("triangles", "u1"), ("pad", "<u2")])
_HEADER = np.dtype(
    [(n, "<i4") for n in ("magic", "version", "x", "y", "layer", "user")]
    + [(n, "<i4") for n in ("polygons", "vertices", "links", "details", "detail_vertices", "detail_triangles")]
    + [(n, "<i4") for n in ("tree_nodes", "off_mesh", "off_mesh_base")]
    + [("height", "<f4"), ("radius", "<f4"), ("climb", "<f4"), ("bounds", "<f4", (2, 3)), ("quantum", "<f4")]
)


class _Cursor:
    """Forward reader of bytes, which never requests more than there are."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.offset = data, path, 0

    def array(self, dtype: np.dtype | str, count: int, what: str) -> NDArray:
        kind = np.dtype(dtype)
        # compared by division: the product of a damaged count would be as large as it likes
        if count < 0 or count > (len(self.data) - self.offset) // kind.itemsize:
            raise self.error(
                f"Expected {count} {what} of {kind.itemsize} bytes, but {len(self.data) - self.offset} bytes are left",
                self.offset,
            )
        found = np.frombuffer(self.data, kind, count, self.offset)
        self.offset += count * kind.itemsize
        return found

    def error(self, message: str, offset: int) -> FormatError:
        return FormatError(f"{message} (at byte {offset}): {self.path}", code="H3-HABITAT-088")


def read_navmesh(path: str | Path) -> NavMesh:
    """Return the navmesh in a Habitat ``.navmesh`` file (versions 1 and 2, one Detour tile)."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > BYTES_MAX:
            raise FormatError(
                f"A navmesh has at most {BYTES_MAX} bytes, this file has {size}: {path}", code="H3-HABITAT-090"
            )
        cursor = _Cursor(path.read_bytes(), path)
    except OSError as error:
        raise InputError(f"Cannot read the navmesh ({error.strerror}): {path}", code="H3-HABITAT-091") from error
    settings = _read_set_header(cursor)
    header, end = _read_tile_header(cursor)
    mesh = _read_tile(cursor, header, settings)
    if cursor.offset > end:
        raise cursor.error(f"The parts of the tile take {cursor.offset - end} bytes more than its size says", end)
    return mesh


def _read_set_header(cursor: _Cursor) -> NavMeshSettings | None:
    magic = int(cursor.array("<i4", 1, "magic numbers")[0])
    if magic != SET_MAGIC:
        # the same number from a machine of the other byte order
        swapped = magic == int.from_bytes(SET_MAGIC.to_bytes(4, "little"), "big")
        hint = "written big-endian" if swapped else "is it a .navmesh of habitat-sim?"
        raise cursor.error(f"Expected the magic number 0x{SET_MAGIC:08X}, got 0x{magic & 0xFFFFFFFF:08X}: {hint}", 0)
    version, tiles = (int(v) for v in cursor.array("<i4", 2, "header fields"))
    if version not in SET_VERSIONS:
        raise cursor.error(f"Expected navmesh version 1 or 2, got {version}", 4)
    if tiles != 1:
        raise cursor.error(f"Expected one tile, as habitat-sim writes, got {tiles}", 8)
    # origin and size of the tile, which follow from its bounds
    cursor.array("<f4", 7, "tile parameters")
    if version == 1:
        return None
    at = cursor.offset
    # in the order of the fields of `NavMeshSettings`: the floats first, then the switches of one byte each
    numbers = [float(v) for v in cursor.array("<f4", 13, "settings")]
    switches = [bool(v) for v in cursor.array("u1", 4, "settings")]
    if not (np.abs(numbers) <= COORDINATE_MAX).all() or numbers[3] < 0 or numbers[2] <= 0:
        raise cursor.error(f"Expected finite settings and a positive agent, got {numbers}", at)
    names = NavMeshSettings.__dataclass_fields__
    values: dict[str, Any] = dict(zip(names, [*numbers, *switches], strict=True))
    return NavMeshSettings(**values)


def _read_tile_header(cursor: _Cursor) -> tuple[np.void, int]:
    cursor.array("<u4", 1, "tile references")
    at = cursor.offset
    size = int(cursor.array("<i4", 1, "tile sizes")[0])
    if not _HEADER.itemsize <= size <= len(cursor.data) - cursor.offset:
        raise cursor.error(f"The tile claims {size} bytes, but {len(cursor.data) - cursor.offset} are left", at)
    at = cursor.offset
    header = cursor.array(_HEADER, 1, "tile headers")[0]
    if header["magic"] != TILE_MAGIC or header["version"] != TILE_VERSION:
        raise cursor.error(
            f"Expected a Detour tile 0x{TILE_MAGIC:08X} of version {TILE_VERSION}, "
            f"got 0x{int(header['magic']) & 0xFFFFFFFF:08X}, version {header['version']}",
            at,
        )
    if header["details"] > header["polygons"]:
        raise cursor.error(f"{header['details']} detail meshes for {header['polygons']} polygons", at)
    numbers = [header["height"], header["radius"], header["climb"], *header["bounds"].flat]
    if not (np.abs(numbers) <= COORDINATE_MAX).all():
        raise cursor.error(f"Expected finite sizes and bounds in the tile header, got {np.array(numbers)}", at)
    if (header["bounds"][0] > header["bounds"][1]).any():
        raise cursor.error(f"Expected bounds from the lower to the upper corner, got {header['bounds'].tolist()}", at)
    return header, at + size


def _read_tile(cursor: _Cursor, header: np.void, settings: NavMeshSettings | None) -> NavMesh:
    vertices = _finite(cursor, int(header["vertices"]), "vertices")
    polygons_at = cursor.offset
    polygons = cursor.array(_POLYGON, int(header["polygons"]), "polygons")
    cursor.array("V12", int(header["links"]), "links")  # rebuilt from the neighbours by Detour when it loads
    details_at = cursor.offset
    details = cursor.array(_DETAIL, int(header["details"]), "detail meshes")
    detail_vertices = _finite(cursor, int(header["detail_vertices"]), "detail vertices")
    triangles_at = cursor.offset
    triangles = cursor.array("u1", 4 * int(header["detail_triangles"]), "detail triangle indices").reshape(-1, 4)
    cursor.array("V16", int(header["tree_nodes"]), "tree nodes")
    cursor.array("V36", int(header["off_mesh"]), "jump links")

    # the upper two bits are the type of the polygon, the lower six its area
    ground = np.flatnonzero(polygons["kind"] >> 6 != OFF_MESH)
    if not len(ground):
        raise cursor.error("Expected at least one polygon, got none", polygons_at)
    # polygons of the ground come first in a tile, so that detail mesh k is that of polygon k
    if len(ground) > len(details) or (ground != np.arange(len(ground))).any():
        raise cursor.error(f"Expected a detail mesh for each of {len(ground)} polygons, got {len(details)}", details_at)
    start, corner, neighbour = _read_polygons(cursor, polygons[: len(ground)], len(vertices), polygons_at)
    detail_start, detail = _read_details(
        cursor, details[: len(ground)], vertices, corner, start, detail_vertices, triangles, (details_at, triangles_at)
    )
    return NavMesh(
        settings=settings
        or NavMeshSettings(
            agent_height=float(header["height"]),
            agent_radius=float(header["radius"]),
            agent_max_climb=float(header["climb"]),
        ),
        vertices=vertices,
        polygon_start=start,
        polygon_vertices=corner,
        polygon_neighbours=neighbour,
        areas=(polygons["kind"][: len(ground)] & 0x3F).astype(np.uint8),
        flags=polygons["flags"][: len(ground)].astype(np.uint16),
        detail_start=detail_start,
        detail_triangles=detail,
        bounds=np.array(header["bounds"], np.float32),
    )


def _finite(cursor: _Cursor, count: int, what: str) -> NDArray[np.float32]:
    """Return points [count, 3], refused unless all are finite and within reach."""
    at = cursor.offset
    if count > len(cursor.data):  # before the product below can grow
        raise cursor.error(f"Expected {count} {what}, but the file has {len(cursor.data)} bytes", at)
    points = cursor.array(_VERTEX, 3 * count, f"coordinates of {what}").reshape(-1, 3).astype(np.float32)
    # not greater than: for NaN every comparison is false
    wrong = np.flatnonzero(~(np.abs(points) <= COORDINATE_MAX).all(1))
    if len(wrong):
        k = int(wrong[0])
        raise cursor.error(
            f"Expected coordinates below {COORDINATE_MAX:g} m, got {points[k]} of {what} {k}", at + 12 * k
        )
    return points


def _read_polygons(
    cursor: _Cursor, polygons: NDArray, vertex_count: int, at: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return the ragged corners (start [P + 1], vertex [S], neighbour [S]) of the polygons, every index checked."""

    def refuse(wrong: NDArray[np.bool_], what: str) -> None:
        if wrong.any():
            p = int(np.flatnonzero(wrong.reshape(len(polygons), -1).any(1))[0])
            raise cursor.error(f"Polygon {p} {what}; it is {polygons[p]}", at + p * _POLYGON.itemsize)

    count = polygons["count"].astype(np.int32)
    refuse((count < 3) | (count > 6), "must have 3 to 6 corners")
    used = np.arange(6) < count[:, None]
    vertices, neighbours = polygons["vertices"].astype(np.int32), polygons["neighbours"].astype(np.int32)
    refuse(used & (vertices >= vertex_count), f"names a vertex beyond the {vertex_count} there are")
    outside = neighbours & EXTERNAL != 0  # Recast's border edges of a tile: with one tile, walls
    refuse(used & ~outside & (neighbours > len(polygons)), f"names a neighbour beyond the {len(polygons)} there are")
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    # the file counts neighbours from 1, and 0 is a wall
    corner, neighbour = vertices[used], np.where(outside, 0, neighbours)[used] - 1
    owner = np.repeat(np.arange(len(polygons)), count)
    last = np.arange(len(corner)) == start[owner + 1] - 1
    following = corner[np.where(last, start[owner], np.arange(len(corner)) + 1)]
    # every inner edge must be there from both sides: paths go through it either way
    known = set(zip(owner.tolist(), corner.tolist(), following.tolist(), strict=True))
    back = zip(neighbour.tolist(), following.tolist(), corner.tolist(), strict=True)
    lonely = np.array([n >= 0 and (n, a, b) not in known for n, a, b in back])
    wrong = np.zeros(len(polygons), bool)
    wrong[owner[lonely]] = True
    refuse(wrong, "names a neighbour that does not share the edge")
    return start, corner.astype(np.int32), neighbour.astype(np.int32)


def _read_details(
    cursor: _Cursor,
    details: NDArray,
    vertices: NDArray,
    corner: NDArray[np.int32],
    start: NDArray[np.int32],
    detail_vertices: NDArray,
    triangles: NDArray[np.uint8],
    at: tuple[int, int],
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return ragged detail triangles (start [P + 1], corners [T, 3, 3]).

    An index below the number of corners means a corner.
    """
    base, extra = details["vertex"].astype(np.int64), details["vertices"].astype(np.int64)
    first, count = details["triangle"].astype(np.int64), details["triangles"].astype(np.int64)
    beyond = (base + extra > len(detail_vertices)) | (first + count > len(triangles))
    if beyond.any():
        p = int(np.flatnonzero(beyond)[0])
        raise cursor.error(
            f"Detail mesh {p} names vertices or triangles beyond the {len(detail_vertices)} and {len(triangles)} there are",
            at[0] + p * _DETAIL.itemsize,
        )
    owner = np.repeat(np.arange(len(details)), count)
    detail_start = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
    row = first[owner] + np.arange(len(owner)) - detail_start[owner]
    index = triangles[row, :3].astype(np.int64)
    corners = np.diff(start)[owner][:, None]
    wrong = np.flatnonzero((index >= corners + extra[owner][:, None]).any(1))
    if len(wrong):
        k = int(wrong[0])
        raise cursor.error(
            f"Detail triangle {row[k]} names a vertex beyond those of polygon {owner[k]}", at[1] + 4 * int(row[k])
        )
    # corners of polygons first, then the additional vertices, so that both have one index
    pool = np.concatenate([vertices[corner], detail_vertices])
    own = start[:-1][owner][:, None] + index
    other = len(corner) + base[owner][:, None] + index - corners
    return detail_start, pool[np.where(index < corners, own, other)].reshape(-1, 3, 3)


def write_navmesh(navmesh: NavMesh, path: str | Path) -> None:
    """Write a ``.navmesh`` of version 2 with one Detour tile, which habitat-sim loads.

    Raises:
        InputError: The navmesh is too large for one tile.
    """
    Path(path).write_bytes(navmesh_bytes(navmesh))


def navmesh_bytes(navmesh: NavMesh) -> bytes:
    """Return the content of a ``.navmesh`` file; raises as `write_navmesh`.

    Links and the search tree are left out: Detour builds the links itself and works without the tree.
    """
    count = np.diff(navmesh.polygon_start)
    if len(navmesh.vertices) > 0xFFFE or len(count) > 0x7FFE or count.max(initial=0) > 6:
        raise InputError(
            "A Detour tile holds 65534 vertices and 32766 polygons of up to 6 corners, "
            f"got {len(navmesh.vertices)} and {len(count)} of up to {count.max(initial=0)}.",
            code="H3-HABITAT-089",
        )
    polygons = np.zeros(len(count), _POLYGON)
    used = np.arange(6) < count[:, None]
    polygons["vertices"][used] = navmesh.polygon_vertices
    polygons["neighbours"][used] = navmesh.polygon_neighbours + 1
    polygons["flags"], polygons["count"], polygons["kind"] = navmesh.flags, count, navmesh.areas & 0x3F
    # no link yet: Detour makes them when it adds the tile
    polygons["link"] = 0xFFFFFFFF
    details, detail_vertices, triangles = _detail_sections(navmesh)
    settings = navmesh.settings
    header = np.zeros((), _HEADER)
    sizes = (len(polygons), len(navmesh.vertices), int((navmesh.polygon_neighbours >= 0).sum()), len(details))
    header["magic"], header["version"], header["off_mesh_base"] = TILE_MAGIC, TILE_VERSION, len(polygons)
    header["polygons"], header["vertices"], header["links"], header["details"] = sizes
    header["detail_vertices"], header["detail_triangles"] = len(detail_vertices), len(triangles)
    header["height"], header["radius"], header["climb"] = (
        settings.agent_height,
        settings.agent_radius,
        settings.agent_max_climb,
    )
    header["bounds"], header["quantum"] = navmesh.bounds, 1.0 / settings.cell_size
    # in the order in which Detour reads them; the links are zeros, since it builds them itself
    parts = [header.tobytes(), navmesh.vertices.astype("<f4").tobytes(), polygons.tobytes(), bytes(12 * sizes[2])]
    parts += [details.tobytes(), detail_vertices.astype("<f4").tobytes(), triangles.tobytes()]
    tile = b"".join(parts)
    low, high = navmesh.bounds.astype(float)
    values = astuple(settings)
    head = struct.pack("<3i5f2i", SET_MAGIC, 2, 1, *low, high[0] - low[0], high[2] - low[2], 1, len(polygons))
    head += struct.pack("<13f4B", *values) + struct.pack("<Ii", _tile_reference(len(polygons)), len(tile))
    return head + tile


def _tile_reference(polygon_count: int) -> int:
    """Return the reference of tile 0, salt 1.

    Polygons take the lowest bits, as Detour packs salt, tile and polygon from the top.
    """
    return 1 << max(int(np.ceil(np.log2(max(polygon_count, 1)))), 0)


def _detail_sections(navmesh: NavMesh) -> tuple[NDArray, NDArray[np.float32], NDArray[np.uint8]]:
    """Return detail meshes, their additional vertices [D, 3], and triangles [T, 4] (indices and border bits)."""
    details = np.zeros(len(navmesh.flags), _DETAIL)
    extra: list[tuple[float, ...]] = []
    rows = []
    for p in range(len(details)):
        # reversed, so that of equal corners the first one counts
        own = {tuple(c): k for k, c in reversed(list(enumerate(navmesh.corners(p).tolist())))}
        corners, base = len(navmesh.corners(p)), len(extra)
        mine = navmesh.detail_triangles[navmesh.detail_start[p] : navmesh.detail_start[p + 1]]
        table = []
        for triangle in mine.tolist():
            for point in map(tuple, triangle):
                if point not in own:
                    own[point] = corners + len(extra) - base
                    extra.append(point)
            table.append([own[tuple(point)] for point in triangle])
        # a side that one triangle alone has lies on the border of the polygon
        sides = [frozenset((t[i], t[(i + 1) % 3])) for t in table for i in range(3)]
        for t, triangle in enumerate(table):
            rows.append(
                [*triangle, sum(EDGE_BOUNDARY << 2 * i for i in range(3) if sides.count(sides[3 * t + i]) == 1)]
            )
        if len(extra) - base + corners > 255 or len(mine) > 255:
            raise InputError(
                f"A Detour polygon holds 255 detail vertices and triangles; polygon {p} has more.",
                code="H3-HABITAT-092",
            )
        details[p] = (base, len(rows) - len(mine), len(extra) - base, len(mine), 0)
    return details, np.array(extra, np.float32).reshape(-1, 3), np.array(rows, np.uint8).reshape(-1, 4)
