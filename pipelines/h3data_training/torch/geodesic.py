"""Shortest paths between two points in W worlds, computed from tables so that a GPU can compute them in every step.

The path is the straight line if that is free, and otherwise the shortest path through the lattice nodes around both
ends (`h3data.scene.FreeSpace.lattice`). Compared with the exact `FreeSpace.geodesic` for pairs of random points in
furnished homes, the median error of the length is 0.05 to 0.1%, and 95% of errors are below 1.2%
(tests/training/torch/test_social_nav.py). If the path is not straight, its initial direction is a mean over those
nodes, with a median error of 4 degrees, and 90% of errors below 15 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from h3data.scene import FreeSpace
from h3data.scene.freespace._sdf import SLACK_M
from h3data_training.torch.step import Grids, sample_sdf

AROUND = 4
"""Number of rows and of columns of lattice nodes that are tried around an end of a path."""
LOOKS = 32
"""Number of places on the straight line at which the distance to obstacles is looked up."""
LOOK_APART_M = 0.4
"""Largest distance between these places [m]: no obstacle for an agent is thinner than twice its radius."""
DETOUR_M = 0.02
"""Additional length of a path over a node at which the node's weight in the direction falls to 1 / e [m]."""


_PER_FLOOR = ("shift", "scale", "top", "stride", "first", "table_first", "size", "step", "clearance")
"""Fields with a row for each floor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattices:
    """Lattices of R floors, each with a margin without nodes, and all their tables, concatenated."""

    rows: Tensor
    """Row of the table of each node, -1 = not free, int64 [nodes of all floors]."""
    table: Tensor
    """Shortest distances of all floors [m], infinite between islands, float32 [N]."""
    shift: Tensor
    """Offset of the cells [R, 2], with ``scale`` [R, 1]: a point p is at ``shift + scale p`` in cells."""
    scale: Tensor
    top: Tensor
    """Largest first row and column of the nodes around a point, [R, 2]."""
    stride: Tensor
    """Number of nodes per row of the lattice, int64 [R]."""
    first: Tensor
    """Number of the first node, int64 [R]."""
    table_first: Tensor
    """Index of the first row in ``table``, int64 [R]."""
    size: Tensor
    """Number of rows of the table, int64 [R]."""
    step: Tensor
    """Spacing of the nodes [m], [R]."""
    clearance: Tensor
    """Clearance that a straight path must keep from obstacles [m], [R]."""

    @classmethod
    def of(cls, floors: Sequence[FreeSpace], device: torch.device | str, dtype: torch.dtype) -> Lattices:
        """Return the lattices of floors on a device, which are built at the first use."""
        lattices = [f.lattice for f in floors]
        padded = [np.pad(lattice.rows.astype(np.int64), AROUND, constant_values=-1) for lattice in lattices]
        step = np.array([lattice.step for lattice in lattices])
        origin = np.stack([lattice.origin for lattice in lattices])

        def on_device(array: NDArray) -> Tensor:
            return torch.as_tensor(array, dtype=dtype if array.dtype.kind == "f" else None, device=device)

        def starts(sizes: list[int]) -> Tensor:
            return torch.as_tensor(np.cumsum([0, *sizes[:-1]]), device=device)

        return cls(
            rows=on_device(np.concatenate([p.ravel() for p in padded])),
            table=torch.as_tensor(np.concatenate([t.table.ravel() for t in lattices]), device=device),
            shift=on_device(-origin / step[:, None] - 0.5 + AROUND),
            scale=on_device(1 / step[:, None]),
            top=on_device(np.array([p.shape for p in padded], np.float64) - AROUND),
            stride=on_device(np.array([p.shape[1] for p in padded])),
            first=starts([p.size for p in padded]),
            table_first=starts([t.table.size for t in lattices]),
            size=on_device(np.array([len(t.table) for t in lattices])),
            step=on_device(step),
            clearance=on_device(np.array([f.radius_m - SLACK_M for f in floors])),
        )

    def at(self, place: Tensor) -> Lattices:
        """Return the lattice of each world by the numbers of the floors [W]; a single floor is used by all worlds."""
        if len(self.step) == 1:
            return self
        rows = {name: getattr(self, name)[place] for name in _PER_FLOOR}
        return Lattices(rows=self.rows, table=self.table, **rows)


class ShortestPath(NamedTuple):
    """Shortest paths of W worlds."""

    length: Tensor
    """Length of the path [W] [m]; infinite if the table connects no nodes around the ends."""
    towards: Tensor
    """Direction (x, z) in which the paths start, not normalised, [W, 2]."""


def shortest_path(grids: Grids, lattices: Lattices, a: Tensor, b: Tensor) -> ShortestPath:
    """Return the shortest paths from points a [W, 2] to points b [W, 2] [m]."""
    gap = b - a
    straight = torch.hypot(gap[:, 0], gap[:, 1])
    along = torch.linspace(0, 1, LOOKS, dtype=a.dtype, device=a.device)[:, None, None]
    least = sample_sdf(grids, torch.addcmul(a, along, gap)).distance.amin(0)
    sees = (least >= lattices.clearance) & (straight <= LOOK_APART_M * (LOOKS - 1))
    through = _through_nodes(lattices, torch.stack([a, b]))
    return ShortestPath(
        torch.where(sees, straight, torch.maximum(through.length, straight)),
        torch.where((sees | through.length.isinf())[:, None], gap, through.towards),
    )


def _through_nodes(lattices: Lattices, ends: Tensor) -> ShortestPath:
    """Return the shortest way between ``ends`` [2, W, 2] through a node beside each."""
    f = torch.addcmul(lattices.shift, lattices.scale, ends)
    low = torch.minimum((f.floor() - (AROUND // 2 - 1)).clamp_min(0.0), lattices.top)
    k = torch.arange(AROUND**2, device=ends.device)
    i, j = k // AROUND, k % AROUND
    f = f - low
    away = torch.hypot(f[..., 0, None] - i, f[..., 1, None] - j) * lattices.step[:, None]
    low = low.long()
    first = (low[..., 0] * lattices.stride + low[..., 1] + lattices.first)[..., None]
    row = lattices.rows[first + (i * lattices.stride[:, None] + j)]
    away = torch.where(row < 0, torch.inf, away)
    row = row.clamp_min(0)
    start = row[0] * lattices.size[:, None] + lattices.table_first[:, None]
    ways = lattices.table[start[:, :, None] + row[1, :, None]] + (away[0, :, :, None] + away[1, :, None])
    over = ways.amin(2)  # each node beside the start
    length = over.amin(1)
    weight = torch.exp((length[:, None] - over) / DETOUR_M)
    towards = torch.stack([weight * (i - f[0, :, 0, None]), weight * (j - f[0, :, 1, None])], -1).sum(1)
    return ShortestPath(length, towards)
