"""Habitat's receptacles (boxes and meshes in ``user_defined``) as horizontal rectangles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, MissingAssetError
from h3data.geometry import normalized, quat_to_matrix
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Receptacle
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import numbers, text

DEFAULT_CLEARANCE_M = 0.3
"""Free height over a mesh receptacle [m], which Habitat's files do not state."""

_GRID = 64
_MIN_HALF_SIZE_M = 0.01


def read_receptacles(
    user_defined: Mapping[str, Any],
    *,
    find: Callable[[str], Path | None],
    frame: NDArray[np.float64],
    stage: bool,
    keys: KeyNotes,
    where: Path,
) -> tuple[tuple[Receptacle, ...], list[str]]:
    """Return receptacles of one template in its asset's frame (+Y up), and warnings about those that were left out.

    ``frame`` [3, 3] turns the asset file's frame to ours, ``find`` searches for the file of a mesh. As in habitat-lab
    (``receptacle.py``) entries are written in the file's frame, except meshes of a stage, which are in the world's. A
    box is a volume above a surface: its bottom gives the rectangle, its height the clearance; its ``rotation`` counts
    on stages only. A mesh gives the largest rectangle along x and z that its level triangles cover.
    """
    found: list[Receptacle] = []
    warnings: list[str] = []
    for key, entry in user_defined.items():
        if not key.startswith("receptacle_"):
            continue
        if not isinstance(entry, dict):
            warnings.append(f"receptacle {key} is left out: it is not a JSON object: {where}")
            continue
        keys.note("receptacle", entry)
        try:
            if "receptacle_aabb_" in key:
                receptacle = _from_box(key, entry, frame, stage, where)
            elif "receptacle_mesh_" in key:
                receptacle = _from_mesh(key, entry, find, np.eye(3) if stage else frame, where)
            else:
                continue
        # one bad receptacle leaves the object usable
        except H3DataError as fault:
            warnings.append(f"receptacle {key} is left out: {fault}")
            continue
        if receptacle is None:
            warnings.append(f"receptacle {key} is left out: it has no horizontal surface that can be used: {where}")
        else:
            found.append(receptacle)
    return tuple(found), warnings


def _from_box(
    key: str, entry: Mapping[str, Any], frame: NDArray[np.float64], stage: bool, where: Path
) -> Receptacle | None:
    w, x, y, z = numbers(entry, "rotation", (1, 0, 0, 0), where=where)
    position = np.array(numbers(entry, "position", (0, 0, 0), where=where))
    half = np.abs(numbers(entry, "scale", (1, 1, 1), where=where))
    axes = frame @ quat_to_matrix(normalized(np.array([x, y, z, w]))) if stage else frame  # columns: the box's axes
    # the axis of the box that is nearest to the vertical
    up = int(np.argmax(np.abs(axes[1])))
    if abs(axes[1, up]) < 0.99:  # the surface is not level
        return None
    first, second = (i for i in range(3) if i != up)
    # the first side is the one that runs along x
    if abs(axes[0, first]) < abs(axes[2, first]):
        first, second = second, first
    # the largest rectangle along x and z with the box's centre and proportions that lies inside the turned box
    a, b, cos, sin = half[first], half[second], abs(axes[0, first]), abs(axes[2, first])
    shrink = 1.0 if sin < 1e-6 else min(a / (a * cos + b * sin), b / (a * sin + b * cos))
    center = frame @ position - np.array([0, half[up], 0])
    return _rectangle(
        text(entry, "name", where=where) or key, center, np.array([a, b]) * shrink, clearance_m=2 * float(half[up])
    )


def _from_mesh(
    key: str,
    entry: Mapping[str, Any],
    find: Callable[[str], Path | None],
    frame: NDArray[np.float64],
    where: Path,
) -> Receptacle | None:
    name = text(entry, "mesh_filepath", where=where) or ""
    file = find(name) if name else None
    if file is None:
        raise MissingAssetError(f"There is no such mesh: {name!r}: {where}", code="H3-HABITAT-117")
    mesh = load_mesh(file)
    vertices = mesh.vertices.astype(np.float64) * numbers(entry, "scale", (1, 1, 1), where=where) @ frame.T
    covered = largest_rectangle(vertices, mesh)
    if covered is None:
        return None
    center, half = covered
    return _rectangle(f"{text(entry, 'name', where=where) or key}.0000", center, half, clearance_m=DEFAULT_CLEARANCE_M)


def _rectangle(
    name: str, center: NDArray[np.float64], half: NDArray[np.float64], *, clearance_m: float
) -> Receptacle | None:
    if min(half) < _MIN_HALF_SIZE_M:
        return None
    return Receptacle(name=name, center=center, half_size=half, clearance_m=clearance_m)


def largest_rectangle(
    vertices: NDArray[np.float64], mesh: Mesh
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return centre [3] and half size (x, z) [2] of the largest level rectangle on a mesh's level triangles, or None.

    Cells of a 64 x 64 grid over the mesh are covered if all their corners are; so the result never overhangs by more
    than the thin slivers between grid corners.
    """
    corners = vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # within 11 degrees of level
    level = np.abs(normal[:, 1]) > 0.98 * np.linalg.norm(normal, axis=1)
    corners = corners[level & (np.abs(normal[:, 1]) > 1e-12)]
    if not len(corners):
        return None
    flat = corners[..., [0, 2]]
    lo, hi = flat.min((0, 1)), flat.max((0, 1))
    xs, zs = (np.linspace(lo[i], hi[i], _GRID + 1) for i in (0, 1))
    points = np.stack(np.meshgrid(xs, zs, indexing="ij"), -1)
    inside = np.zeros(points.shape[:2], bool)
    for a, b, c in flat:
        signs = [
            (q - p)[0] * (points[..., 1] - p[1]) - (q - p)[1] * (points[..., 0] - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        # grid points on the common edge of two triangles must be in one of them
        slack = 1e-9 + 1e-6 * float(np.max(hi - lo))
        inside |= np.all(np.stack(signs) >= -slack, 0) | np.all(np.stack(signs) <= slack, 0)
    cells = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    best = _largest_block(cells)
    if best is None:
        return None
    i0, i1, j0, j1 = best
    center = np.array([(xs[i0] + xs[i1]) / 2, float(corners[..., 1].max()), (zs[j0] + zs[j1]) / 2])
    return center, np.array([(xs[i1] - xs[i0]) / 2, (zs[j1] - zs[j0]) / 2])


def _largest_block(cells: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Return ``i0 i1 j0 j1`` (ends exclusive) of the largest all-true block of a grid, or None."""
    best, area = None, 0
    for i0 in range(len(cells)):
        run = np.ones(cells.shape[1], bool)
        for i1 in range(i0, len(cells)):
            run &= cells[i1]
            # no row further down can continue an empty one
            if not run.any():
                break
            edges = np.flatnonzero(np.diff(np.concatenate([[0], run.view(np.int8), [0]])))
            widths = edges[1::2] - edges[::2]
            widest = int(np.argmax(widths))
            size = int(widths[widest]) * (i1 - i0 + 1)
            if size > area:
                best, area = (i0, i1 + 1, int(edges[::2][widest]), int(edges[1::2][widest])), size
    return best
