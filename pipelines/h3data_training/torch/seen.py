"""Observations of worlds on a device, by the rows of `sim_kinematic.sensing.table`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from h3data_training.torch.step import Grids, sample_sdf
from sim_kinematic.sensing.table import TABLE


def read_sensors(moment: Any, names: Sequence[str]) -> dict[str, Tensor]:
    """The named sensors of a `sim_kinematic.sensing.table.Context`, which has what they need, float32 [W, n] each."""
    return {name: TABLE[name].of(moment).float() for name in names}


def clearance(grids: Grids, points: Tensor) -> Tensor:
    """Signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
    return sample_sdf(grids, points.movedim(1, 0)).distance.movedim(0, 1)
