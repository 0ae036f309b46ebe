"""Worlds in which an action is held for some steps: what is gained in them, and which episodes end."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class HeldSteps:
    """The part of a `h3data_training.ppo.Worlds` that all tasks share.

    A world whose episode ends on the way begins the next one at once; what it gains after that is not counted.
    """

    counts: tuple[str, ...]
    """Sums over worlds and steps that `totals` keeps."""
    play: Any
    """Where all worlds are; overwritten by every step."""
    hold: int

    def _make_totals(self, worlds: int, device: torch.device) -> None:
        self.gain = torch.zeros(worlds, device=device)
        self.over, self.timed_out, self.idle = (torch.zeros(worlds, dtype=torch.bool, device=device) for _ in range(3))
        self.totals = torch.zeros(len(self.counts), device=device)

    def _hold_action(self) -> None:
        """`hold` steps of all worlds, in place."""
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
            sums = sums + torch.stack([gained.sum(), *self._counted(before, live, ends)]).float()
            live = live & ~ends
            if k < self.hold - 1:
                inside, timed_out = inside | ends, timed_out | (ends & play.truncated)
        self.gain.copy_(gain)
        self.over.copy_(idle | inside)
        self.timed_out.copy_(timed_out)
        self.idle.copy_(idle)
        self.totals.add_(sums)

    def _step_held(self, k: int) -> Any:
        """Step ``k`` of an action, in place; returns what `_counted` has to know of the state before."""
        raise NotImplementedError

    def _long_enough(self) -> Tensor | None:
        """Worlds whose episodes are cut short as if their time were over, bool [W]; None: none are."""
        return None

    def _counted(self, before: Any, live: Tensor, ends: Tensor) -> list[Tensor]:
        """Sums of a step over the worlds that are ``live`` [W], and those whose episode has just ended, in the order of
        `counts` after the first, which is the reward."""
        raise NotImplementedError

    def _outcome(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As of `h3data_training.ppo.Worlds.held`, after the observations."""
        return self.gain.clone(), self.over.clone(), self.timed_out.clone(), self.idle.clone()
