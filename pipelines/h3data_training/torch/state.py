"""Agents of `sim_kinematic.motion.state` as tensors on a device, with worlds on the first axis.

The step functions of `h3data_training.torch.step` take and return such states. Tensors are replaced, not changed in
place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from sim_kinematic.motion.state import HumanState, RobotState


class RobotTensors(NamedTuple):
    """State of one robot in each world, without its joints; see `RobotState`."""

    xz: Tensor
    """Positions on the floor (x, z) [W, 2] [m]."""
    heading: Tensor
    """Headings [W] [rad], which are not wrapped."""
    contact: Tensor
    """True if the base touches something, bool [W]."""

    @classmethod
    def of(cls, state: RobotState, device: torch.device | str, dtype: torch.dtype) -> Self:
        """Return robots copied to a device."""
        xz, heading = _on_device([state.xz, state.heading], device, dtype)
        return cls(xz, heading, torch.tensor(state.contact, device=device))

    def put(self, state: RobotState) -> None:
        """Copy the robots into arrays; this waits for the device."""
        for array, tensor in zip([state.xz, state.heading, state.contact], self, strict=True):
            array[:] = tensor.cpu().numpy()


class HumanTensors(NamedTuple):
    """State of one person in each world.

    The fields are those of `HumanState` without arms, which always swing here, seats and hands.
    """

    xz: Tensor
    heading: Tensor
    distance: Tensor
    set_off: Tensor
    blend: Tensor

    @classmethod
    def of(cls, state: HumanState, device: torch.device | str, dtype: torch.dtype) -> Self:
        """Return people copied to a device."""
        return cls(*_on_device([getattr(state, name) for name in cls._fields], device, dtype))

    def begun(self, start: Tensor, fresh: Tensor) -> Self:
        """Return the people, who stand at their starts ``(x, z, heading)`` [..., W, 3] in worlds that are ``fresh`` [W]."""
        return type(self)(
            torch.where(fresh[:, None], start[..., :2], self.xz),
            torch.where(fresh, start[..., 2], self.heading),
            *(torch.where(fresh, 0.0, t) for t in self[2:]),
        )

    def put(self, state: HumanState) -> None:
        """Copy the people into arrays; this waits for the device."""
        for name, tensor in self._asdict().items():
            getattr(state, name)[:] = tensor.cpu().numpy()


def _on_device(arrays: list[np.ndarray], device: torch.device | str, dtype: torch.dtype) -> list[Tensor]:
    return [torch.tensor(array, dtype=dtype, device=device) for array in arrays]


def choose(flag: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return ``a`` in the worlds where ``flag`` [W] is True, and ``b`` in the others, both [W, ...]."""
    return torch.where(flag.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def tensors_of(parts: Iterable[Any]) -> Iterator[Tensor]:
    """Yield the tensors among the fields of a state and in their tuples and mappings, in a fixed order."""
    for part in parts:
        yield from part.values() if isinstance(part, Mapping) else part if isinstance(part, tuple) else (part,)
