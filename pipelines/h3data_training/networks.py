"""Visual policy in PyTorch, with a critic, an auxiliary head and exploration noise for training.

`sim_kinematic.policies.visual_policy` is the same policy in NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from h3data.errors import InputError
from h3data_training.settings import Settings
from sim_kinematic.policies.networks.resnet_lstm import ResNetLSTM, pixels_of
from sim_kinematic.policies.visual_policy import (
    PATCH,
    PICTURES,
    STRIDES,
    VisualPolicy,
    lengths,
    number_count,
    picture_in,
    picture_length,
)
from sim_kinematic.sensing.encodings import OF_COMMANDS

Shown = Mapping[str, Tensor]


def actor_numbers(shown: Shown, last: Tensor, names: tuple[str, ...]) -> Tensor:
    """Return the numerical inputs of the actor, including its last action, [n, A]."""
    return torch.cat([*(OF_COMMANDS[n].of(torch, shown[n]) for n in names if n not in PICTURES), last], 1)


def critic_numbers(shown: Shown, over: Tensor, names: tuple[str, ...]) -> Tensor:
    """Return the numerical inputs of the critic, including whether the episode is ``over`` [n]."""
    return torch.cat([*(OF_COMMANDS[n].of(torch, shown[n]) for n in names), over[:, None].float()], 1)


def critic_length(settings: Settings) -> int:
    """Return the number of inputs of the critic, including the flag that the episode is over."""
    return sum(lengths(name, settings.actions)[1] for name in settings.critic) + 1


def picture(seen: Tensor) -> Tensor:
    """Move squares of 4 x 4 pixels into channels, from [n, H, W, planes] to [n, 16 planes, H / 4, W / 4].

    Depth is rescaled so that near distances have more detail. The result has half precision, in which the depth of
    rollouts of 4,096 worlds takes 0.8 GB.
    """
    scaled = seen.sqrt() if seen.shape[-1] == 1 else seen.float() / 255
    return F.pixel_unshuffle(scaled.permute(0, 3, 1, 2).half(), PATCH)


def picture_layers(
    name: str, size: tuple[int, int], channels: tuple[int, int, int], features: int
) -> tuple[nn.ModuleList, nn.Linear]:
    """Return the layers that turn a picture (width, height) into features: three convolutions and a linear layer."""
    widths = (PICTURES[name] * PATCH * PATCH, *channels)
    convolutions = nn.ModuleList(
        nn.Conv2d(widths[k], widths[k + 1], 3, stride, 1) for k, stride in enumerate(STRIDES)
    ).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return convolutions, nn.Linear(channels[-1] * picture_length(size), features)


def picture_features(weights: Mapping[str, Tensor], pixels: Tensor) -> Tensor:
    """Return features [n, F] of pictures in the form that `picture` returns, with the weights of `picture_arrays`."""
    x = (pixels if pixels.is_cuda else pixels.float()).contiguous(memory_format=torch.channels_last)
    for k, stride in enumerate(STRIDES):
        x = F.relu(F.conv2d(x, weights[f"conv_{k}.weight"], weights[f"conv_{k}.bias"], stride, 1))
    return F.relu(F.linear(x.flatten(1), weights["picture.weight"], weights["picture.bias"]))


def picture_arrays(convolutions: nn.ModuleList, last: nn.Linear) -> dict[str, Tensor]:
    """Return the weights of picture layers by name, as in `sim_kinematic.policies.visual_policy.picture_shapes`."""
    named = {"picture.weight": last.weight, "picture.bias": last.bias}
    for k, convolution in enumerate(convolutions):
        named |= {f"conv_{k}.weight": convolution.weight, f"conv_{k}.bias": convolution.bias}
    return named


class ActorCritic(nn.Module):
    """Network with a recurrent actor, and a critic that observes the positions of all agents."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        s, numbers = settings, number_count(settings.observations, settings.actions)
        self.least_std, self.sees = s.least_std, picture_in(s.observations)
        self.state_length = s.hidden
        last = self._make_actor(s, numbers)
        told = critic_length(s)
        self.auxiliary = nn.Sequential(nn.Linear(s.hidden, 128), nn.ELU(), nn.Linear(128, told - 1))
        self.log_std = nn.Parameter(torch.full((s.actions,), math.log(s.std)))
        self.value_head = nn.Sequential(
            nn.Linear(told, s.critic_width),
            nn.ELU(),
            nn.Linear(s.critic_width, s.critic_width),
            nn.ELU(),
            nn.Linear(s.critic_width, 1),
        )
        with torch.no_grad():  # the first policy hardly moves: it explores by its noise, around standing still
            last.weight.mul_(0.05)
            last.bias.copy_(torch.tensor(s.first_action))

    def _make_actor(self, s: Settings, numbers: int) -> nn.Linear:
        """Make the layers of the actor and return the last one."""
        if self.sees:
            self.convolutions, self.picture = picture_layers(self.sees, s.picture_size, s.channels, s.features)
        self.gru = nn.GRU((s.features if self.sees else 0) + numbers, s.hidden)
        self.act = nn.Sequential(
            nn.Linear(s.hidden + numbers, s.act_width), nn.ELU(), nn.Linear(s.act_width, s.actions)
        )
        last = self.act[-1]
        assert isinstance(last, nn.Linear)
        return last

    def std(self) -> Tensor:
        """Return the standard deviation of the exploration noise for each component of an action [A]."""
        return self.log_std.exp().clamp_min(self.least_std)

    def pixels(self, seen: Tensor) -> Tensor:
        """Return pictures [n, H, W, planes] in the form in which rollouts store them."""
        return picture(seen)

    def features(self, pixels: Tensor | None, numbers: Tensor) -> Tensor:
        """Return the inputs of the recurrent layer [n, F] for pixels and numbers."""
        if pixels is None:
            return numbers
        with torch.autocast(pixels.device.type, torch.bfloat16, enabled=pixels.is_cuda):
            seen = picture_features(picture_arrays(self.convolutions, self.picture), pixels)
        return torch.cat([seen.float(), numbers], -1)

    def remember(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs of the recurrent layer for features [T, n, F] after each step [T, n, H], and its last state [n, S]."""
        out, after = self.gru(x, state[None])
        return out, after[0]

    def head(self, known: Tensor, numbers: Tensor) -> Tensor:
        """Return the mean actions [..., A]."""
        return self.act(torch.cat([known, numbers], -1))

    def step(self, pixels: Tensor | None, numbers: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean actions [n, A] and next states [n, S]."""
        out, state = self.remember(self.features(pixels, numbers)[None], state)
        return self.head(out[0], numbers), state

    def roll(self, x: Tensor, state: Tensor, begins: Tensor) -> Tensor:
        """Return outputs [T, B, H] of the recurrent layer for features [T, B, F].

        The state [B, S] is reset before the steps at which an episode starts (``begins``).

        cuDNN cannot reset a state within a sequence, so parts of episodes become separate sequences, and short ones are
        padded. Only features are padded, because padding the pictures took most of the time of an update.
        """
        steps, batch, width = x.shape
        start = begins.T.clone()
        start[:, 0] = True
        where = start.flatten().nonzero()[:, 0]  # waits for the device
        part = start.flatten().cumsum(0) - 1
        at = (torch.arange(steps * batch, device=x.device) - where[part]) * len(where) + part  # [B * T] -> padded row
        at = at.view(batch, steps).T.flatten()
        padded = x.new_zeros(steps * len(where), width).index_copy(0, at, x.flatten(0, 1))
        first = x.new_zeros(len(where), state.shape[1])
        first = first.index_copy(0, part[::steps], state * ~begins[0][:, None])
        out, _ = self.remember(padded.view(steps, len(where), width), first)
        return out.flatten(0, 1).index_select(0, at).view(steps, batch, -1)

    def take(self, arrays: Mapping[str, Any]) -> None:
        """Replace the actor by one with the arrays that `arrays` returns.

        Raises:
            InputError: the arrays are those of other layers.
        """
        mine = self._named()
        other = [
            f"{n} {list(arrays[n].shape)}, not {list(t.shape)}" if n in arrays else f"no {n}"
            for n, t in mine.items()
            if n not in arrays or arrays[n].shape != tuple(t.shape)
        ]
        other += [f"{n}, which is unknown here" for n in arrays if n not in mine]
        if other:
            raise InputError(f"The policy to begin with has another network: {'; '.join(other)}.", code="H3-TRAIN-022")
        with torch.no_grad():
            for name, tensor in mine.items():
                tensor.copy_(torch.as_tensor(arrays[name]))

    def arrays(self) -> dict[str, Any]:
        """Return the actor's float32 arrays by their names in `sim_kinematic.policies.visual_policy.VisualPolicy`."""
        return {n: t.detach().float().cpu().contiguous().numpy().copy() for n, t in self._named().items()}

    def _named(self) -> dict[str, Any]:
        first, last = self.act[0], self.act[-1]
        named: dict[str, Any] = {
            "gru.weight_ih": self.gru.weight_ih_l0,
            "gru.weight_hh": self.gru.weight_hh_l0,
            "gru.bias_ih": self.gru.bias_ih_l0,
            "gru.bias_hh": self.gru.bias_hh_l0,
            "act_0.weight": first.weight,
            "act_0.bias": first.bias,
            "act_1.weight": last.weight,
            "act_1.bias": last.bias,
        }
        if self.sees:
            named |= picture_arrays(self.convolutions, self.picture)
        return named


class ResNetActorCritic(ActorCritic):
    """Network with the paper's actor and h3data's critic."""

    def _make_actor(self, s: Settings, numbers: int) -> nn.Linear:
        size = s.picture_size if self.sees else None
        self.actor = ResNetLSTM(
            numbers,
            size=size,
            given=PICTURES[self.sees or "arm_depth"],
            planes=s.channels[0],
            features=s.features,
            hidden=s.hidden,
        )
        self.state_length = self.actor.state_length
        return self.actor.act

    def pixels(self, seen: Tensor) -> Tensor:
        """Return pictures in the form that the network expects."""
        return pixels_of(seen)

    def features(self, pixels: Tensor | None, numbers: Tensor) -> Tensor:
        """Return features [n, F] of pictures and numbers."""
        return self.actor.features(pixels, numbers)

    def remember(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the output and the next state of the recurrent layers."""
        return self.actor.remember(x, state)

    def head(self, known: Tensor, numbers: Tensor) -> Tensor:
        """Return the mean action for the output of the recurrent layers."""
        return self.actor.act(known)

    def _named(self) -> dict[str, Any]:
        return dict(self.actor.named_parameters())


def network(settings: Settings) -> ActorCritic:
    """Return a network with random initial weights, as the settings describe it."""
    return {"cnn_gru": ActorCritic, "resnet18_lstm": ResNetActorCritic}[settings.network](settings)


def warm_start(net: ActorCritic, policy: VisualPolicy, settings: Settings) -> dict[str, Any]:
    """Replace the actor by a trained one, and return the entries of its card about its training and earlier training.

    Raises:
        InputError: the trained actor has other observations, another robot, or other layers.
    """
    card, s = policy.card, settings
    pairs = {
        "task": (card.task, s.task),
        "network": (card.network, s.network),
        "observations": (card.observations, s.observations),
        "robot": (card.robot, s.robot),
        "picture_size": (card.picture_size or s.picture_size, s.picture_size),
    }
    other = [f"{name}={theirs!r}, not {ours!r}" for name, (theirs, ours) in pairs.items() if theirs != ours]
    if other:
        raise InputError(f"The policy to begin with has {'; '.join(other)}.", code="H3-TRAIN-021")
    net.take(policy.arrays)
    before = {k: v for k, v in card.training.items() if k not in ("settings", "last_update")}
    return {"digest": policy.digest[:12], "hold": card.hold, **before}
