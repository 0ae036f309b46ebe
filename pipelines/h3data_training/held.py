"""Worlds in which an action is repeated for several steps, with sums of rewards and of ended episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from h3data_training.envs.torch_env import places_in_bank
from h3data_training.torch.graph import captured


class ActionRepeat:
    """Base class of `h3data_training.ppo.Worlds` for all tasks.

    A world whose episode ends during these steps starts the next one at once; rewards after that are not counted.
    """

    counts: tuple[str, ...]
    """Names of the sums over worlds and steps that `totals` accumulates."""
    sim: Any
    """Worlds as tensors, whose ``bank`` has the episodes that they play."""
    play: Any
    """State of all worlds; overwritten by every step."""
    shown: Tensor | None = None
    """Worlds in which a teacher acts as long as it has a weight, bool [W]; None for no world."""
    _action: Tensor
    _shown: dict[str, Tensor]
    """Observations of the last call of `_eager`."""

    def __init__(self, hold: int, worlds: int, device: torch.device | str) -> None:
        """Create sums for ``worlds`` worlds, in which an action is repeated for ``hold`` steps."""
        self.hold, self.num_envs, self.device = hold, worlds, torch.device(device)
        self._advance = self._eager
        """`_eager`, or the CUDA graph that was captured of it."""
        self.gain = torch.zeros(worlds, device=self.device)
        self.over, self.timed_out, self.idle = (
            torch.zeros(worlds, dtype=torch.bool, device=self.device) for _ in range(3)
        )
        self.totals = torch.zeros(len(self.counts), device=self.device)
        self.counted = torch.ones(worlds, dtype=torch.bool, device=self.device)
        """Worlds that `totals` counts, bool [W]: not those in which a teacher acts."""

    def repeat_action(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Advance all worlds by a repeated action [W, A], and return new tensors as `Worlds.repeat_action` does."""
        with torch.no_grad():
            self._action.copy_(action)
            self._advance()
        return self._result(), self.gain.clone(), self.over.clone(), self.timed_out.clone(), self.idle.clone()

    def repeat_action_in_place(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Perform `repeat_action` operation by operation, so that a CUDA graph can capture it.

        Each call overwrites the same tensors.
        """
        own = self._shown  # where a graph of these worlds alone writes
        self._action.copy_(action)
        self._eager()
        shown, self._shown = self._shown, own
        return shown, self.gain, self.over, self.timed_out, self.idle

    def _eager(self) -> None:
        """Carry out an action of all worlds and show its result, in place."""
        raise NotImplementedError

    def _result(self) -> dict[str, Tensor]:
        """Return observations of the last step, in tensors of their own."""
        return {name: tensor.clone() for name, tensor in self._shown.items()}

    def _begin(self, seed: int | Sequence[int]) -> None:
        """Let the next step begin an episode in each world, at the place in the bank that follows from its seed."""
        if self.device.type == "cuda" and self._advance == self._eager:
            self._advance = captured(self._eager, list(self.play.tensors()))
        self.play.episode.copy_(places_in_bank(seed, self.num_envs, len(self.sim.bank)) - 1)
        self.play.ended.fill_(True)
        self._action.zero_()

    def _hold_action(self) -> None:
        """Make `hold` steps of all worlds, in place."""
        play = self.play
        idle, timed_out = play.ended.clone(), play.ended & play.truncated
        live, inside = ~idle, torch.zeros_like(idle)
        gain, sums = torch.zeros_like(self.gain), torch.zeros_like(self.totals)
        for k in range(self.hold):
            before = self._step_held(k)
            if (enough := self._long_enough()) is not None:
                enough = ~play.ended & enough
                play.truncated.logical_or_(enough)
                play.ended.logical_or_(enough)
            ends = live & play.ended
            gained = torch.where(live, play.reward.float(), 0.0)
            gain = gain + gained
            own = self.counted
            counted = [(gained * own).sum(), *self._counted(before, live & own, ends & own)]
            sums = sums + torch.stack(counted).float()
            live = live & ~ends
            if k < self.hold - 1:
                inside, timed_out = inside | ends, timed_out | (ends & play.truncated)
        self.gain.copy_(gain)
        self.over.copy_(idle | inside)
        self.timed_out.copy_(timed_out)
        self.idle.copy_(idle)
        self.totals.add_(sums)

    def _step_held(self, k: int) -> Any:
        """Play step ``k`` of an action, in place, and return what `_counted` needs of the state before it."""
        raise NotImplementedError

    def _long_enough(self) -> Tensor | None:
        """Return the worlds whose episodes are cut short as if their time were over, bool [W]; None if none are."""
        return None

    def _counted(self, before: Any, live: Tensor, ends: Tensor) -> list[Tensor]:
        """Return sums over the worlds that are ``live`` [W] in a step, in the order of `counts` after the first, the reward.

        ``ends`` are the worlds whose episode has just ended.
        """
        raise NotImplementedError
