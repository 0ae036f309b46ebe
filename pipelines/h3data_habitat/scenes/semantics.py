"""Habitat's semantic configs: regions as rooms, and the lexicon of classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.scene.records import Room
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import number, numbers, objects, points, text

STRIP_M = 0.1
"""Depth of the steps that replace slanting walls [m]; the area stays exact."""
_MAX_STRIPS = 1000
_MAX_CORNERS = 10_000


def read_rooms(content: Mapping[str, Any], keys: KeyNotes, *, where: Path) -> tuple[tuple[Room, ...], list[str]]:
    """Read regions of a ``*.semantic_config.json`` (world frame, +Y up) as rooms, with warnings about those left out.

    The area is that of ``poly_loop`` seen from above, else of ``min_bounds`` and ``max_bounds``. Rectangles make it up:
    exactly where walls run along x and z, else as strips of 0.1 m. A name that is used again gets ``_1``, ``_2``, ...
    """
    keys.note("semantic_config", content)
    rooms: dict[str, Room] = {}
    warnings = []
    for index, region in enumerate(objects(content, "region_annotations", where=where)):
        keys.note("region", region)
        name = text(region, "name", where=where) or f"region_{index}"
        loop = np.array(points(region, "poly_loop", where=where), np.float64).reshape(-1, 3)
        if not len(loop) and "min_bounds" in region and "max_bounds" in region:
            low, high = (numbers(region, key, (0, 0, 0), where=where) for key in ("min_bounds", "max_bounds"))
            loop = np.array(
                [
                    [x, low[1], z]
                    for x, z in ((low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2]))
                ]
            )
        if len(loop) > _MAX_CORNERS:
            raise FormatError(
                f"Expected at most {_MAX_CORNERS} corners in region {name!r}, got {len(loop)}: {where}",
                code="H3-HABITAT-134",
            )
        rectangles = polygon_rectangles(loop[:, [0, 2]])
        if not len(rectangles):
            warnings.append(f"region {name!r} is left out: it has no area")
            continue
        # several regions may share a name, and rooms are found by theirs
        unique = name if name not in rooms else next(n for k in range(1, 10**6) if (n := f"{name}_{k}") not in rooms)
        floor = number(region, "floor_height", float(loop[:, 1].min()), where=where)
        rooms[unique] = Room(
            name=unique, category=text(region, "label", where=where) or "", rectangles=rectangles, floor_y=floor
        )
    return tuple(rooms.values()), warnings


def read_lexicon(content: Mapping[str, Any], *, where: Path) -> dict[int, str]:
    """Read class names by semantic id from a lexicon: ``{"classes": [{"id": 1, "name": "chair"}, ...]}``."""
    classes: dict[int, str] = {}
    for entry in objects(content, "classes", where=where):
        name = text(entry, "name", where=where)
        if name is None or "id" not in entry:
            raise FormatError(
                f"Expected 'id' and 'name' in every class of a lexicon, got {str(entry)[:60]}: {where}",
                code="H3-HABITAT-135",
            )
        classes[int(number(entry, "id", 0, where=where))] = name
    return classes


def polygon_rectangles(loop: NDArray[np.float64] | Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Cover a polygon [N, 2] (even-odd rule) by disjoint rectangles ``x0 z0 x1 z1`` [R, 4].

    The result is empty for fewer than three corners, or no area.
    """
    corners = np.asarray(loop, np.float64).reshape(-1, 2)
    if len(corners) < 3:
        return np.zeros((0, 4))
    ends = np.roll(corners, -1, axis=0)
    # between two corners' heights no wall begins or ends, so each band is cut by whole walls
    levels = np.unique(corners[:, 1])
    step = max(STRIP_M, float(levels[-1] - levels[0]) / _MAX_STRIPS)
    found: list[list[float]] = []
    for low, high in pairwise(levels):
        middle = (low + high) / 2
        crossing = (corners[:, 1] > middle) != (ends[:, 1] > middle)
        a, b = corners[crossing], ends[crossing]
        slope = (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
        strips = 1 if np.all(np.abs(slope) < 1e-9) else int(np.ceil((high - low) / step))
        edges = np.linspace(low, high, strips + 1)
        for z0, z1 in pairwise(edges):
            # at the middle of a strip, where the area of a slanting wall is exact
            xs = np.sort(a[:, 0] + slope * ((z0 + z1) / 2 - a[:, 1]))
            found += [[x0, z0, x1, z1] for x0, x1 in zip(xs[::2], xs[1::2], strict=True) if x1 > x0]
    return np.array(found, np.float64).reshape(-1, 4)
