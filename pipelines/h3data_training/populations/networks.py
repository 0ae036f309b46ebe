"""Policy network for choices of skills in PyTorch, with a critic that only training needs.

`sim_kinematic.policies.choosers.chooser_network` is the same policy in NumPy.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from h3data_training.networks import picture_arrays, picture_features, picture_layers
from h3data_training.populations.settings import PopulationSettings
from sim_kinematic.policies.choosers.chooser_network import (
    OBSERVATIONS,
    SKILLS_WITH_OBJECT,
    input_lengths,
    rest_count,
)
from sim_kinematic.policies.visual_policy import PATCH, picture_in

PERSIST = 4.5
"""Probability, at the start of training, that an interrupted agent continues on its path. The probability is 0.97,
because otherwise agents would never arrive.
"""
AT_HAND, ASIDE = 1.0, -2.0
"""Initial biases of the network's scores for picking and placing at the target, and for waiting and the primitives."""
GUESSED = ("held_by_other", "at_goal")
"""Exact values of each object that a robot with pictures does not observe but learns to predict, so that its recurrent
state contains them.
"""


def guessed_columns(agent: str, objects: int) -> list[int]:
    """Return the columns of the state, as the critic observes it, that hold `GUESSED` for each object."""
    of_object, _ = input_lengths(agent)
    starts = [input_lengths(agent, OBSERVATIONS[: OBSERVATIONS.index(name)])[0] for name in GUESSED]
    return [k * of_object + start for start in starts for k in range(objects)]


class Chooser(nn.Module):
    """Network with a recurrent actor, and a critic that observes the identity of the partner."""

    def __init__(self, settings: PopulationSettings, *, agent: str, objects: int) -> None:
        super().__init__()
        s, observations = settings, settings.observations_of(agent)
        of_object, rest = input_lengths(agent, observations)
        told = objects * of_object + rest + len(s.partners)
        self.sees = picture_in(observations)
        if self.sees:
            self.convolutions, self.picture = picture_layers(self.sees, s.picture_size, s.channels, s.features)
            rest += s.features
            of_object_told, rest_told = input_lengths(agent)
            told += objects * of_object_told + rest_told
            self.guess = nn.Sequential(
                nn.Linear(s.hidden, s.width), nn.ELU(), nn.Linear(s.width, objects * len(GUESSED))
            )
        others = rest_count(agent)
        self.objects, self.others = objects, others
        self.object = nn.Linear(of_object + objects, s.width)
        self.gru = nn.GRU(rest + objects * s.width, s.hidden)
        self.each_0, self.each_1 = nn.Linear(s.hidden + s.width, s.width), nn.Linear(s.width, SKILLS_WITH_OBJECT)
        self.rest_0, self.rest_1 = nn.Linear(s.hidden + rest, s.width), nn.Linear(s.width, others)
        self.persist = nn.Parameter(torch.full((1,), PERSIST))
        self.value_head = nn.Sequential(
            nn.Linear(told, 128), nn.ELU(), nn.Linear(128, 128), nn.ELU(), nn.Linear(128, 1)
        )
        with torch.no_grad():
            for last in (self.each_1, self.rest_1):
                last.weight.mul_(0.1)
                last.bias.zero_()
            self.each_1.bias[2:] = AT_HAND
            self.rest_1.bias.fill_(ASIDE)

    def forward(self, each: Tensor, rest: Tensor, state: Tensor, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return scores [T, B, C] and states [T, B, H] for inputs [T, B, K, F] and [T, B, R] and initial states [B, H].

        ``pictures`` are square roots of depth [T, B, H, W], or [T, B, 0, 0] for a policy without pictures.
        """
        if self.sees:
            pixels = F.pixel_unshuffle(pictures.flatten(0, 1)[:, None].float(), PATCH)
            features = picture_features(picture_arrays(self.convolutions, self.picture), pixels)
            rest = torch.cat([features.unflatten(0, rest.shape[:2]), rest], -1)
        numbers = torch.eye(self.objects, device=each.device).expand(*each.shape[:2], -1, -1)
        things = F.relu(self.object(torch.cat([each, numbers], -1)))
        known, _ = self.gru(torch.cat([rest, things.flatten(2)], -1), state[None])
        beside = known[:, :, None].expand(-1, -1, self.objects, -1)
        of_objects = self.each_1(F.relu(self.each_0(torch.cat([beside, things], -1))))
        others = self.rest_1(F.relu(self.rest_0(torch.cat([known, rest], -1))))
        interrupted = torch.cat(
            [each[..., -SKILLS_WITH_OBJECT:].transpose(2, 3).flatten(2), rest[..., -self.others :]], -1
        )
        scores = torch.cat([of_objects.transpose(2, 3).flatten(2), others], -1)
        return scores + self.persist * interrupted, known

    def arrays(self) -> dict[str, Any]:
        """Return the actor's arrays, float32, by the names in `sim_kinematic.policies.choosers.chooser_network`."""
        named: dict[str, Tensor] = {"persist": self.persist}
        for name in ("object", "each_0", "each_1", "rest_0", "rest_1"):
            layer = getattr(self, name)
            named |= {f"{name}.weight": layer.weight, f"{name}.bias": layer.bias}
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            named[f"gru.{name}"] = getattr(self.gru, f"{name}_l0")
        if self.sees:
            named |= picture_arrays(self.convolutions, self.picture)
        return {name: tensor.detach().float().cpu().contiguous().numpy().copy() for name, tensor in named.items()}
