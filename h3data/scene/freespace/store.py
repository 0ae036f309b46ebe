"""Storage of `FreeSpace` objects: npz files without pickle, and a cache of them by key.

The cache is in ``$H3DATA_CACHE/freespace`` (``H3DATA_CACHE=off`` disables it), else
``$XDG_CACHE_HOME/h3data/freespace``, else ``~/.cache/h3data/freespace``. If the folder cannot be written, nothing is
cached. The cache may be deleted at any time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon

from h3data import files
from h3data.errors import FormatError, InputError
from h3data.files import part_file
from h3data.scene.floor_heights import COLUMNS, LEVEL
from h3data.scene.freespace._lattice import Lattice
from h3data.scene.freespace._visibility import Graph
from h3data.scene.freespace.build import FloorMap

log = logging.getLogger(__name__)

FORMAT = 3
_NUMBERS = ("floor_y", "radius_m", "height_m", "max_climb_m", "cell_m")


def save(space: FloorMap, path: Path, *, lattice: Lattice | None = None) -> None:
    """Write a free space to the file ``path`` atomically."""
    arrays: dict[str, NDArray] = {
        "format": np.array(FORMAT),
        "key": np.frombuffer(space.key.encode(), np.uint8),
        "numbers": np.array([getattr(space, n) for n in _NUMBERS]),
        "origin": space.origin,
        "sdf": space.sdf,
        "polygon": np.frombuffer(shapely.to_wkb(space.polygon), np.uint8),
    }
    if len(space.heights):
        arrays["heights"] = space.heights
    arrays |= {f"graph.{name}": value for name, value in space.graph._asdict().items()}
    if lattice is not None:
        arrays |= {f"lattice.{name}": np.asarray(value) for name, value in lattice._asdict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    # several processes may build the same floor at once, and each writes a file of its own until it is whole
    with part_file(path, shared=True) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load(path: Path) -> tuple[FloorMap, Lattice | None]:
    """Load a free space from a file that `save` wrote."""
    if not path.is_file():
        raise InputError(f"No such free-space file: {path}", code="H3-SCENE-017")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if int(arrays["format"]) != FORMAT:
            raise FormatError(
                f"Free-space file of format {int(arrays['format'])}, this version reads {FORMAT}: {path}",
                code="H3-SCENE-018",
            )
        return _from_arrays(arrays)
    except FormatError:
        raise
    except FileNotFoundError:  # removed in this moment
        raise InputError(f"No such free-space file: {path}", code="H3-SCENE-017") from None
    except shapely.errors.ShapelyError as fault:
        raise FormatError(f"Free-space file with a broken polygon ({fault}): {path}", code="H3-SCENE-019") from fault
    except Exception as fault:  # zipfile and numpy have a dozen ways to say that bits are wrong
        raise FormatError(
            f"Not a whole free-space file ({type(fault).__name__}: {fault}): {path}", code="H3-SCENE-020"
        ) from fault


def cached(key: str, build: Callable[[], FloorMap]) -> tuple[FloorMap, Lattice | None]:
    """Return the free space of a key and its lattice, from the cache or newly built; a new one is cached if possible."""
    folder = cache_folder()
    if folder is None:
        return build(), None
    path = folder / f"{key}.npz"
    try:
        space, lattice = load(path)
        if space.key == key:
            return space, lattice
        # somebody has renamed or copied a file
        log.warning("A cached free space belongs to another scene and is built again: %s", path)
    except FormatError as fault:
        log.warning("A cached free space is broken and is built again. %s", fault)
    except InputError:
        pass  # there is none yet, or another process has just removed it
    space = build()
    try:
        save(space, path)
    except OSError as fault:
        log.info("The free space is not cached: %s", fault)
    return space, None


def cache_folder() -> Path | None:
    """Return the folder of cached free spaces, None if ``H3DATA_CACHE`` is ``off``."""
    return files.cache_folder("freespace")


def _from_arrays(arrays: dict[str, NDArray]) -> tuple[FloorMap, Lattice | None]:
    # a file may be damaged in any of its arrays, and kernels would read beyond those that do not fit together
    polygon = shapely.from_wkb(arrays["polygon"].tobytes())
    graph = Graph(**{name: arrays[f"graph.{name}"] for name in Graph._fields})
    n = len(graph.nodes)
    faults = []
    if not isinstance(polygon, MultiPolygon):
        faults.append(f"polygon is a {type(polygon).__name__}")
    if arrays["sdf"].ndim != 2 or arrays["sdf"].dtype != np.float32 or not np.isfinite(arrays["sdf"]).all():
        faults.append("sdf is not a finite float32 grid")
    if graph.distance.shape != (n, n) or graph.previous.shape != (n, n):
        faults.append(f"tables of {graph.distance.shape} for {n} corners")
    heights = arrays.get("heights", LEVEL)
    if heights.ndim != 2 or heights.shape[1] != COLUMNS or not np.isfinite(heights).all():
        faults.append(f"heights of shape {list(heights.shape)}")
    # kernels check no bounds, so what they use as an index must fit
    if len(graph.bucket_start) != graph.bucket_label.size + 1:
        faults.append("buckets do not fit their grid")
    if faults or not isinstance(polygon, MultiPolygon):
        raise ValueError("; ".join(faults))
    numbers = dict(zip(_NUMBERS, arrays["numbers"].tolist(), strict=True))
    space = FloorMap(
        key=arrays["key"].tobytes().decode(),
        origin=arrays["origin"],
        sdf=arrays["sdf"],
        polygon=polygon,
        graph=graph,
        heights=heights,
        **numbers,
    )
    if "lattice.table" not in arrays:
        return space, None
    origin, rows, table = (arrays[f"lattice.{name}"] for name in ("origin", "rows", "table"))
    return space, Lattice(origin=origin, step=float(arrays["lattice.step"]), rows=rows, table=table)
