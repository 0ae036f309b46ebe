"""Reader of ProcTHOR houses (JSON) as scenes of boxes, for navigation and crowds but not for pictures.

A house refers to assets of Unity, whose meshes are not in the file. Boxes have the sizes in an asset database: a JSON
file called ``asset-database.json`` next to the house or in an asset folder, with ``assetId`` and ``boundingBox`` of
each asset. Fields are those of the schema `SCHEMA`: ``rooms``, ``walls``, ``doors``, ``windows``, ``objects``.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, SceneError
from h3data.geometry import ground_pose, pose_from_matrix, quat_rotate
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh
from h3data.progress import say
from h3data.scene.records import Asset, Box, Instance, Room, Scene
from h3data.scene.sources import SceneFile, SceneReader

DATABASE = "asset-database.json"
BYTES_MAX = 64_000_000
"""Largest size of a file that is read [bytes]."""
BOXES_MAX = 50_000
WALL_M = 0.06
"""Thickness of walls, which the file does not state [m]."""
FLAT_M = 0.03
"""Height below which objects such as rugs have no collision shapes [m]."""
SCHEMA = "1.0.0"
PLACE_MAX_M = 300.0
"""Greatest coordinate of objects in a house [m]."""
_FLOOR, _WALL, _THING = (205, 203, 198), (232, 230, 226), (176, 160, 140)
_UPRIGHT = np.array([0, 0, 0, 0, 0, 0, 1.0])


class _Point(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _RoomRecord(msgspec.Struct, rename="camel"):
    id: str
    floor_polygon: list[_Point]
    room_type: str = "room"


class _WallRecord(msgspec.Struct):
    id: str
    polygon: list[_Point]


class _Opening(msgspec.Struct, rename="camel"):
    wall0: str
    hole_polygon: list[_Point]
    wall1: str | None = None


class _Thing(msgspec.Struct, rename="camel"):
    id: str
    asset_id: str
    position: _Point
    rotation: _Point = msgspec.field(default_factory=_Point)
    kinematic: bool = False
    children: list[_Thing] = []


class _House(msgspec.Struct):
    rooms: list[_RoomRecord]
    walls: list[_WallRecord]
    objects: list[_Thing]
    doors: list[_Opening] = []
    windows: list[_Opening] = []
    metadata: Any = None


def read_house(file: SceneFile) -> Scene:
    """Read a house, mirrored along z from Unity's left-handed frame to the right-handed world.

    All doors are open holes without leaves. Windows are holes above their sills.

    Raises:
        FormatError: the file is damaged, is not a house, or is too large.
        SceneError: sizes of assets are missing, and ``file.allow_missing`` is false.
    """
    path = Path(file.path)
    house: _House = _decoded(path, _House)
    sizes = _sizes([path.parent, *map(Path, file.assets)])
    things = list(_all_things(house.objects))
    if len(things) + len(house.walls) + len(house.doors) + len(house.windows) > BOXES_MAX:
        raise FormatError(
            f"The house has more than {BOXES_MAX} walls, openings and objects: {path}", code="H3-WORLD-020"
        )
    unknown = sorted({thing.asset_id for thing in things if thing.asset_id not in sizes})
    if unknown and (file.strict or not file.allow_missing):
        raise SceneError(
            f"The size of {len(unknown)} assets is not known ({', '.join(unknown[:4])}). Hint: put {DATABASE} beside the house "
            f"or into a folder of --assets, or leave them out with --allow-missing: {path}",
            code="H3-WORLD-021",
        )
    doubts = _doubts(house)
    if file.strict and doubts:
        raise SceneError(
            f"Not all of the house is read as it is meant: {'; '.join(doubts)}. File: {path}", code="H3-WORLD-029"
        )
    if unknown:
        doubts.append(f"{len(unknown)} assets without a size are left out: {', '.join(unknown[:4])}")
    if doubts:
        say(f"{path.name}: {'; '.join(doubts)}")
    rooms = tuple(
        Room(name=_name(room.id), category=_words(room.room_type), rectangles=_rectangles(_plan(room.floor_polygon)))
        for room in house.rooms
    )
    if not any(len(room.rectangles) for room in rooms):
        raise FormatError(f"The house has no room with a floor: {path}", code="H3-WORLD-022")
    assets, instances = _building(house, rooms)
    for thing in things:
        if thing.asset_id in sizes:
            half = sizes[thing.asset_id] / 2
            shapes = (Box(pose=_UPRIGHT, half_extents=half),) if 2 * half[1] >= FLAT_M else ()
            assets.setdefault(
                thing.asset_id,
                Asset(
                    name=thing.asset_id,
                    mesh=box_mesh(half, color=_THING),
                    category=_words(thing.id.partition("|")[0]),
                    shapes=shapes,
                ),
            )
            name, pose = _name(thing.id), _pose(thing)
            motion = "static" if thing.kinematic else "kinematic"
            instances.append(Instance(name=name, asset=thing.asset_id, pose=pose, motion=motion))
    if len({one.name for one in instances}) < len(instances):
        raise FormatError(f"Two walls or objects of the house have one id: {path}", code="H3-WORLD-023")
    source = {"kind": "procthor", "name": path.stem}
    return Scene(name=path.stem, assets=assets, instances=tuple(instances), rooms=rooms, source=source)


def _doubts(house: _House) -> list[str]:
    """Return parts of a house that are not read as they are meant, in words."""
    schema = house.metadata.get("schema", SCHEMA) if isinstance(house.metadata, dict) else SCHEMA
    doubts = [] if schema == SCHEMA else [f"its schema is {str(schema)[:20]!r} and read as {SCHEMA}"]
    walls = {wall.id for wall in house.walls if len(wall.polygon) >= 3}
    if lost := sum(one.wall0 not in walls or len(one.hole_polygon) < 2 for one in (*house.doors, *house.windows)):
        doubts.append(f"{lost} doors and windows without a wall or a hole are left out")
    plans = [(room.id, _plan(room.floor_polygon)) for room in house.rooms]
    sides = [(name, np.abs(np.roll(plan, -1, axis=0) - plan).min(axis=1)) for name, plan in plans]
    if slanting := [name for name, across in sides if (across > 1e-3).any()]:
        doubts.append(f"rooms with slanting sides become rectangles: {', '.join(slanting[:4])}")
    return doubts


def _decoded(path: Path, kind: Any) -> Any:
    try:
        if path.stat().st_size > BYTES_MAX:
            raise FormatError(
                f"The file has more than {BYTES_MAX // 10**6} MB, too many for a house: {path}", code="H3-WORLD-027"
            )
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.MsgspecError, OSError, ValueError, RecursionError) as fault:
        raise FormatError(
            f"Expected a house of ProcTHOR or {DATABASE}, got: {fault} File: {path}", code="H3-WORLD-028"
        ) from None


def _is_house(path: Path) -> bool:
    """Return whether a JSON file has the tables of a house."""
    try:
        if path.stat().st_size > BYTES_MAX:
            return False
        found = msgspec.json.decode(path.read_bytes())
    except (OSError, msgspec.MsgspecError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and all(isinstance(found.get(key), list) for key in ("rooms", "walls", "objects"))


def _sizes(folders: Sequence[Path]) -> dict[str, NDArray[np.float64]]:
    """Return the sizes x, y, z [m] of assets, of the first database that has them."""
    found: dict[str, NDArray[np.float64]] = {}
    for folder in folders:
        if (folder / DATABASE).is_file():
            for entry in _entries(_decoded(folder / DATABASE, Any)):
                box = entry["boundingBox"]
                size = np.array([box.get(axis, math.nan) for axis in "xyz"], np.float64)
                if (np.isfinite(size) & (size > 0) & (size < PLACE_MAX_M)).all():
                    found.setdefault(str(entry["assetId"]), size)
    return found


def _entries(document: Any) -> Iterator[Mapping[str, Any]]:
    """Yield the records with an id and a box, in whatever lists and tables they are."""
    left = [document]
    while left:
        one = left.pop()
        if isinstance(one, dict) and "assetId" in one and isinstance(one.get("boundingBox"), dict):
            box = one["boundingBox"]
            if all(isinstance(value, int | float) for value in box.values()):
                yield one
        elif isinstance(one, dict | list):
            left += one.values() if isinstance(one, dict) else one


def _all_things(things: Sequence[_Thing]) -> Iterator[_Thing]:
    """Yield objects and those on and in them; all are in the frame of the house."""
    for thing in things:
        yield thing
        yield from _all_things(thing.children)


def _plan(points: Sequence[_Point]) -> NDArray[np.float64]:
    """Return the (x, z) of points in our frame [N, 2]."""
    found = np.array([(p.x, -p.z) for p in points], np.float64).reshape(-1, 2)
    if not (np.abs(found) < PLACE_MAX_M).all():
        raise FormatError(f"Expected coordinates of a house in metres, got {found[0].tolist()}.", code="H3-WORLD-024")
    return found


def _rectangles(polygon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rectangles ``x0 z0 x1 z1`` [R, 4] that cover a polygon of right angles [N, 2].

    The lines through its corners cut it into cells; cells beside each other in x become one rectangle.
    """
    xs, zs = (np.unique(polygon[:, k].round(6)) for k in (0, 1))
    found: list[list[float]] = []
    for z0, z1 in itertools.pairwise(zs):
        start = len(found)
        for x0, x1 in itertools.pairwise(xs):
            if not _is_inside(polygon, (x0 + x1) / 2, (z0 + z1) / 2):
                continue
            if len(found) > start and found[-1][2] == x0:
                found[-1][2] = float(x1)
            else:
                found.append([float(x0), float(z0), float(x1), float(z1)])
    return np.array(found, np.float64).reshape(-1, 4)


def _is_inside(polygon: NDArray[np.float64], x: float, z: float) -> bool:
    """Return whether a ray from a point crosses the outline an odd number of times."""
    ahead = np.roll(polygon, -1, axis=0)
    crosses = (polygon[:, 1] > z) != (ahead[:, 1] > z)
    one, other = polygon[crosses], ahead[crosses]
    at = one[:, 0] + (z - one[:, 1]) / (other[:, 1] - one[:, 1]) * (other[:, 0] - one[:, 0])
    return bool((at > x).sum() % 2)


def _building(house: _House, rooms: Sequence[Room]) -> tuple[dict[str, Asset], list[Instance]]:
    """Return floors, and walls with the holes of doors and windows."""
    assets: dict[str, Asset] = {}
    instances: list[Instance] = []

    def put(name: str, category: str, boxes: Sequence[Box], color: Sequence[int], *, solid: bool) -> None:
        if boxes:
            shapes = tuple(boxes) if solid else ()
            assets[name] = Asset(name=name, mesh=_mesh_of(boxes, color), category=category, shapes=shapes)
            instances.append(Instance(name=name, asset=name, pose=_UPRIGHT, layer=category))

    for room in rooms:
        floor = [
            Box(
                pose=np.array([(x0 + x1) / 2, -0.01, (z0 + z1) / 2, 0, 0, 0, 1]),
                half_extents=np.array([(x1 - x0) / 2, 0.01, (z1 - z0) / 2]),
            )
            for x0, z0, x1, z1 in room.rectangles.tolist()
        ]
        put(f"floor_{room.name}", "floor", floor, _FLOOR, solid=False)
    walls = {wall.id: _ends(wall) for wall in house.walls if len(wall.polygon) >= 3}
    holes = [hole for one in (*house.doors, *house.windows) for hole in _holes(one, walls)]
    for name, (one, other, low, high) in walls.items():
        along = other - one
        length = float(np.hypot(*along))
        if length < 1e-6 or high <= low:
            continue
        boxes = [
            _wall_box(one, along / length, piece) for piece in _pieces(one, along / length, length, low, high, holes)
        ]
        put(_name(name), "wall", boxes, _WALL, solid=True)
    return assets, instances


def _ends(wall: _WallRecord) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Return the two ends (x, z) of a wall, in the order of its lower corners, and its lower and upper height [m]."""
    heights = np.array([point.y for point in wall.polygon])
    if not (np.abs(heights) < PLACE_MAX_M).all():
        raise FormatError(
            f"Expected heights of the wall {wall.id!r} in metres, got {heights.tolist()}.", code="H3-WORLD-025"
        )
    first, second = sorted(np.argsort(heights, kind="stable")[:2].tolist())
    one, other = _plan([wall.polygon[first], wall.polygon[second]])
    return one, other, float(heights.min()), float(heights.max())


_Hole = tuple[NDArray[np.float64], NDArray[np.float64], float, float]
"""Both ends (x, z) of a hole, and its lower and upper height [m]."""


def _holes(opening: _Opening, walls: Mapping[str, _Hole]) -> Iterator[_Hole]:
    """Yield the hole of a door or window.

    The x of the hole is the distance along ``wall0`` from the first of the wall's lower corners.
    """
    if opening.wall0 in walls and len(opening.hole_polygon) >= 2:
        one, other, low, _ = walls[opening.wall0]
        along = (other - one) / max(float(np.hypot(*(other - one))), 1e-9)
        x = [point.x for point in opening.hole_polygon]
        y = [point.y for point in opening.hole_polygon]
        if np.isfinite([*x, *y]).all():
            yield one + along * min(x), one + along * max(x), low + min(y), low + max(y)


def _pieces(
    one: NDArray[np.float64],
    along: NDArray[np.float64],
    length: float,
    low: float,
    high: float,
    holes: Sequence[_Hole],
) -> list[tuple[float, float, float, float]]:
    """Return parts of a wall that its holes leave: beginning and end along it, lower and upper height [m].

    A room's wall and that of the next room lie in one plane, so that a hole is cut into every wall that it lies in.
    """
    cuts = []
    for start, end, bottom, top in holes:
        aside = np.abs(np.cross(np.append(along, 0), np.stack([np.append(p - one, 0) for p in (start, end)])))[:, 2]
        near, far = sorted(float(np.dot(p - one, along)) for p in (start, end))
        near, far = max(near, 0.0), min(far, length)
        if aside.max() < WALL_M and far - near > 1e-6:
            cuts.append((near, far, bottom, top))
    found, at = [], 0.0
    for near, far, bottom, top in sorted(cuts):
        found += [(at, near, low, high), (max(near, at), far, low, bottom), (max(near, at), far, top, high)]
        at = max(at, far)
    found.append((at, length, low, high))
    return [piece for piece in found if piece[1] - piece[0] > 1e-6 and piece[3] - piece[2] > 1e-6]


def _wall_box(one: NDArray[np.float64], along: NDArray[np.float64], piece: tuple[float, float, float, float]) -> Box:
    start, end, low, high = piece
    pose = ground_pose(one + along * (start + end) / 2, math.atan2(-along[1], along[0]), (low + high) / 2)
    half = np.array([(end - start) / 2, (high - low) / 2, WALL_M / 2])
    return Box(pose=np.asarray(pose, np.float64), half_extents=half)


def _mesh_of(boxes: Sequence[Box], color: Sequence[int]) -> Mesh:
    parts = [box_mesh(box.half_extents, color=color) for box in boxes]
    vertices = [quat_rotate(box.pose[3:], part.vertices) + box.pose[:3] for box, part in zip(boxes, parts, strict=True)]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        vertices=np.concatenate(vertices).astype(np.float32),
        faces=np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]).astype(
            np.int32
        ),
        colors=np.concatenate([part.colors for part in parts if part.colors is not None]),
    )


def _pose(thing: _Thing) -> NDArray[np.float64]:
    """Return the pose of the middle of an object. Unity turns about z, then x, then y, by left-handed angles in degrees."""
    values = [getattr(vector, axis) for vector in (thing.position, thing.rotation) for axis in "xyz"]
    if not (np.abs(values) < PLACE_MAX_M).all():
        raise FormatError(f"Expected a place of {thing.id!r} in metres and degrees, got {values}.", code="H3-WORLD-026")
    x, y, z = np.radians([thing.rotation.x, thing.rotation.y, thing.rotation.z])
    about_x = [[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]]
    about_y = [[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]]
    about_z = [[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]]
    mirror = np.diag([1.0, 1.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = mirror @ np.array(about_y) @ np.array(about_x) @ np.array(about_z) @ mirror
    matrix[:3, 3] = mirror @ [thing.position.x, thing.position.y, thing.position.z]
    return np.asarray(pose_from_matrix(matrix), np.float64)


def _name(identity: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", identity) or "unnamed"


def _words(name: str) -> str:
    """Return a name in words, such as ``living_room`` for ``LivingRoom``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", _name(name)).lower()


PROCTHOR = SceneReader(endings=(".json",), read=read_house, recognizes=_is_house)
