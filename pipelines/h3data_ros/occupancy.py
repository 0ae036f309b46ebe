"""Conversion between occupancy grids and the floors of scenes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from h3data.errors import FormatError, InputError
from h3data.mesh.mesh import Mesh
from h3data.scene import Asset, Box, FreeSpace, Instance, Room, Scene
from h3data.scene.freespace._voxels import mask_rectangles

CELL_M = 0.05
"""Side of the cells of exported maps [m]."""
UNSEEN_M = 0.25
"""Distance outside the outline of the floor above which cells are unknown [m], as in a map made by a robot."""
CELLS_MAX = 40_000_000
FINEST_M, COARSEST_M, LONGEST_M, FARTHEST_M = 0.001, 1.0, 1e3, 1e5
"""Least and greatest cell size, greatest side, and greatest coordinate of the origin of a map [m]."""
"""Largest number of cells of a map that is read."""
RECTANGLES_MAX = 100_000
WALL_M = 2.5
"""Height of walls [m]."""
CLOSED_M = 0.3
"""Largest width of gaps in a floor that would be closed (`h3data.scene.freespace`) [m]; unknown cells there need a
border."""
FREE, OCCUPIED, UNKNOWN = 0, 100, -1


@dataclass(frozen=True, kw_only=True, eq=False)
class OccupancyMap:
    """Occupancy grid in the frame ``map``, whose x axis is the world's x and whose y axis is the world's -z."""

    cells: NDArray[np.int8]
    """Cells as `FREE`, `OCCUPIED` or `UNKNOWN`, shape [rows, columns]; rows increase along y and columns along x."""
    resolution: float
    """Side of a cell [m]."""
    origin: tuple[float, float]
    """Corner (x, y) of the first cell in the frame ``map`` [m]."""


def map_of(free: FreeSpace, *, resolution: float = CELL_M) -> OccupancyMap:
    """Return the occupancy map of a floor, in which a cell is free if its middle is.

    The floor is not narrowed by the radius of agents.
    """
    low = free.origin
    high = low + np.array(free.sdf.shape) * free.cell_m
    x0, y0 = np.floor(low[0] / resolution) * resolution, np.floor(-high[1] / resolution) * resolution
    columns = int(np.ceil((high[0] - x0) / resolution))
    rows = int(np.ceil((-low[1] - y0) / resolution))
    x, y = np.meshgrid(x0 + (np.arange(columns) + 0.5) * resolution, y0 + (np.arange(rows) + 0.5) * resolution)
    distance = free.signed_distance(np.stack([x, -y], axis=-1))
    cells = np.where(distance > 0, FREE, np.where(distance < -UNSEEN_M, UNKNOWN, OCCUPIED)).astype(np.int8)
    return OccupancyMap(cells=cells, resolution=resolution, origin=(float(x0), float(y0)))


# --- maps in ----------------------------------------------------------------------------------------------------------
def read_map(path: str | Path) -> OccupancyMap:
    """Read a map of map_server: a YAML file and the picture that it names.

    The occupancy of a pixel is 1 - value / 255, or value / 255 with ``negate``. A cell is occupied above
    ``occupied_thresh`` and free below ``free_thresh``. Other cells, and transparent ones, are unknown. With mode
    ``raw``, values up to 100 are occupancies in percent.

    Raises:
        InputError: a file is missing, or the map is rotated.
        FormatError: a file is damaged, or the map is too large.
    """
    path = Path(path)
    values = _read_yaml(path)
    try:
        resolution, (x, y, yaw) = float(values["resolution"]), (float(v) for v in values["origin"])
        occupied, free = float(values.get("occupied_thresh", 0.65)), float(values.get("free_thresh", 0.196))
        negate = float(values.get("negate", 0)) if str(values.get("negate", 0)).lower() not in ("true", "false") else 0
        image = str(values["image"])
    except (KeyError, ValueError, TypeError) as fault:
        raise FormatError(
            f"Expected image, resolution and origin [x, y, yaw] in the yaml file of a map, got a fault at {fault}: {path}",
            code="H3-ROS-016",
        ) from None
    negate = 1 if str(values.get("negate", 0)).lower() == "true" else negate
    if not (resolution > 0 and np.isfinite([resolution, x, y, yaw]).all()):
        raise FormatError(
            f"Expected a resolution above 0 and an origin of numbers, got {resolution:g} and [{x:g}, {y:g}, {yaw:g}]: {path}",
            code="H3-ROS-017",
        )
    if abs(yaw) > 1e-6:
        raise InputError(
            f"The map is turned by {yaw:g} rad, only yaw 0 is read. Hint: save it again without rotation. {path}",
            code="H3-ROS-018",
        )
    pixels, visible = _read_picture(path.parent / image)
    share = pixels / 255 if negate else 1 - pixels / 255
    if values.get("mode") == "raw":
        share = np.where(pixels <= 100, pixels / 100, np.nan)
    with np.errstate(invalid="ignore"):
        cells = np.where(share > occupied, OCCUPIED, np.where(share < free, FREE, UNKNOWN))
    cells[~visible] = UNKNOWN
    return OccupancyMap(cells=cells[::-1].astype(np.int8), resolution=resolution, origin=(x, y))


def scene_of_map(grid: OccupancyMap, name: str) -> Scene:
    """Return a scene with the floor of the free cells and walls on the occupied ones, 2.5 m high.

    The outline of its floor is that of the free cells. Unknown cells next to them are not walkable, but have no wall.

    Raises:
        FormatError: no cell is free, or the map is too large or too ragged.
    """
    cells = np.asarray(grid.cells)
    is_near = np.abs(grid.origin).max() <= FARTHEST_M and max(cells.shape) * grid.resolution <= LONGEST_M
    if not (FINEST_M <= grid.resolution <= COARSEST_M and is_near):
        raise FormatError(
            f"Expected a map of at most {LONGEST_M:g} m with cells from {FINEST_M:g} to {COARSEST_M:g} m, got cells of "
            f"{grid.resolution:g} m from [{grid.origin[0]:g}, {grid.origin[1]:g}]: {name}",
            code="H3-ROS-061",
        )
    if cells.size > CELLS_MAX:
        raise FormatError(
            f"The map has {cells.shape[1]} x {cells.shape[0]} cells, more than {CELLS_MAX // 10**6} million. Hint: crop it, or "
            "save it with larger cells.",
            code="H3-ROS-019",
        )
    free = cells == FREE
    if not free.any():
        raise FormatError("No cell of the map is free. Hint: check negate and the thresholds.", code="H3-ROS-020")
    near = binary_dilation(free, np.ones((3, 3)), iterations=int(np.ceil(CLOSED_M / grid.resolution)) + 1)
    rectangles = [_rectangles(mask, grid) for mask in (free, cells == OCCUPIED, near & ~free & (cells != OCCUPIED))]
    if sum(map(len, rectangles)) > RECTANGLES_MAX:
        raise FormatError(
            f"The outlines of the map are too ragged ({sum(map(len, rectangles))} rectangles, at most {RECTANGLES_MAX}). Hint: "
            "remove speckles with a median filter, or save it with larger cells.",
            code="H3-ROS-021",
        )
    floor, walls, border = rectangles
    up = WALL_M / 2
    shapes = tuple(
        Box(
            pose=np.array([(x0 + x1) / 2, up, (z0 + z1) / 2, 0, 0, 0, 1]),
            half_extents=np.array([(x1 - x0) / 2, up, (z1 - z0) / 2]),
        )
        for x0, z0, x1, z1 in np.concatenate([walls, border]).tolist()
    )
    assets = {
        "floor": Asset(name="floor", mesh=_boxes(floor, -0.02, 0.0, (205, 203, 198)), category="floor"),
        "walls": Asset(name="walls", mesh=_boxes(walls, 0.0, WALL_M, (232, 230, 226)), category="wall", shapes=shapes),
    }
    instances = tuple(
        Instance(name=one, asset=one, pose=np.array([0, 0, 0, 0, 0, 0, 1.0]), layer=layer)
        for one, layer in (("floor", "floor"), ("walls", "wall"))
        if len(assets[one].mesh.faces) or assets[one].shapes
    )
    used = {i.asset: assets[i.asset] for i in instances}
    room = Room(name="map", category="map", rectangles=floor)
    return Scene(name=name, assets=used, instances=instances, rooms=(room,), source={"kind": "map", "name": name})


def _rectangles(mask: NDArray[np.bool_], grid: OccupancyMap) -> NDArray[np.float64]:
    """Return the world rectangles ``x0 z0 x1 z1`` [R, 4] that cover a mask [rows, columns]."""
    row0, column0, row1, column1 = mask_rectangles(np.ascontiguousarray(mask)).T
    x, y = grid.origin
    r = grid.resolution
    return np.stack([x + column0 * r, -(y + row1 * r), x + column1 * r, -(y + row0 * r)], axis=1)


def _boxes(rectangles: NDArray[np.float64], low: float, high: float, color: tuple[int, int, int]) -> Mesh:
    """Return boxes on rectangles [R, 4] between two heights, as one mesh."""
    x0, z0, x1, z1 = rectangles.T
    corners = [(x, np.full(len(x0), y), z) for y in (low, high) for x, z in ((x0, z0), (x1, z0), (x1, z1), (x0, z1))]
    vertices = np.stack([np.stack(corner, axis=1) for corner in corners], axis=1).reshape(-1, 3)
    quads = [(0, 1, 2, 3), (7, 6, 5, 4), (4, 5, 1, 0), (5, 6, 2, 1), (6, 7, 3, 2), (7, 4, 0, 3)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))], np.int32)
    offsets = 8 * np.arange(len(x0), dtype=np.int32)[:, None, None]
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=(faces + offsets).reshape(-1, 3).astype(np.int32),
        colors=np.tile(np.array(color, np.uint8), (len(vertices), 1)),
    )


def _read_yaml(path: Path) -> dict[str, Any]:
    """Return keys with texts, or lists of texts: all that a map_server file has."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(f"The map cannot be read ({fault}): {path}", code="H3-ROS-022") from None
    values: dict[str, Any] = {}
    key = ""
    for line in text.splitlines():
        line = line.partition("#")[0].rstrip()
        if line.lstrip().startswith("- ") and key:
            values[key] = [*(values[key] if isinstance(values[key], list) else []), line.lstrip()[2:].strip()]
            continue
        name, colon, value = line.partition(":")
        if not colon:
            continue
        key, value = name.strip(), value.strip().strip("\"'")
        values[key] = [part.strip() for part in value[1:-1].split(",")] if value.startswith("[") else value
    return values


def _read_picture(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the grey values [rows, columns] and where the picture is not transparent."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                if image.width * image.height > CELLS_MAX:
                    raise Image.DecompressionBombError
                image.load()
                has_alpha = "A" in image.getbands()
                visible = np.asarray(image.getchannel("A")) > 0 if has_alpha else None
                grey = np.asarray(image.convert("RGB") if image.mode not in ("L", "I", "I;16") else image, np.float64)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise FormatError(
            f"The picture of the map has more than {CELLS_MAX // 10**6} million cells. Hint: crop it. {path}",
            code="H3-ROS-023",
        ) from None
    except FileNotFoundError:
        raise InputError(f"The yaml file names a picture that is not there: {path}", code="H3-ROS-024") from None
    except (OSError, ValueError, SyntaxError) as fault:
        raise FormatError(f"The picture of the map is damaged ({fault}): {path}", code="H3-ROS-025") from None
    grey = grey.mean(axis=-1) if grey.ndim == 3 else grey
    return grey, np.ones(grey.shape, np.bool_) if visible is None else visible
