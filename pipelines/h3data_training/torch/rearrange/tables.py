"""Tables of a bank of episodes on a device, and look-ups in them for W worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from h3data_training.torch.rearrange.bank import FLOOR, RearrangeBank
from sim_kinematic.agents.oracle.ways import CELL_M

HOPS = 4
"""Number of segments of a path that `Places.along` follows; corners are at least 25 cm apart, mostly more than a metre.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tables:
    """Arrays of a `RearrangeBank` as tensors."""

    objects: int
    """Number K of objects."""
    parts: int
    """Number M of doors and drawers that agents may open."""
    fields: int
    """Number F of distance fields."""
    place: Tensor
    starts: Tensor
    spots: Tensor
    ends: Tensor
    """End points of each distance field, up to S of them, [N * F, S, 2] [m]; unused rows are infinity."""
    first: Tensor
    """First point of the path from each cell, as int16, of which a GPU reads half as many bytes as of int32."""
    first_of: Tensor
    after: Tensor
    after_of: Tensor
    left: Tensor
    left_of: Tensor
    corners: Tensor
    corners_of: Tensor
    counts: Tensor
    """Number of corners of each home, int64 [R]."""
    origins: Tensor
    shapes: Tensor
    floor_y: Tensor
    """Height of the floor of each home, [R] [m]."""

    @classmethod
    def of(cls, bank: RearrangeBank, device: torch.device, dtype: torch.dtype) -> Tables:
        """Return the tables on a device."""

        def moved(array: NDArray) -> Tensor:
            kind = dtype if array.dtype == np.float64 else None
            return torch.as_tensor(np.ascontiguousarray(array), dtype=kind, device=device)

        ends = np.where(np.isnan(bank.ends), np.inf, bank.ends)
        return cls(
            objects=bank.objects,
            parts=bank.spec.parts,
            fields=ends.shape[1],
            place=moved(bank.place),
            starts=moved(bank.starts),
            spots=moved(bank.spots),
            ends=moved(ends.reshape(-1, *ends.shape[2:])),
            first=moved(bank.first),
            first_of=moved(bank.first_of),
            after=moved(bank.after),
            after_of=moved(bank.after_of),
            left=moved(bank.left).to(dtype),
            left_of=moved(bank.left_of),
            corners=moved(bank.corners),
            corners_of=moved(bank.corners_of[:-1]),
            counts=moved(np.diff(bank.corners_of)),
            origins=moved(bank.origins),
            shapes=moved(bank.shapes),
            floor_y=moved(np.array([floor.floor_y for floor in bank.floors])),
        )

    def goals(self, episode: Tensor) -> Tensor:
        """Return the goals of the objects in episodes [W], [W, K, 3] [m]."""
        return self.spots[episode, self.objects : 2 * self.objects]

    def handles(self, episode: Tensor) -> Tensor:
        """Return the handles at rest of the doors and drawers of the task in episodes [W], [W, M, 3] [m]."""
        return self.spots[episode, 2 * self.objects :]

    def at(self, episode: Tensor) -> Places:
        """Return the tables of the episodes of W worlds."""
        place = self.place[episode]
        return Places(
            self, episode, place, self.counts[place], self.corners_of[place], self.origins[place], self.shapes[place]
        )


class Places(NamedTuple):
    """Look-ups for W worlds; additional axes follow the axis of the worlds."""

    tables: Tables
    episode: Tensor
    place: Tensor
    n: Tensor
    """Number of corners of the home, int64 [W]."""
    corners_of: Tensor
    origin: Tensor
    shape: Tensor

    def _rows(self, values: Tensor, like: Tensor) -> Tensor:
        """Return values of worlds [W] with as many axes as ``like`` [W, ...]."""
        return values.reshape(-1, *[1] * (like.ndim - 1))

    def spots(self, field: Tensor) -> Tensor:
        """Return the start, goal or handle to which paths [W] lead, [W, 3] [m]."""
        number, some = field % (2 * self.tables.objects), self.tables.parts
        if some:
            handle = field - 6 * self.tables.objects
            number = torch.where(handle >= 0, 2 * self.tables.objects + handle % some, number)
        return self.tables.spots[self.episode, number]

    def ends(self, field: Tensor) -> Tensor:
        """Return the places at the ends of paths [W, ...], as [W, ..., S, 2] [m]."""
        return self.tables.ends[self._rows(self.episode, field) * self.tables.fields + field]

    def first(self, field: Tensor, xz: Tensor) -> Tensor:
        """Return the numbers of the first points of paths [W, ...] from points [W, ..., 2], -1 if there is no path."""
        last = self._rows_of(self.shape, field) - 1
        origin = self._rows_of(self.origin, field)
        cell = ((xz - origin) / CELL_M).floor().long().clamp_min(0)
        cell = torch.minimum(cell, last)
        cells = self.shape[:, 0] * self.shape[:, 1]
        base = self._rows(self.tables.first_of[self.episode], field) + field * self._rows(cells, field)
        return self.tables.first[base + cell[..., 0] * (last[..., 1] + 1) + cell[..., 1]].long()

    def _rows_of(self, values: Tensor, like: Tensor) -> Tensor:
        """Return vectors of worlds [W, n] with the axes of ``like`` [W, ...] before the last."""
        return values.reshape(len(values), *[1] * (like.ndim - 1), values.shape[-1])

    def after(self, field: Tensor, number: Tensor) -> Tensor:
        """Return the numbers of the points after corners [W, ...] of paths [W, ...]."""
        count = self._rows(self.n, field)
        first = self._rows(self.tables.after_of[self.episode], field)
        at = first + field * count + torch.minimum(number.clamp_min(0), count - 1)
        return self.tables.after[at.clamp_max(len(self.tables.after) - 1)].long()

    def points(self, field: Tensor, number: Tensor) -> Tensor:
        """Return the positions [W, ..., 2] [m] of points with given numbers [W, ...] of paths [W, ...]."""
        count = self._rows(self.n, field)
        corner = torch.minimum(number.clamp_min(0), (count - 1).clamp_min(0)) + self._rows(self.corners_of, field)
        corner = self.tables.corners[corner.clamp_max(len(self.tables.corners) - 1)]
        end = (number - count).clamp_min(0).clamp_max(self.tables.ends.shape[1] - 1)
        row = self._rows(self.episode, field) * self.tables.fields + field
        return torch.where((number >= count)[..., None], self.tables.ends[row, end], corner)

    def along(self, field: Tensor, xz: Tensor, lengths_m: Sequence[float]) -> Tensor:
        """Return points [W, ..., n, 2] at given distances along paths [W, ...] from points [W, ..., 2] [m].

        For a shorter path, the result is its end; without a path, it is the point itself. At most `HOPS` corners are
        followed.
        """
        number, at, walked = self.first(field, xz), xz, torch.zeros_like(xz[..., 0])
        is_path, found = number >= 0, [xz] * len(lengths_m)
        for _ in range(HOPS):
            gap = torch.where(is_path[..., None], self.points(field, number) - at, 0.0)
            leg = torch.hypot(gap[..., 0], gap[..., 1])
            parts = [((length - walked) / leg.clamp_min(1e-6)).clamp(0.0, 1.0) for length in lengths_m]
            found = [
                torch.where((length > walked)[..., None], at + part[..., None] * gap, point)
                for length, part, point in zip(lengths_m, parts, found, strict=True)
            ]
            at, walked = at + gap, walked + leg
            number = torch.where(number < self._rows(self.n, field), self.after(field, number), number)
        return torch.stack(found, -2)

    def lengths(self, xz: Tensor) -> Tensor:
        """Return the lengths of the paths from points [W, ..., 2] to the floor below starts and goals, [W, ..., 2 K] [m].

        Lengths are infinite if there is no path.
        """
        many = torch.arange(2 * self.tables.objects, device=xz.device)
        field = (FLOOR * 2 * self.tables.objects + many).expand(*xz.shape[:-1], -1)
        from_xz = xz[..., None, :].expand(*xz.shape[:-1], len(many), -1)
        number = self.first(field, from_xz)
        gap = self.points(field, number) - from_xz
        size = self._rows(self.n + 1, field)
        at = self._rows(self.tables.left_of[self.episode], field) + many * size + number.clamp_min(0)
        way = torch.hypot(gap[..., 0], gap[..., 1]) + self.tables.left[at]
        return torch.where(number < 0, torch.inf, way)
