"""Agents of `sim_kinematic.motion.state` as tensors on a device, worlds first.

The step functions of `h3data_training.torch.step` take and return them. Tensors are replaced, not changed in place.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from sim_kinematic.motion.state import HumanState, RobotState


class RobotTensors(NamedTuple):
    """State of one robot in each world, without its joints; see `RobotState`."""

    xz: Tensor
    """Places on the floor [W, 2] [m]."""
    heading: Tensor
    """Headings [W] [rad], never wrapped."""
    contact: Tensor
    """True if the base touches something, bool [W]."""

    @classmethod
    def of(cls, state: RobotState, device: torch.device | str, dtype: torch.dtype) -> Self:
        """The robots on a device."""
        xz, heading = _on_device([state.xz, state.heading], device, dtype)
        return cls(xz, heading, torch.tensor(state.contact, device=device))

    def put(self, state: RobotState) -> None:
        """Copy them into arrays; this waits for the device."""
        for array, tensor in zip([state.xz, state.heading, state.contact], self, strict=True):
            array[:] = tensor.cpu().numpy()


class HumanTensors(NamedTuple):
    """State of one person in each world.

    The fields are those of `HumanState`, but arms, which always swing here, seats and hands.
    """

    xz: Tensor
    heading: Tensor
    distance: Tensor
    set_off: Tensor
    blend: Tensor

    @classmethod
    def of(cls, state: HumanState, device: torch.device | str, dtype: torch.dtype) -> Self:
        """The people on a device."""
        return cls(*_on_device([getattr(state, name) for name in cls._fields], device, dtype))

    def put(self, state: HumanState) -> None:
        """Copy them into arrays; this waits for the device."""
        for name, tensor in self._asdict().items():
            getattr(state, name)[:] = tensor.cpu().numpy()


def _on_device(arrays: list[np.ndarray], device: torch.device | str, dtype: torch.dtype) -> list[Tensor]:
    return [torch.tensor(array, dtype=dtype, device=device) for array in arrays]
