"""Observations of worlds on a device, by the entries of `sim_kinematic.sensing.table`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from h3data.scene.freespace._sdf import HIT_M, RAY_STRIDE_GROWTH, RAY_STRIDE_M, RAY_STRIDES
from h3data_training.torch.step import Grids, sample_sdf
from sim_kinematic.sensing.table import TABLE, Sensor

TOGETHER = 4
"""Number of strides of rays that are made before those that have ended are left out."""


def read_sensors(moment: Any, names: Sequence[str], sensors: Mapping[str, Sensor] = TABLE) -> dict[str, Tensor]:
    """Return the named sensors of a `sim_kinematic.sensing.table.Context`, float32 [W, n] each.

    The context must have the data that they need.
    """
    return {name: sensors[name].of(moment).float() for name in names}


def free_along(grids: Grids, xz: Tensor, headings: Tensor, max_m: float) -> Tensor:
    """Return the free distance [W, R] [m] from positions [W, 2] along headings [W, R] [rad].

    The result equals that of `h3data.scene.freespace._sdf.trace_rays`. On a CPU, only rays that have not ended make further
    strides. Elsewhere all do, as shapes that depend on values cannot be captured in a CUDA graph.
    """
    start, scale = torch.addcmul(grids.shift, grids.scale, xz), grids.scale
    reach = torch.zeros_like(headings)
    rays = [start[:, :1], start[:, 1:], scale * headings.cos(), -scale * headings.sin()]
    rays += [grids.top[:, :1], grids.top[:, 1:], grids.stride[:, None], grids.first[:, None], grids.cell[:, None]]
    if headings.device.type != "cpu" or torch.compiler.is_compiling():
        going = torch.ones_like(headings, dtype=torch.bool)
        for _ in range(RAY_STRIDES // TOGETHER):
            reach, going = _strides(grids.table, rays, reach, going, max_m)
        return reach.clamp(0.0, max_m)
    part, left = torch.arange(reach.numel(), device=reach.device), reach.view(-1)
    own = [v.expand_as(reach).reshape(-1) for v in rays]
    for _ in range(RAY_STRIDES // TOGETHER):
        left, going = _strides(grids.table, own, left, torch.ones_like(left, dtype=torch.bool), max_m)
        reach.view(-1)[part] = left
        goes = going.nonzero()[:, 0]
        part, left, own = part[goes], left[goes], [v[goes] for v in own]
    return reach.clamp_(0.0, max_m)


def _strides(
    table: Tensor, rays: Sequence[Tensor], reach: Tensor, going: Tensor, max_m: float
) -> tuple[Tensor, Tensor]:
    """Return how far rays reach [m] after `TOGETHER` more strides, and which of them have not ended.

    Each ray has its start in cells, its direction in cells per metre, and the size and squares of its grid (`Grids`).
    """
    x, z, dx, dz, top_x, top_z, wide, first, cell = rays
    for _ in range(TOGETHER):
        at_x, at_z = torch.addcmul(x, dx, reach), torch.addcmul(z, dz, reach)
        on_x, on_z = torch.minimum(at_x.clamp_min(0.0), top_x), torch.minimum(at_z.clamp_min(0.0), top_z)
        low_x, low_z = torch.minimum(on_x.floor(), top_x - 1), torch.minimum(on_z.floor(), top_z - 1)
        k = table[torch.addcmul(low_z, low_x, wide).long() + first]
        a, b = on_x - low_x, on_z - low_z
        left = torch.addcmul(torch.addcmul(k[..., 0], k[..., 1], a), torch.addcmul(k[..., 2], k[..., 3], a), b)
        left = left - cell * torch.hypot(at_x - on_x, at_z - on_z)
        free = left > HIT_M
        further = torch.maximum(left, reach * RAY_STRIDE_GROWTH + RAY_STRIDE_M)
        # out of the obstacle into which a shortest stride has led
        reach = torch.where(going, reach + torch.where(free, further, left.clamp_max(0.0)), reach)
        going = going & free & (reach < max_m)
    return reach, going


def clearance(grids: Grids, points: Tensor) -> Tensor:
    """Return the signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
    return sample_sdf(grids, points.movedim(1, 0)).distance.movedim(0, 1)
