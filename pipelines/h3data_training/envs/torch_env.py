"""Environment of W worlds as tensors on a device, which plays episodes of a bank, as one CUDA graph per step on a GPU.

The interface is that of Gymnasium's vector environments, which need not be installed. The autoreset mode is NEXT_STEP.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from h3data.errors import InputError
from h3data_training.torch.graph import can_fuse, captured, fused, overwrite
from h3data_training.torch.random import keys, random

if TYPE_CHECKING:
    from gymnasium.spaces import Space

Tensors = dict[str, Tensor]


class Playing(Protocol):
    """Protocol of the state of W worlds in their episodes."""

    @property
    def episode(self) -> Tensor:
        """Number of each world's episode in the bank, int64 [W]."""
        ...

    @property
    def ended(self) -> Tensor:
        """Return whether each world's episode is over, bool [W]."""
        ...

    @property
    def reward(self) -> Tensor:
        """Reward of the last step [W]."""
        ...

    @property
    def terminated(self) -> Tensor:
        """Return whether the rules have ended the episode, bool [W]."""
        ...

    @property
    def truncated(self) -> Tensor:
        """Return whether the time limit has ended the episode, bool [W]."""
        ...

    def tensors(self) -> Any:
        """Return all tensors of the state, in a fixed order."""
        ...


P = TypeVar("P", bound=Playing)


class TorchEnv(Generic[P]):
    """Base class of the environments of all tasks, which set ``play`` and ``bank``.

    Subclasses also define `_moved`, `_result` and `info`.
    """

    name: str
    """Name of the task."""
    bank: Any
    """Episodes that the environment plays."""
    play: P
    """State of all worlds; these tensors are overwritten by every step."""

    def __init__(
        self, num_envs: int, device: torch.device | str, *, graph: bool | None = None, compile: bool | None = None
    ) -> None:
        """Check the device and store the options.

        Args:
            num_envs: number of worlds W.
            device: device of all tensors: ``cuda``, ``cuda:1``, ``cpu``.
            graph: whether a step is captured as a CUDA graph; by default on a GPU.
            compile: whether its operations are fused (`h3data_training.torch.graph.fused`); by default on a GPU, if Triton is
                installed.

        Raises:
            InputError: the number of worlds is less than 1, or there is no such device.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise InputError(f"Expected at least 1 world, a whole number, got {num_envs!r}.", code="H3-ENV-015")
        self.num_envs, self.device = int(num_envs), checked_device(device)
        self._graph = self.device.type == "cuda" if graph is None else graph
        self._compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._move = fused(self._moved) if self._compiles else self._moved
        self._advance = self._eager
        self._begun = False

    # --- the interface ------------------------------------------------------------------------------------------------
    def reset(self, *, seed: int | Sequence[int] | None = None, options: Any = None) -> tuple[Any, Tensors]:
        """Start the next episode in all worlds.

        With a seed, worlds first move to the positions in the bank at which the runs seed, seed + 1, ..., or the listed
        runs, start. There are no ``options``.
        """
        if seed is None and not self._begun:
            seed = int.from_bytes(os.urandom(7), "little")
        with enough_memory(self.device, self.num_envs, self.name), torch.no_grad():
            if self._graph and self._advance == self._eager:
                self._advance = captured(self._eager, list(self.play.tensors()))
            if seed is not None:
                self.play.episode.copy_(places_in_bank(seed, self.num_envs, len(self.bank)) - 1)
            self.play.ended.fill_(True)
            self._forget_actions()
            self._advance()
        self._begun = True
        return self._result(), self.info()

    def info(self) -> Tensors:
        """Return data in addition to the observations, [W, ...] each."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing, as nothing needs closing."""

    # --- parts --------------------------------------------------------------------------------------------------------
    def _require_begun(self) -> None:
        if not self._begun:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")

    def _tensor(self, actions: Any, agent: str) -> Tensor:
        """Return the actions of an agent, which must be a tensor: an array would be copied to the device unnoticed.

        Raises:
            InputError: they are no tensor.
        """
        if not isinstance(actions, Tensor):
            raise InputError(
                f"The environment of {self.name} on {self.device} takes torch tensors, and the action of {agent} is "
                f"{type(actions).__name__}. Hint: torch.as_tensor(actions, device=env.device).",
                code="H3-ENV-058",
            )
        return actions

    def _stepped(self) -> tuple[Any, Tensor, Tensor, Tensor, Tensors]:
        """Return all worlds a step further, by the actions that are set."""
        with enough_memory(self.device, self.num_envs, self.name):
            self._advance()
        play = self.play
        ends = play.reward.to(torch.float32, copy=True), play.terminated.clone(), play.truncated.clone()
        return self._result(), *ends, self.info()

    def _keep(self, after: P) -> None:
        """Write a state over that of all worlds."""
        overwrite(self.play.tensors(), after.tensors())

    def _moved(self) -> Any:
        """Return a step of all worlds, in place, and what it shows; what is fused."""
        raise NotImplementedError

    def _eager(self) -> None:
        """Make a whole step, in place, which a graph captures."""
        raise NotImplementedError

    def _forget_actions(self) -> None:
        """Make the actions of the last step count for nothing in a new episode."""

    def _result(self) -> Any:
        """Return observations of the last step, in tensors of their own: a graph writes into the same ones again."""
        raise NotImplementedError

    # --- spaces, where Gymnasium is installed -------------------------------------------------------------------------
    @cached_property
    def single_action_space(self) -> Space[Any]:
        """Space of the action of one world."""
        raise NotImplementedError

    @cached_property
    def single_observation_space(self) -> Space[Any]:
        """Space of the observations of one world."""
        raise NotImplementedError

    @cached_property
    def action_space(self) -> Space[Any]:
        """Space of the actions of all worlds."""
        return self._of_all(self.single_action_space)

    @cached_property
    def observation_space(self) -> Space[Any]:
        """Space of the observations of all worlds."""
        return self._of_all(self.single_observation_space)

    def _of_all(self, space: Space[Any]) -> Space[Any]:
        from sim_kinematic.envs.stepper import gymnasium

        return gymnasium.vector.utils.batch_space(space, self.num_envs)


@contextmanager
def enough_memory(device: Any, worlds: int, task: str) -> Iterator[None]:
    """Turn a lack of memory on a device, within a block, into an `InputError` that names the number of worlds.

    Raises:
        InputError: its memory does not suffice.
    """
    try:
        yield
    except (
        RuntimeError,
        MemoryError,
    ) as fault:  # torch's own error of a GPU is a RuntimeError, that of a CPU nothing more
        if not isinstance(fault, torch.OutOfMemoryError | MemoryError) and "allocate memory" not in str(fault):
            raise
        raise InputError(
            f"There is no memory on {device} for {worlds} worlds of {task} with the robot's observations. Hint: fewer "
            "worlds, episodes or pixels.",
            code="H3-ENV-037",
        ) from fault


def checked_device(device: torch.device | str) -> torch.device:
    """Return the torch device with a name.

    Raises:
        InputError: this build of torch cannot use a device of this name.
    """
    try:
        chosen = torch.device(device)
    except RuntimeError as fault:
        raise InputError(f"Unknown device {device!r}. Expected cpu, cuda or cuda:N.", code="H3-ENV-017") from fault
    if chosen.type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "There is no GPU that this torch can use. Hint: device='cpu', or leave out device.", code="H3-ENV-013"
        )
    return chosen


def places_in_bank(seed: int | Sequence[int], worlds: int, episodes: int) -> Tensor:
    """Return the bank's episode at which each world starts, [W], for the runs seed, seed + 1, ..., or the listed runs.

    Raises:
        InputError: there is neither one seed nor one for each world.
    """
    seeds = [int(seed) + w for w in range(worlds)] if isinstance(seed, int | np.integer) else list(seed)
    if len(seeds) != worlds:
        raise InputError(f"Expected one seed, or one for each of {worlds} worlds, got {len(seeds)}.", code="H3-ENV-014")
    drawn = random(keys(seeds, "bank", device="cpu"), torch.zeros(worlds, dtype=torch.int64), 1)[:, 0]
    return (drawn * episodes).long()
