"""Recurrent proximal policy optimisation (Schulman et al. 2017) of one agent that chooses skills.

A decision lasts for a variable number of simulated steps, by which later rewards are discounted (Sutton et al. 1999).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from h3data_training.populations.networks import Chooser, guessed_columns
from h3data_training.populations.playing import Decisions
from h3data_training.populations.settings import ROBOT, PopulationSettings
from h3data_training.torch.graph import captured, overwrite
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.policies.choosers.chooser_network import KIND, SkillPolicyNetwork
from sim_kinematic.policies.visual_policy import PolicyCard
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange

LEARNED_FROM = (
    "each",
    "rest",
    "pictures",
    "allowed",
    "chosen",
    "log_prob",
    "critic_obs",
    "advantage",
    "target",
    "guessed",
)
"""Names of the columns of a minibatch."""


class Plan(NamedTuple):
    """Rates and weights that change over a run."""

    rate: float
    entropy: float
    acts: bool = True
    """True if the actor learns, False if only the critic does."""


def plan_at(settings: PopulationSettings, share: float, update: int) -> Plan:
    """Return the plan before update number ``update``, at a given share of the run (0..1)."""
    s = settings
    rate, entropy = s.rate * (1 - (1 - s.rate_end) * share), s.entropy * (1 - (1 - s.entropy_end) * share)
    return Plan(rate, entropy, update >= s.critic_updates)


class ChooserLearner:
    """Actor, critic and optimizer of one agent."""

    def __init__(
        self, settings: PopulationSettings, name: str, *, seed: int, device: torch.device | str = "cpu"
    ) -> None:
        self.settings, self.name, self.seed = settings, name, seed
        self.agent = ROBOT if name == ROBOT else "human"
        self.objects = RearrangeSpec.objects
        torch.manual_seed(episode_seed(seed, settings.learners.index(name)))  # initial weights
        self.device = torch.device(device)
        self.net = Chooser(settings, agent=self.agent, objects=self.objects).to(self.device)
        self._on_gpu = self.device.type == "cuda"
        self._rate, self._entropy = (torch.tensor(x, device=self.device) for x in (settings.rate, settings.entropy))
        self._acts = torch.ones((), device=self.device)
        self.optimizer = torch.optim.Adam(self.net.parameters(), self._rate, eps=1e-5, capturable=self._on_gpu)
        self._x: dict[str, Tensor] = {}
        """The minibatch that a gradient step learns from."""
        self._means = torch.zeros(5, device=self.device)
        """Means over the minibatch: losses of the critic and of guesses, entropy, KL divergence, share of clipped
        ratios."""
        self._step: Callable[[], None] = self._eager

    @property
    def state(self) -> dict[str, Any]:
        """State of weights and optimizer for a checkpoint, which consists of numbers only."""
        return {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore weights and optimizer from a `state`, which may come from another device.

        Raises:
            KeyError: a part of the state is missing.
            RuntimeError, ValueError: a part of the state has the wrong shape.
        """
        self.net.load_state_dict(state["net"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._step = self._eager  # a graph would go on with what Adam remembered before
        for group in self.optimizer.param_groups:
            group["lr"], group["capturable"] = self._rate, self._on_gpu
        for kept in self.optimizer.state.values():
            kept["step"] = kept["step"].to(self.device)

    def network(self, training: dict | None = None) -> SkillPolicyNetwork:
        """Return the policy in its current state."""
        s = self.settings
        card = PolicyCard(
            task=Rearrange.name,
            robot=s.robot,
            observations=s.observations_of(self.agent),
            picture_size=s.picture_size if self.net.sees else None,
            hold=s.think_steps,
            temperature=s.temperature if self.agent == ROBOT else 1.0,
            network=KIND,
            agent=self.agent,
            objects=self.objects,
            primitives=self.agent != ROBOT or "primitives" not in s.without,
            training=training or {},
        )
        return SkillPolicyNetwork(card=card, arrays=self.net.arrays())

    def update(self, decisions: Decisions, plan: Plan, *, update: int) -> dict[str, float]:
        """Update the networks from decisions, and return losses by name."""
        s = self.settings
        for tensor, value in ((self._rate, plan.rate), (self._entropy, plan.entropy), (self._acts, float(plan.acts))):
            tensor.fill_(value)
        x = {
            f.name: torch.as_tensor(getattr(decisions, f.name), device=self.device)
            for f in fields(decisions)
            if f.name != "partners"
        }
        counts = x.pop("counts")
        critic_obs = self._critic_obs(x, counts, decisions.partners)
        with torch.no_grad():
            value = self.net.value_head(critic_obs).squeeze(-1)
        advantage = advantages(x["gain"] * s.reward_scale, x["discount"], value, counts, lam=s.gae_lambda)
        target, spread = advantage + value, advantage.std(correction=0) + 1e-4
        x["guessed"] = x["told"][:, guessed_columns(self.agent, self.objects) if self.net.sees else []]
        x |= {"critic_obs": critic_obs, "target": target, "advantage": (advantage - advantage.mean()) / spread}
        at, valid = chunks_of(counts, s.chunk)
        states = x["state"][at[0]]
        batch = {name: x[name][at] for name in LEARNED_FROM} | {"valid": valid.float()}
        batch["allowed"] |= ~valid[..., None]
        size = s.minibatch_of(self.name)
        sums, count, moved = np.zeros(5), 0, 0.0
        for epoch in range(s.epochs):
            if moved > s.kl_most:
                break
            rng = generator(self.seed, f"minibatches/{self.name}", step=update * s.epochs + epoch)
            order = torch.as_tensor(rng.permutation(at.shape[1]), device=self.device)
            missing = order.new_full((-len(order) % size,), -1)
            found = [self._learned(batch, states, rows) for rows in torch.cat([order, missing]).split(size)]
            means = torch.stack(found).double().cpu().numpy()
            sums, count, moved = sums + means.sum(0), count + len(means), float(means.mean(0)[3])
        explained = 1 - float(advantage.var()) / max(float(target.var()), 1e-8)
        names = ("value_loss", "guess_loss", "entropy", "kl", "clipped")
        last = {"kl": moved, "explained": explained, "gradient_steps": count}
        return dict(zip(names, (sums / count).tolist(), strict=True)) | last

    def _learned(self, batch: Mapping[str, Tensor], states: Tensor, rows: Tensor) -> Tensor:
        """Return a gradient step with chunks of these numbers, -1 for none, and its means [5]."""
        x = {name: t[:, rows] for name, t in batch.items()} | {"state": states[rows]}
        x["valid"] = x["valid"] * (rows >= 0)
        if self._on_gpu and self._x:
            overwrite(self._x.values(), x.values())
        else:
            self._x = x
        if self._on_gpu and self._step == self._eager:
            self._step = captured(self._eager, [*(t.detach() for t in self.net.parameters()), *self._moments()])
        self._step()
        return self._means.clone()

    def _moments(self) -> list[Tensor]:
        """Return moments of Adam, made here where its first step would make them: a graph needs them before."""
        for weight in self.net.parameters():
            if not self.optimizer.state[weight]:
                zeros = {name: torch.zeros_like(weight) for name in ("exp_avg", "exp_avg_sq")}
                self.optimizer.state[weight] = {"step": torch.zeros((), device=self.device), **zeros}
        return [t for kept in self.optimizer.state.values() for t in kept.values()]

    def _eager(self) -> None:
        """Make a gradient step, operation by operation, so that a CUDA graph can capture it."""
        s, net, x = self.settings, self.net, self._x
        valid = x["valid"]
        total = valid.sum()
        scores, known = net(x["each"], x["rest"], x["state"], x["pictures"])
        log_probs = scores.masked_fill(~x["allowed"], -torch.inf).log_softmax(-1)
        log_prob = log_probs.gather(-1, x["chosen"][..., None]).squeeze(-1)
        entropy = -(log_probs.exp() * log_probs.masked_fill(~x["allowed"], 0.0)).sum(-1)
        moved = (log_prob - x["log_prob"]) * valid
        ratio, gain = moved.exp(), x["advantage"]
        worth = torch.minimum(ratio * gain, ratio.clamp(1 - s.clip, 1 + s.clip) * gain)
        wrong = ((net.value_head(x["critic_obs"]).squeeze(-1) - x["target"]).square() * valid).sum() / total
        guess = torch.zeros_like(wrong)
        if net.sees and s.guess:
            off = F.binary_cross_entropy_with_logits(net.guess(known), x["guessed"], reduction="none").mean(-1)
            guess = (off * valid).sum() / total
        loss = wrong + s.guess * guess - self._acts * ((worth + self._entropy * entropy) * valid).sum() / total
        self.optimizer.zero_grad(set_to_none=False)
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), s.gradient_norm)
        self.optimizer.step()
        with torch.no_grad():
            outside = ((ratio - 1).abs() > s.clip).float()
            parts = (entropy, (ratio - 1) - moved, outside)
            self._means.copy_(torch.stack([wrong, guess, *((t * valid).sum() / total for t in parts)]))

    def _critic_obs(self, x: Mapping[str, Tensor], counts: Tensor, partners: Sequence[str]) -> Tensor:
        """Return the inputs of the critic, which include who the partner is, [D, n]."""
        number = torch.tensor([self.settings.partners.index(name) for name in partners], device=self.device)
        one = nn.functional.one_hot(number.repeat_interleave(counts), len(self.settings.partners))
        return torch.cat([x["each"].flatten(1), x["rest"], x["told"], one.float()], 1)


def advantages(gain: Tensor, discount: Tensor, value: Tensor, counts: Tensor, *, lam: float) -> Tensor:
    """Compute generalised advantage estimates [D] of decisions of different durations (Schulman et al. 2016).

    ``counts`` are the numbers of decisions in each of E episodes.
    """
    found = gain + discount * value.roll(-1) - value  # after the last of an episode the discount is 0
    at, valid = chunks_of(counts, int(counts.max()))
    rows, kept = found[at] * valid, discount[at] * valid * lam
    for k in reversed(range(len(rows) - 1)):
        rows[k] += kept[k] * rows[k + 1]
    return found.index_put((at[valid],), rows[valid])


def chunks_of(counts: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Split the decisions of E episodes into chunks of consecutive decisions.

    Returns the numbers of the decisions [length, C], and a mask of those that exist, bool [length, C]. The last chunk
    of an episode may be shorter; its last number is then repeated. ``counts`` [E] are the numbers of decisions in each
    episode.
    """
    chunks = (counts + length - 1) // length
    ends = counts.cumsum(0)
    end = ends.repeat_interleave(chunks)
    before = torch.arange(len(end), device=counts.device) - (chunks.cumsum(0) - chunks).repeat_interleave(chunks)
    start = (ends - counts).repeat_interleave(chunks) + before * length
    at = start + torch.arange(length, device=counts.device)[:, None]
    return torch.minimum(at, end - 1), at < end
