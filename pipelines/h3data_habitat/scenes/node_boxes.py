"""Bounding boxes of mesh files as habitat-sim computes them to place objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.mesh.gltf import GltfFile, local_matrix
from h3data.mesh.gltf_primitives import PlainMesh
from h3data.mesh.loading import frame_rotation, load_mesh, unreadable


def node_box(
    path: str | Path,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    front: Sequence[float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> NDArray[np.float64]:
    """Return the bounding box of a file's contents as habitat-sim computes it, corners [2, 3] [m] in our frame.

    Each node's box encloses its mesh's box and the *boxes* of its children, rotated into its frame; so the result is
    larger than the mesh where nodes are rotated. Habitat puts the origin of an object at its centre
    (habitat-findings, "what habitat-sim itself does" 2).
    """
    path = Path(path)
    rotation = frame_rotation(up, front)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # such values are refused below
            box = (
                _node_box(GltfFile(path))
                if path.suffix.lower() in (".glb", ".gltf")
                else load_mesh(path).bounds.astype(np.float64)
            )
    except Exception as fault:
        raise unreadable(fault, path) from None
    if not len(box) or not np.isfinite(box).all():
        raise SceneError(f"A mesh file without triangles: {path}", code="H3-MESH-024")
    turned = _corners(box) @ rotation.T * units_m
    return np.stack([turned.min(0), turned.max(0)])


def _node_box(file: GltfFile) -> NDArray[np.float64]:
    """Return the box of the root, [2, 3], or [0, 3] if the file is empty."""
    nothing = np.zeros((0, 3))
    if not file.nodes:
        return _box_around([_bounds(part) for part, _ in file.parts()])
    # boxes of boxes, as habitat-sim has them, and not the box of all points: its objects are placed by the centre
    inside: list[list[NDArray[np.float64]]] = [[] for _ in file.nodes]
    outermost = []
    for at in range(len(file.nodes) - 1, -1, -1):  # children before parents
        index, parent, _ = file.nodes[at]
        shown = file.node(index).get("mesh") is not None
        boxes = [b for b in (_bounds(part) for part in file.mesh(file.node(index))) if len(b)] if shown else []
        own = [_corners(b) @ m[:3, :3].T + m[:3, 3] for b in boxes for m in file.instances(index)]
        box = _box_around([*own, *inside[at]])
        if len(box):
            matrix = local_matrix(file.node(index), f"nodes[{index}]")
            corners = _corners(box) @ matrix[:3, :3].T + matrix[:3, 3]
            (inside[parent] if parent >= 0 else outermost).append(corners)
    return _box_around(outermost) if outermost else nothing


def _bounds(part: PlainMesh) -> NDArray[np.float64]:
    points = part.vertices.astype(np.float64)
    return np.stack([points.min(0), points.max(0)]) if len(points) else np.zeros((0, 3))


def _box_around(points: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    everything = np.concatenate([np.zeros((0, 3)), *points])
    return np.stack([everything.min(0), everything.max(0)]) if len(everything) else everything


def _corners(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 8 corners [8, 3] of a box [2, 3]."""
    return np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(8, 3)
