"""Observations of worlds on a device, by the entries of `sim_kinematic.sensing.table`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from h3data.scene.freespace._sdf import HIT_M, RAY_STRIDE_GROWTH, RAY_STRIDE_M, RAY_STRIDES
from h3data_training.torch.step import Grids, heading_direction, sample_sdf
from sim_kinematic.sensing.table import TABLE, Sensor


def read_sensors(moment: Any, names: Sequence[str], sensors: Mapping[str, Sensor] = TABLE) -> dict[str, Tensor]:
    """Return the named sensors of a `sim_kinematic.sensing.table.Context`, float32 [W, n] each.

    The context must have the data that they need.
    """
    return {name: sensors[name].of(moment).float() for name in names}


def free_along(grids: Grids, xz: Tensor, headings: Tensor, max_m: float) -> Tensor:
    """Return the free distance [W, R] [m] from positions [W, 2] along headings [W, R] [rad].

    The result equals that of `h3data.scene.freespace._sdf.trace_rays`.
    """
    start, direction = xz, heading_direction(headings).movedim(1, 0)
    reach = headings.new_zeros(headings.shape).movedim(1, 0)
    going = reach >= 0.0
    for _ in range(RAY_STRIDES):
        left = sample_sdf(grids, torch.addcmul(start, direction, reach[..., None])).distance
        hit = left <= HIT_M
        stride = torch.maximum(left, reach * RAY_STRIDE_GROWTH + RAY_STRIDE_M)
        further = torch.where(hit, (reach + left.clamp_max(0.0)).clamp_min(0.0), reach + stride)
        reach = torch.where(going, further, reach)
        going = going & ~hit & (reach < max_m)
    return reach.clamp_max(max_m).movedim(0, 1)


def clearance(grids: Grids, points: Tensor) -> Tensor:
    """Return the signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
    return sample_sdf(grids, points.movedim(1, 0)).distance.movedim(0, 1)
