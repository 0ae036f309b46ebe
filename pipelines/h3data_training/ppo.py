"""Recurrent proximal policy optimisation (Schulman et al. 2017) on rollouts that stay on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from h3data_training.networks import actor_numbers, critic_numbers, network
from h3data_training.ranks import Ranks
from h3data_training.settings import Settings
from h3data_training.torch.graph import captured, keep_row, overwrite

RANK_SEED = 1_000_003
"""Difference between the seeds of exploration noise of two processes."""
BEYOND = 1.2
"""Absolute value above which mean actions are penalised, because commands beyond their limits have no effect and
therefore no gradient.
"""


class Worlds(Protocol):
    """Protocol of W worlds in which an action is repeated for several steps, and which start new episodes."""

    num_envs: int
    device: torch.device
    totals: Tensor
    """Sums over worlds and steps, in the order of `counts`."""
    counted: Tensor
    """True for worlds that are counted in `totals`, bool [W]; overwritten by the learner."""

    @property
    def shown(self) -> Tensor | None:
        """True for worlds in which the teacher acts as long as it has a weight, bool [W]; None for no world."""
        ...

    @property
    def counts(self) -> tuple[str, ...]:
        """Names of the sums that `step` returns, with the reward first."""
        ...

    @property
    def play(self) -> Any:
        """State of all worlds; it has ``tensors()`` and ``terminated`` [W]."""
        ...

    def reset(self, *, seed: Sequence[int]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Start episodes in all worlds; return the observations of the actor and of the critic."""
        ...

    def repeat_action(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Advance all worlds by several steps of an action [W, A].

        Returns:
            Observations, the reward [W], whether a new episode started in these steps [W], whether the episode before
                it reached its time limit [W], and whether the action had no effect because the episode was already over
                [W].
        """
        ...

    def repeat_action_in_place(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Perform `repeat_action` operation by operation, so that a CUDA graph can capture it.

        Each call overwrites the same tensors.
        """
        ...

    def taught(self) -> Tensor:
        """Return the actions of a teacher in the current states, [W, A]."""
        ...

    def figures(self, total: dict[str, float]) -> dict[str, float]:
        """Return columns of the learning curve that are computed from the totals, by name."""
        ...


@dataclass(frozen=True, eq=False)
class Memory:
    """State that is carried from one decision to the next in W worlds, as tensors that are written in place."""

    shown: dict[str, Tensor]
    state: Tensor
    """Recurrent state of the network, [W, S]."""
    last: Tensor
    """Last action, clipped, [W, A]; 0 in worlds where an episode has started since."""
    over: Tensor
    """True if an episode started in the last decision, bool [W]."""

    def tensors(self) -> list[Tensor]:
        """Return all tensors, in a fixed order."""
        return [*self.shown.values(), self.state, self.last, self.over]


class Schedule(NamedTuple):
    """Rates and weights that change over a run."""

    rate: float
    gamma: float
    """Discount of one decision."""
    acts: bool = True
    """True if the actor learns; False if only the critic does, which is new if the actor is pretrained."""
    teacher: float = 0.0
    """Weight of imitating the actions of a teacher."""


def schedule(settings: Settings, share: float, update: int) -> Schedule:
    """Return the schedule before update number ``update``, at a given share of the run (0..1)."""
    s = settings
    acting = update - s.critic_updates
    warm = min(1.0, (acting + 1) / max(s.warmup_updates, 1)) if acting >= 0 else 1.0
    teacher = s.teacher * max(1 - share / s.teacher_end, 0.0)
    ahead = s.horizon[0] + share * (s.horizon[1] - s.horizon[0])
    return Schedule(s.rate * (1 - (1 - s.rate_end) * share) * warm, 1 - s.hold / ahead, acting >= 0, teacher)


class Learner:
    """Actor, critic, optimizer and rollout buffers of one run.

    In a run of several processes, each process has a learner with its share of the worlds, and all learners compute the
    same weights.
    """

    def __init__(self, settings: Settings, worlds: Worlds, *, seed: int, ranks: Ranks | None = None) -> None:
        self.settings, self.worlds = settings, worlds
        self.ranks = ranks or Ranks()
        device = worlds.device
        torch.manual_seed(seed)  # initial weights, the same in every process
        self.generator = torch.Generator(device).manual_seed(seed + RANK_SEED * self.ranks.rank)
        self.net = network(settings).to(device)
        fused = True if device.type == "cuda" else None
        self.optimizer = torch.optim.Adam(self.net.parameters(), settings.rate, eps=1e-5, fused=fused)
        count = worlds.num_envs
        first = self.ranks.rank * count
        self.memory = Memory(
            shown=worlds.reset(seed=[seed + first + w for w in range(count)])[0],
            state=torch.zeros(count, self.net.state_length, device=device),
            last=torch.zeros(count, settings.actions, device=device),
            over=torch.zeros(count, dtype=torch.bool, device=device),
        )
        self._kept: dict[str, Tensor] = {}
        self._over = torch.zeros_like(self.memory.over)
        """Input of the critic: whether the episode is over."""
        self._noise = torch.zeros_like(self.memory.last)
        self._row = torch.zeros(1, dtype=torch.int64, device=device)
        """Row of the buffers that the next decision fills."""
        self._shown = worlds.shown if settings.teacher > 0 and worlds.shown is not None and worlds.shown.any() else None
        """Worlds in which the teacher acts, bool [W]; None if it acts in none."""
        self._decide = {taught: self._decision(taught) for taught in {False, settings.teacher > 0}}

    def update(self, plan: Schedule) -> dict[str, float]:
        """Collect one rollout, update the networks from it, and return a row of the learning curve."""
        for group in self.optimizer.param_groups:
            group["lr"] = plan.rate
        self.worlds.totals.zero_()
        if self._shown is not None:
            self.worlds.counted.copy_(~self._shown | (plan.teacher == 0))
        first = self.memory.state.clone()
        last = self._collect(plan)
        advantages, targets, explained = self._advantages(last, plan.gamma)
        learned = self._learn(first, advantages, targets, plan)
        total = dict(zip(self.worlds.counts, self.ranks.sum(self.worlds.totals).tolist(), strict=True))
        return {
            **self.worlds.figures(total),
            "explained": explained,
            **learned,
            "std": float(self.net.std().detach().mean()),
            "rate": plan.rate,
            "gamma": plan.gamma,
        }

    # --- collecting -------------------------------------------------------------------------------------------------------
    def _inputs(self, over: Tensor) -> dict[str, Tensor]:
        shown, s = self.memory.shown, self.settings
        found = {
            "numbers": actor_numbers(shown, self.memory.last, s.observations),
            "critic_obs": critic_numbers(shown, over, s.critic),
        }
        return found | ({"pixels": self.net.pixels(shown[self.net.sees])} if self.net.sees else {})

    def _decision(self, taught: bool) -> Callable[[], None]:
        """Make the decision of `_decided`, on a GPU as one CUDA graph: network, worlds, pictures and buffers."""

        def decide() -> None:
            self._decided(taught)

        if self.worlds.device.type != "cuda":
            return decide
        own = [*self.memory.tensors(), self._over, self._row, self.worlds.totals, *self.worlds.play.tensors()]
        with torch.no_grad():
            return captured(decide, own)

    @torch.no_grad()
    def _collect(self, plan: Schedule) -> dict[str, Tensor]:
        """Fill the buffers with one rollout; return the inputs of the decision after it."""
        s = self.settings
        self._row.zero_()
        self._over.copy_(self.memory.over)
        decide = self._decide[plan.teacher > 0]
        for _ in range(s.rollout):
            self._noise.normal_(generator=self.generator)
            decide()
        # rewards are paid per step and scaled so that values stay near what one step pays, whatever the horizon
        self._kept["gain"].mul_((1 - plan.gamma) / s.hold)
        return self._inputs(self._over)

    def _decided(self, taught: bool) -> None:
        """Make a decision of all worlds, and write it and its result into memory and a row of the buffers."""
        s, m, std = self.settings, self.memory, self.net.std()
        x = self._inputs(self._over)
        mean, state = self.net.step(x.get("pixels"), x["numbers"], m.state)
        action = mean + std * self._noise
        row = x | {
            "action": action,
            "mean": mean,
            "begins": m.over,
            "log_prob": (-0.5 * self._noise.square() - std.log()).sum(1),
        }
        if s.near_m > 0:
            row["far"] = m.shown["way"][:, 0] > s.near_m
        own = ~torch.zeros_like(m.over)
        if taught:
            row["taught"] = self.worlds.taught()
            if self._shown is not None:
                # a little noise, so that it is seen to correct itself
                action = torch.where(self._shown[:, None], row["taught"] + s.least_std * self._noise, action)
                own = ~self._shown
        keep_row(self._kept, self._row, row, rows=s.rollout)
        shown, gain, over, timed_out, idle = self.worlds.repeat_action_in_place(action)
        after = {"gain": gain, "over": over, "timed_out": timed_out, "valid": ~idle & own}
        keep_row(self._kept, self._row, after, rows=s.rollout)
        self._row.add_(1).remainder_(s.rollout)
        going = ~over[:, None]
        overwrite(m.shown.values(), (shown[name] for name in m.shown))
        overwrite((m.state, m.last, m.over), (state * going, action.clamp(-1, 1) * going, over))
        self._over.copy_(self.worlds.play.terminated)

    @torch.no_grad()
    def _advantages(self, last: dict[str, Tensor], gamma: float) -> tuple[Tensor, Tensor, float]:
        """Return scaled advantage estimates (Schulman et al. 2016), targets of the critic, and its explained variance.

        A truncated episode would have gone on as it was.
        """
        kept, s = self._kept, self.settings
        value = self.net.value_head(torch.cat([kept["critic_obs"], last["critic_obs"][None]])).squeeze(-1)
        going = (~kept["over"]).float()
        gain = kept["gain"] + gamma * (value[1:] * going + value[:-1] * kept["timed_out"]) - value[:-1]
        for t in reversed(range(len(gain) - 1)):
            gain[t] += gamma * s.gae_lambda * going[t] * gain[t + 1]
        target, valid = gain + value[:-1], kept["valid"].float()
        scaled, parts = torch.zeros_like(gain), [valid]
        if s.near_m > 0:
            parts = [kept["far"] * valid, ~kept["far"] * valid]
        for part in parts:
            count, total = self.ranks.sum(torch.stack([part.sum(), (gain * part).sum()]))
            count = count.clamp_min(1)
            middle = total / count
            spread = (self.ranks.sum(((gain - middle).square() * part).sum()) / count).sqrt()
            scaled += part * (gain - middle) / (spread + 1e-4)
        variance = self.ranks.variance
        explained = 1 - variance(gain * valid) / variance(target * valid).clamp_min(1e-8)
        return scaled, target, float(explained)

    # --- learning ---------------------------------------------------------------------------------------------------------
    def _learn(self, first: Tensor, advantages: Tensor, targets: Tensor, plan: Schedule) -> dict[str, float]:
        s, net, kept, acts = self.settings, self.net, self._kept, plan.acts
        parameters = list(net.parameters())
        device, valid = first.device, kept["valid"].float()
        sums = torch.zeros(4, device=device)
        for _ in range(s.epochs):
            order = torch.randperm(len(first), generator=self.generator, device=device)
            for rows in order.split(len(first) // s.minibatches):
                x = {n: kept[n][:, rows] for n in ("numbers", "critic_obs", "action", "begins", "log_prob", "mean")}
                pixels = kept["pixels"][:, rows].flatten(0, 1) if net.sees else None
                features = net.features(pixels, x["numbers"].flatten(0, 1)).view(s.rollout, len(rows), -1)
                state = net.roll(features, first[rows], x["begins"])
                mean, std = net.head(state, x["numbers"]), net.std()
                log_prob = (-0.5 * ((x["action"] - mean) / std).square() - std.log()).sum(-1)
                ratio, gain = (log_prob - x["log_prob"]).exp(), advantages[:, rows]
                clipped = ratio.clamp(1 - s.clip, 1 + s.clip)
                worth = (torch.minimum(ratio * gain, clipped * gain) * valid[:, rows]).mean()
                wrong = (net.value_head(x["critic_obs"]).squeeze(-1) - targets[:, rows]).square()
                # what the teacher gains is no estimate of what the policy will
                wrong = (wrong * valid[:, rows] if self._shown is not None and plan.teacher else wrong).mean()
                guess = F.smooth_l1_loss(
                    net.auxiliary(state if acts else state.detach()), x["critic_obs"][..., :-1], beta=0.5
                )
                beyond = (mean.abs() - BEYOND).clamp_min(0).square().mean()
                loss = wrong + s.auxiliary * guess
                if acts:
                    loss = wrong - worth - s.entropy * std.log().sum() + s.auxiliary * guess + 0.01 * beyond
                if plan.teacher:
                    loss = loss + plan.teacher * (mean - kept["taught"][:, rows]).square().sum(-1).mean()
                self.optimizer.zero_grad(set_to_none=True)
                loss.backward()
                self.ranks.average_gradients(parameters)
                nn.utils.clip_grad_norm_(parameters, s.gradient_norm)
                self.optimizer.step()
                with torch.no_grad():
                    moved = ((mean - x["mean"]) / std).square().sum(-1).mean() / 2
                    outside = ((ratio - 1).abs() > s.clip).float().mean()
                    sums += torch.stack([wrong.detach(), guess.detach(), moved, outside])
        names = ("value_loss", "auxiliary_loss", "kl", "clipped")
        return dict(zip(names, (self.ranks.mean(sums) / (s.epochs * s.minibatches)).tolist(), strict=True))
