"""Skill policies for worlds on a device, with one or several networks as tensors.

Each step is equivalent to that of `sim_kinematic.policies.choosers.recurrent_chooser`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from h3data_training.networks import picture_features
from h3data_training.populations.playing import Decisions, Job
from h3data_training.torch.graph import keep_row
from h3data_training.torch.rearrange.observations import Paths, View, observed
from h3data_training.torch.rearrange.skills import NAV_GOAL, NAV_OBJECT, PICK, PLACE, every_choice, of_object
from h3data_training.torch.rearrange.state import ABORTED, DONE, FREE, NOBODY, Play
from h3data_training.torch.rearrange.worlds import RearrangeTensors
from sim_kinematic.policies.choosers.chooser_network import (
    OBSERVATIONS,
    SKILLS_WITH_OBJECT,
    SkillPolicyNetwork,
    hides,
    numbers_of,
    rest_count,
)
from sim_kinematic.policies.choosers.recurrent_chooser import ALERT_M, ALERT_STEPS
from sim_kinematic.policies.visual_policy import PATCH
from sim_kinematic.sensing.encodings import DETECTOR, OF_CHOICES
from sim_kinematic.sensing.table import SENSES

Arrays = Mapping[str, Tensor]


class Row(NamedTuple):
    """Inputs and choices of one agent in a step, [W, ...] each."""

    each: Tensor
    rest: Tensor
    pictures: Tensor
    told: Tensor
    state: Tensor
    allowed: Tensor
    chosen: Tensor
    log_prob: Tensor
    asked: Tensor


class TensorSkillPolicy:
    """Skill policy of one agent in all worlds, with one network for each name."""

    def __init__(self, sim: RearrangeTensors, play: Play, cast: Sequence[tuple[str, int]], agent: str) -> None:
        """Create the policy; ``cast`` has the names of networks, and the number of worlds in which each plays."""
        self._play = play
        self._sim, self._agent = sim, agent
        self._names = [name for name, _ in cast]
        most = max(n for _, n in cast)
        self._rows = torch.zeros(len(cast), most, dtype=torch.int64, device=sim.device)
        """Worlds of each network, [P, N]; a network with fewer worlds has its last one several times."""
        self._arrays: dict[str, Tensor] = {}
        self._kept: dict[str, Tensor] = {}
        """Rows of all steps, [T, W, ...] each."""
        worlds = sum(n for _, n in cast)
        self._state = torch.zeros(worlds, 0, device=sim.device)
        self._thought = torch.zeros(worlds, dtype=torch.int64, device=sim.device)
        self._noise = torch.zeros(0, device=sim.device)
        self._pictures = torch.zeros(worlds, 0, 0, dtype=torch.half, device=sim.device)
        """Roots of the depth that robots saw in their last picture, [W, H, W']."""
        self._found = self._features = torch.zeros(worlds, 0, device=sim.device)

    @property
    def remembered(self) -> list[Tensor]:
        """Tensors that a step changes."""
        return [self._state, self._thought]

    def begin(self, jobs: Sequence[Job], names: Sequence[str], generator: torch.Generator, *, steps: int) -> None:
        """Start episodes of at most a given number of steps.

        Each world uses the current network of its name in ``names``.
        """
        device = self._sim.device
        first = jobs[0].networks[names[0]]  # learners of one agent differ in their weights only
        self._hold, self._observations, self._sees = first.card.hold, first.card.observations, bool(first.sees)
        assert len(self._names) == 1 or not self._sees, "the robot alone sees"
        shape = steps, len(names), len(self._sim.choices[self._agent])
        noise = torch.rand(shape, generator=generator, device=device)
        if not self._arrays:
            self._offered = torch.as_tensor(first.offered, device=device)
            self._state = torch.zeros(len(names), first.arrays["gru.weight_hh"].shape[1], device=device)
            self._noise = torch.zeros_like(noise)
            if first.card.picture_size is not None:
                width, height = first.card.picture_size
                self._pictures = self._pictures.new_zeros(len(names), height, width)
                self._found = torch.zeros(len(names), 1, device=device)
        worlds: dict[str, list[int]] = {name: [] for name in self._names}
        for world, name in enumerate(names):
            worlds[name].append(world)
        most = self._rows.shape[1]
        self._rows.copy_(torch.tensor([own + own[-1:] * (most - len(own)) for own in worlds.values()]))
        fresh = arrays_of([jobs[own[0]].networks[name] for name, own in worlds.items()], device)
        for name, array in fresh.items():
            self._arrays.setdefault(name, array).copy_(array)
        self._noise.copy_(noise.clamp_min(1e-12))
        self._state.zero_()
        self._thought.zero_()

    def look(self, depth: Tensor, found: Tensor) -> None:
        """Read the pictures that networks use for their choices until the next call.

        Args:
            depth: images of the arm's camera [W, H, W'], as the observation ``arm_depth``.
            found: whether the camera sees a person [W, 1].
        """
        self._pictures.copy_(depth.float().sqrt())
        self._found.copy_(found)
        seen = features(self._arrays, self._pictures.float())
        if not self._features.numel():
            self._features = torch.empty_like(seen)
        self._features.copy_(seen)

    def choose(self, xz: Tensor, lengths: Tensor, ahead: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        """Return choices [W] for `Paths` and ``noise`` [W, C], -1 for no choice, and parts of a `Row`."""
        play = self._play
        view = View.of(self._sim, play, self._agent, Paths(xz, lengths, ahead))
        asked, view = self._asked(view)
        names, objects = self._observations, self._sim.bank.objects
        shown = observed(view, tuple(name for name in names if name in SENSES))
        told = self._features[:, :0]
        if self._sees:
            shown = shown | {DETECTOR: self._found}
            state_of = encode(observed(view, OBSERVATIONS), self._agent, objects)
            told = torch.cat([inputs.flatten(1) for inputs in state_of], 1)
        each, rest = encode(shown, self._agent, objects, observations=names)
        rows, scores = self._rows.flatten(), torch.zeros(len(each), len(view.choices), device=each.device)
        known = torch.cat([self._features, rest], 1)
        own, after = scored(self._arrays, each[self._rows], known[self._rows], self._state[self._rows])
        scores = scores.index_copy(0, rows, own.flatten(0, 1))
        state = self._state.index_copy(0, rows, after.flatten(0, 1))
        may = allowed(view, informed=not self._sees) & self._offered
        log_probs = scores.masked_fill(~may, -torch.inf).log_softmax(-1)
        chosen = (log_probs - (-noise.log()).log()).argmax(-1)
        log_prob = log_probs.gather(1, chosen[:, None])[:, 0]
        before = self._state.clone()
        self._state.copy_(torch.where(asked[:, None], state, self._state))
        self._thought.copy_(torch.where(asked, play.steps, self._thought))
        return torch.where(asked, chosen, FREE), each, rest, self._pictures, told, before, may, chosen, log_prob, asked

    def noise(self, step: Tensor) -> Tensor:
        """Return random numbers of the step with a number [1], uniform in 0..1, [W, C]."""
        return self._noise.index_select(0, step)[0]

    def keep(self, row: Row, step: Tensor) -> None:
        """Store a row of the step with a number [1]."""
        keep_row(self._kept, step, row._asdict(), rows=len(self._noise))

    def _asked(self, view: View) -> tuple[Tensor, View]:
        """Return agents that choose now (`RecurrentChooser.interrupts`), bool [W], and the view of interrupted ones."""
        play, does = view.play, view.does
        running = does.skill.clamp_min(0)
        kind, holder = view.choices.kind[running], of_object(play.held_by, view.choices.target[running])
        busy, since = does.skill != FREE, play.steps - self._thought
        walks = busy & ((kind == NAV_OBJECT) | (kind == NAV_GOAL))
        taken = (kind == NAV_OBJECT) & (holder != NOBODY) & (holder != view.agent) & (not self._sees)
        gap = view.other.xz - view.now.xz
        alert = torch.hypot(gap[:, 0], gap[:, 1]) < ALERT_M
        stops = walks & (taken | (alert & (since >= ALERT_STEPS)) | (since >= self._hold))
        does = does._replace(
            last=torch.where(stops, does.skill, does.last), outcome=torch.where(stops, ABORTED, does.outcome)
        )
        return ~play.ended & (~busy | stops), view._replace(does=does)

    def decisions(
        self, rewards: Tensor, steps: Tensor, gamma: float, partners: tuple[str, ...]
    ) -> dict[str, Decisions]:
        """Return the decisions of each learner for ``rewards`` [T, W], of which each world has used ``steps`` [W]."""
        asked = self._kept["asked"][: len(rewards)]
        world, when = asked.T.nonzero().unbind(1)  # one world after the other
        is_last = torch.ones_like(world, dtype=torch.bool)
        is_last[:-1] = world[1:] != world[:-1]
        until = torch.where(is_last, steps[world], when.roll(-1))
        powers = gamma ** torch.arange(len(rewards) + 1, dtype=torch.float64, device=rewards.device)
        earned = torch.zeros(len(powers), rewards.shape[1], dtype=torch.float64, device=rewards.device)
        earned[1:] = (rewards * powers[:-1, None]).cumsum(0)
        gain = (earned[until, world] - earned[when, world]) / powers[when]
        discount = torch.where(is_last, 0.0, powers[until - when])
        found = {}
        for name, all_rows in zip(self._names, self._rows, strict=True):
            rows = all_rows.unique()
            own = torch.isin(world, rows)
            at = when[own], world[own]
            found[name] = Decisions(
                **{column: t[at] for column, t in self._kept.items() if column != "asked"},
                gain=gain[own].float(),
                discount=discount[own].float(),
                counts=asked.sum(0)[rows].cpu().numpy(),
                partners=tuple(partners[w] for w in rows.tolist()),
            )
        return found


# --- the network as tensors -----------------------------------------------------------------------------------------------
def arrays_of(networks: Sequence[SkillPolicyNetwork], device: torch.device) -> dict[str, Tensor]:
    """Return the weights of P choosers on a device, [P, ...] each."""
    names = networks[0].arrays
    return {name: torch.as_tensor(np.stack([n.arrays[name] for n in networks]), device=device) for name in names}


def encode(
    shown: Mapping[str, Tensor], agent: str, objects: int, *, observations: tuple[str, ...] = OBSERVATIONS
) -> tuple[Tensor, Tensor]:
    """Return the inputs of each object [W, K, F] and the other inputs [W, R].

    They equal those of `sim_kinematic.policies.choosers.chooser_network.encoded`.
    """
    each, rest, own = [], [], SKILLS_WITH_OBJECT * objects
    for name in numbers_of(observations):
        encoding, seen = OF_CHOICES.get(name), shown[name]
        if encoding is None:
            each.append(seen[:, :own].reshape(-1, SKILLS_WITH_OBJECT, objects).transpose(1, 2))
            rest.append(seen[:, own:])
        elif encoding.times == "objects":
            each.append(encoding.of(torch, seen.reshape(-1, objects, encoding.given)))
            if hides(name, observations):
                each[-1] = each[-1] * (1 - shown["held_by_other"])[..., None]
        else:
            rest.append(encoding.of(torch, seen))
    assert rest[-1].shape[1] == rest_count(agent)
    return torch.cat(each, -1), torch.cat(rest, -1)


def features(arrays: Arrays, roots: Tensor) -> Tensor:
    """Return features [W, F] of square roots of depth [W, H, W'] by the only network."""
    pixels = functional.pixel_unshuffle(roots[:, None], PATCH)
    return picture_features({name: array[0] for name, array in arrays.items()}, pixels)


def scored(arrays: Arrays, each: Tensor, rest: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Return scores [P, N, C] and next states [P, N, H] of P networks in N worlds each, as `SkillPolicyNetwork` does.

    Inputs are [P, N, K, F] for objects, [P, N, R] for the remaining inputs, and the states [P, N, H].
    """

    def layer(name: str, x: Tensor, kind: str = "") -> Tensor:
        weight, bias = arrays[f"{name}.weight{kind}"], arrays[f"{name}.bias{kind}"]
        return torch.baddbmm(bias[:, None], x.flatten(1, -2), weight.mT).unflatten(1, x.shape[1:-1])

    count = each.shape[2]
    numbers = torch.eye(count, device=each.device).expand(*each.shape[:2], -1, -1)
    things = layer("object", torch.cat([each, numbers], -1)).relu()
    given, kept = layer("gru", torch.cat([rest, things.flatten(2)], -1), "_ih"), layer("gru", state, "_hh")
    (r, z, n), (kr, kz, kn) = given.chunk(3, -1), kept.chunk(3, -1)
    update = torch.sigmoid(z + kz)
    state = (1 - update) * torch.tanh(n + torch.sigmoid(r + kr) * kn) + update * state
    known = torch.cat([state[:, :, None].expand(-1, -1, count, -1), things], -1)
    of_objects = layer("each_1", layer("each_0", known).relu())
    others = layer("rest_1", layer("rest_0", torch.cat([state, rest], -1)).relu())
    last = each[..., -SKILLS_WITH_OBJECT:].transpose(2, 3).flatten(2)
    interrupted = torch.cat([last, rest[..., -others.shape[-1] :]], -1)
    scores = torch.cat([of_objects.transpose(2, 3).flatten(2), others], -1)
    return scores + arrays["persist"][..., None] * interrupted, state


def allowed(view: View, *, informed: bool = True) -> Tensor:
    """Return a mask of sensible choices, bool [W, C] (`sim_kinematic.policies.choosers.recurrent_chooser.allowed`)."""
    numbers = every_choice(view.choices, len(view.now.xz))
    kind, k, objects = view.choices.kind[numbers], view.choices.target[numbers], view.sim.bank.objects
    held = view.play.held_by
    if informed:
        free = (held == NOBODY) & ~view.sim.at_goal(view.hands, view.places)
    else:
        free = (held != view.agent) & (view.play.placed_by != view.agent)
    lies = free.gather(1, k)
    empty, mine = ~(held == view.agent).any(1, keepdim=True), (held == view.agent).gather(1, k)
    fetches = (kind == NAV_OBJECT) | (kind == PICK)
    handles = (kind == PICK) | (kind == PLACE)
    came = torch.where(handles, numbers - 2 * objects, numbers)
    last, outcome = view.does.last[:, None], view.does.outcome[:, None]
    arrived, going_on = (outcome == DONE) & (last == came), (outcome == ABORTED) & (last == numbers)
    may = torch.where(fetches, empty & lies, mine)
    return (kind > PLACE) | (may & ((arrived == handles) | going_on))
