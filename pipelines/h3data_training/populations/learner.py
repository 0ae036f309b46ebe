"""Recurrent proximal policy optimisation (Schulman et al. 2017) of one agent that chooses skills.

A decision takes as many simulated steps as it takes; what comes after it is discounted by that (Sutton et al. 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from h3data_training.populations.networks import Chooser
from h3data_training.populations.playing import Decisions
from h3data_training.populations.settings import ROBOT, PopulationSettings
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.policies.choosers.chooser_network import KIND, ChooserNetwork
from sim_kinematic.policies.pictured import PolicyCard
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec


class Plan(NamedTuple):
    """Rates and weights that change over a run."""

    rate: float
    entropy: float
    acts: bool = True
    """Whether the actor learns, or only the critic."""


def plan_at(settings: PopulationSettings, share: float, update: int) -> Plan:
    """At a share of the run, 0..1, before update number ``update``."""
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
        self.optimizer = torch.optim.Adam(self.net.parameters(), settings.rate, eps=1e-5)

    def network(self, training: dict | None = None) -> ChooserNetwork:
        """The policy so far."""
        s = self.settings
        card = PolicyCard(
            task="rearrange", robot=s.robot, observations=s.observations_of(self.agent), picture_size=None,
            hold=s.think_steps, network=KIND, agent=self.agent, objects=self.objects,
            primitives=self.agent != ROBOT or "primitives" not in s.without, training=training or {},
        )  # fmt: skip
        return ChooserNetwork(card=card, arrays=self.net.arrays())

    def update(self, played: Sequence[tuple[str, Decisions]], plan: Plan, *, update: int) -> dict[str, float]:
        """Learns from episodes, each with its partner; returns losses by name."""
        s = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = plan.rate
        told = [self._told(partner, decisions) for partner, decisions in played]
        with torch.no_grad():
            values = (
                self.net.worth(torch.cat(told).to(self.device)).squeeze(-1).cpu().split([len(d) for _, d in played])
            )
        advantages, targets = [], []
        for (_, decisions), value in zip(played, values, strict=True):
            advantage = _advantages(decisions, value.numpy(), scale=s.reward_scale, lam=s.gae_lambda)
            advantages.append(advantage)
            targets.append(advantage + value.numpy())
        every = np.concatenate(advantages)
        middle, spread = float(every.mean()), float(every.std()) + 1e-4
        chunks = [
            chunk
            for (_, decisions), known, advantage, target in zip(played, told, advantages, targets, strict=True)
            for chunk in _chunks(decisions, known, (advantage - middle) / spread, target, length=s.chunk)
        ]
        rows = {name: torch.stack([chunk[name] for chunk in chunks], 1) for name in chunks[0] if name != "state"}
        batch = {name: tensor.to(self.device) for name, tensor in rows.items()}
        states = torch.stack([chunk["state"] for chunk in chunks]).to(self.device)
        sums, count, moved = np.zeros(4), 0, 0.0
        for epoch in range(s.epochs):
            if moved > s.kl_most:
                break
            rng = generator(self.seed, f"minibatches/{self.name}", step=update * s.epochs + epoch)
            order = torch.as_tensor(rng.permutation(len(chunks)), device=self.device)
            parts = order.split(s.chunks_per_minibatch)
            means = [self._step({n: t[:, rows] for n, t in batch.items()}, states[rows], plan) for rows in parts]
            sums, count, moved = sums + sum(means), count + len(means), float(np.mean(means, 0)[2])
        target = np.concatenate(targets)
        explained = 1 - float(every.var()) / max(float(target.var()), 1e-8)
        names = ("value_loss", "entropy", "kl", "clipped")
        last = {"kl": moved, "explained": explained, "gradient_steps": count}
        return dict(zip(names, (sums / count).tolist(), strict=True)) | last

    def _step(self, x: dict[str, Tensor], state: Tensor, plan: Plan) -> np.ndarray:
        s, net, valid = self.settings, self.net, x["valid"]
        total = valid.sum()
        scores = net(x["each"], x["rest"], state).masked_fill(~x["allowed"], -torch.inf)
        log_probs = scores.log_softmax(-1)
        log_prob = log_probs.gather(-1, x["chosen"][..., None]).squeeze(-1)
        entropy = -(log_probs.exp() * log_probs.masked_fill(~x["allowed"], 0.0)).sum(-1)
        moved = (log_prob - x["log_prob"]) * valid
        ratio, gain = moved.exp(), x["advantage"]
        worth = torch.minimum(ratio * gain, ratio.clamp(1 - s.clip, 1 + s.clip) * gain)
        wrong = ((net.worth(x["told"]).squeeze(-1) - x["target"]).square() * valid).sum() / total
        loss = wrong
        if plan.acts:
            loss = wrong - ((worth + plan.entropy * entropy) * valid).sum() / total
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), s.gradient_norm)
        self.optimizer.step()
        with torch.no_grad():
            outside = ((ratio - 1).abs() > s.clip).float()
            means = [((t * valid).sum() / total).item() for t in (entropy, (ratio - 1) - moved, outside)]
        return np.array([wrong.item(), *means])

    def _told(self, partner: str, decisions: Decisions) -> Tensor:
        """Inputs of the critic, which include who the partner is, [D, n]."""
        one = np.zeros((len(decisions), len(self.settings.partners)), np.float32)
        one[:, self.settings.partners.index(partner)] = 1.0
        columns = decisions.each.reshape(len(decisions), -1), decisions.rest, one
        return torch.as_tensor(np.concatenate(columns, 1))


def _advantages(decisions: Decisions, value: np.ndarray, *, scale: float, lam: float) -> np.ndarray:
    """Generalised advantage estimates (Schulman et al. 2016) of decisions of different lengths, [D]."""
    after = decisions.discount * np.append(value[1:], 0.0)
    found = (scale * decisions.gain + after - value).astype(np.float32)
    for k in reversed(range(len(found) - 1)):
        found[k] += lam * decisions.discount[k] * found[k + 1]
    return found


def _chunks(
    decisions: Decisions, told: Tensor, advantage: np.ndarray, target: np.ndarray, *, length: int
) -> list[dict[str, Tensor]]:
    """Consecutive decisions, so many in each and the last one padded, with the recurrent state before the first."""
    columns = {
        "each": decisions.each, "rest": decisions.rest, "allowed": decisions.allowed, "chosen": decisions.chosen,
        "log_prob": decisions.log_prob, "told": told.numpy(), "advantage": advantage, "target": target,
        "valid": np.ones(len(decisions), np.float32),
    }  # fmt: skip
    chunks = []
    for first in range(0, len(decisions), length):
        chunk = {}
        for name, column in columns.items():
            part = column[first : first + length]
            pad = [(0, length - len(part))] + [(0, 0)] * (part.ndim - 1)
            chunk[name] = torch.as_tensor(np.pad(part, pad, constant_values=name == "allowed"))
        chunks.append(chunk | {"state": torch.as_tensor(decisions.state[first])})
    return chunks
