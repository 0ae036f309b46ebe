"""Training episodes with oracle skills, as many at once as an update has, in worlds on a device
(`sim_kinematic.torch.rearrange`): the same decisions as `h3data_training.populations.playing` gathers.

What an update plays follows from the weights, the seed, and the numbers of its episodes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from h3data_training.populations.playing import Batch, Decisions, Job, Played
from h3data_training.populations.settings import ROBOT
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.policies.choosers.chooser_network import (
    ENCODINGS,
    OBSERVATIONS,
    SKILLS_WITH_OBJECT,
    ChooserNetwork,
    hides,
    rest_count,
)
from sim_kinematic.policies.choosers.recurrent_chooser import ALERT_M, ALERT_STEPS
from sim_kinematic.policies.rearrange import planner
from sim_kinematic.torch.graph import can_fuse, captured, fused, overwrite
from sim_kinematic.torch.rearrange.bank import RearrangeBank, orders
from sim_kinematic.torch.rearrange.observations import Paths, View, observed
from sim_kinematic.torch.rearrange.skills import NAV_GOAL, NAV_OBJECT, PICK, PLACE, every_choice, of_object
from sim_kinematic.torch.rearrange.state import ABORTED, DONE, FREE, NOBODY, Play
from sim_kinematic.torch.rearrange.worlds import RearrangeTensors

APART_M = 2.0
"""Agents begin at least this far from each other."""
LOOKS_EVERY = 25
"""Steps after which it is looked whether all episodes are over: that waits for the device."""
Arrays = Mapping[str, Tensor]
P = ParamSpec("P")
R = TypeVar("R")


class TensorPlayers:
    """Plays training episodes in worlds on a device; what `h3data_training.populations.playing.Players` is with processes."""

    workers = 1

    def __init__(
        self,
        bank: RearrangeBank,
        device: torch.device | str,
        *,
        compile: bool | None = None,
        moves_starts: bool = False,
    ) -> None:
        """
        Args:
            bank: Episodes to choose from.
            device: Where the worlds are.
            compile: Whether the operations of a step are fused; by default on a GPU, if Triton is installed.
            moves_starts: Whether agents begin where they do in any episodes of the same home.
        """
        self._bank, self.device, self._moves_starts = bank, torch.device(device), moves_starts
        self._compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._worlds: _Worlds | None = None

    @property
    def size(self) -> int:
        """Number of episodes to choose from,"""
        return len(self._bank)

    @property
    def homes(self) -> int:
        """and of the homes that they are in."""
        return len(self._bank.floors)

    def warm_up(self, jobs: Sequence[Job]) -> None:
        """Compiles a step, where that is done, by playing some episodes."""
        if self._compiles or self.device.type == "cuda":
            self.play(jobs)

    def play(self, jobs: Sequence[Job]) -> Batch:
        """Plays some episodes, in their order, all at once."""
        casts = _casts(jobs)
        with torch.no_grad():
            if self._worlds is None or self._worlds.casts != casts:
                self._worlds = None  # their memory first
                self._worlds = _Worlds(
                    self._bank, casts, self.device, compiles=self._compiles, moves_starts=self._moves_starts
                )
            return self._worlds.played(jobs)

    def close(self) -> None:
        """Nothing needs closing."""


def _plain(function: Callable[P, R]) -> Callable[P, R]:
    return function


Casts = tuple[tuple[tuple[str, int], ...], ...]


def _casts(jobs: Sequence[Job]) -> Casts:
    """The learners that play the robot and, where people learn, the person: names, and in how many worlds."""
    people = [job.partner for job in jobs if job.partner in job.networks]
    assert len(people) in (0, len(jobs))
    return tuple(tuple(sorted(Counter(names).items())) for names in ([ROBOT] * len(jobs), people) if names)


class _Worlds:
    """Worlds in which one update after the other is played, in the same places in memory: on a GPU a step is one CUDA graph."""

    def __init__(
        self, bank: RearrangeBank, casts: Casts, device: torch.device, *, compiles: bool, moves_starts: bool
    ) -> None:
        self._moves_starts = moves_starts
        self.casts = casts
        count, self._longest = sum(n for _, n in casts[0]), bank.spec.max_steps
        planners = () if len(casts) > 1 else ("human",)
        self._sim = RearrangeTensors(bank, device=device, planners=planners, interrupts="always", repeats=False)
        self._play = self._sim.before_the_first(torch.zeros(count, dtype=torch.int64))
        self._choosers = [
            _Chooser(self._sim, self._play, cast, agent) for cast, agent in zip(casts, (ROBOT, "human"), strict=False)
        ]
        self._nothing = torch.full((count,), FREE, dtype=torch.int64, device=device)
        self._step = torch.zeros(1, dtype=torch.int64, device=device)
        self._rewards = torch.zeros(self._longest, count, dtype=self._sim.dtype, device=device)
        # in parts: what takes most of the time to compile grows faster than its size
        fuse = fused if compiles else _plain
        self._find = fuse(self._paths)
        self._choose = [fuse(chooser.choose) for chooser in self._choosers]
        self._move = fuse(self._moved)
        self._advance: Callable[[], object] | None = None

    def played(self, jobs: Sequence[Job]) -> Batch:
        """Some episodes, in their order."""
        device, seed = self._sim.device, episode_seed(jobs[0].seed, jobs[0].number) % 2**63
        entries, dice = (
            torch.tensor([job.entry for job in jobs], device=device),
            torch.Generator(device).manual_seed(seed),
        )
        fresh = self._sim.start_at(entries, self._starts(entries, dice))
        if len(self._choosers) == 1:
            orders_ = _orders(jobs, self._sim.bank.objects, device)
            fresh = fresh._replace(human_does=fresh.human_does._replace(order=orders_))
        overwrite(self._play.tensors(), fresh.tensors())
        self._step.zero_()
        for chooser, names in zip(self._choosers, ([ROBOT] * len(jobs), [job.partner for job in jobs]), strict=False):
            chooser.begin(jobs, names, dice, steps=self._longest)
        if self._advance is None:
            self._advance = self._prepared()
        steps = 0
        while steps < self._longest:
            self._advance()
            steps += 1
            if steps % LOOKS_EVERY == 1 and bool(self._play.ended.all()):
                break
        return _batch(self._sim, self._play, jobs, self._choosers, self._rewards[:steps].double())

    def _starts(self, entries: Tensor, dice: torch.Generator) -> Tensor:
        """``(x, z, heading)`` of robot and person, [W, 2, 3]: with `moves_starts` each where it begins in some episode in the
        same home, if they are not too near there. So there are as many meetings as pairs of episodes in a home."""
        starts = self._sim.tables.starts
        own = starts[entries]
        if not self._moves_starts:
            return own
        place = self._sim.tables.place
        by_home, counts = place.argsort(stable=True), place.bincount()
        home = place[entries][:, None]
        picked = torch.rand(len(entries), 2, generator=dice, device=entries.device)
        nth = torch.minimum((picked * counts[home]).long(), counts[home] - 1)
        other = by_home[(counts.cumsum(0) - counts)[home] + nth]
        found = torch.stack([starts[other[:, who], who] for who in range(2)], 1)
        gap = found[:, 0, :2] - found[:, 1, :2]
        return torch.where((torch.hypot(gap[:, 0], gap[:, 1]) < APART_M)[:, None, None], own, found)

    def _prepared(self) -> Callable[[], object]:
        """A step, on a GPU as one CUDA graph."""
        changed = [*self._play.tensors(), *(t for chooser in self._choosers for t in chooser.remembered), self._step]
        was = [t.clone() for t in changed]
        self._eager()  # makes room for the rows
        overwrite(changed, was)
        return captured(self._eager, changed) if self._sim.device.type == "cuda" else self._eager

    def _eager(self) -> None:
        """One step of all worlds, in place."""
        paths, chosen = self._find(), []
        for chooser, choose in zip(self._choosers, self._choose, strict=True):
            choice, *row = choose(*paths, chooser.noise(self._step))
            chooser.keep(_Row(*row), self._step)
            chosen.append(choice)
        self._move(chosen[0], chosen[1] if len(chosen) > 1 else self._nothing)
        self._rewards.index_copy_(0, self._step, self._play.reward[None])
        self._step.add_(1)

    def _paths(self) -> tuple[Tensor, Tensor, Tensor]:
        paths = Paths.of(self._sim, self._play, self._sim.tables.at(self._play.episode))
        return paths.xz, paths.lengths, paths.ahead

    def _moved(self, robot: Tensor, human: Tensor) -> None:
        overwrite(self._play.tensors(), self._sim.step(self._play, robot, human).tensors())


def _orders(jobs: Sequence[Job], objects: int, device: torch.device) -> Tensor:
    """Plans of the partners, [W, K], as in `h3data_training.populations.playing.play_episode`."""
    plans = [planner(job.partner, episode_seed(job.seed, job.number), objects).objects for job in jobs]
    return torch.as_tensor(orders(plans, objects), device=device)


def _batch(
    sim: RearrangeTensors, play: Play, jobs: Sequence[Job], choosers: Sequence[_Chooser], rewards: Tensor
) -> Batch:
    at_goal = sim.at_goal(View.of(sim, play, ROBOT).hands, sim.tables.at(play.episode))
    placed = (at_goal & (play.placed_by == 0)).sum(1)
    columns = (play.steps, play.success, play.collides, at_goal.sum(1), placed, rewards.sum(0))
    played = tuple(
        Played(
            partner=job.partner,
            steps=steps,
            ended="success" if success else "collision" if collides else "max_steps",
            reward=reward,
            placed=by_robot,
            at_goal=there,
        )
        for job, steps, success, collides, there, by_robot, reward in zip(
            jobs, *(column.tolist() for column in columns), strict=True
        )
    )
    partners, gamma = tuple(job.partner for job in jobs), jobs[0].gamma
    found: dict[str, Decisions] = {}
    for chooser in choosers:
        found |= chooser.decisions(rewards, play.steps, gamma, partners)
    return Batch(played, found)


class _Row(NamedTuple):
    """Inputs and choices of one agent in a step, [W, ...] each."""

    each: Tensor
    rest: Tensor
    state: Tensor
    allowed: Tensor
    chosen: Tensor
    log_prob: Tensor
    asked: Tensor


class _Chooser:
    """The choosers of one agent of all worlds, one network for each name."""

    def __init__(self, sim: RearrangeTensors, play: Play, cast: Sequence[tuple[str, int]], agent: str) -> None:
        """``cast`` are names and in how many worlds each plays."""
        self._play = play
        self._sim, self._agent = sim, agent
        self._names = [name for name, _ in cast]
        most = max(n for _, n in cast)
        self._rows = torch.zeros(len(cast), most, dtype=torch.int64, device=sim.device)
        """Worlds of each network, [P, N]; one that has fewer has its last one several times."""
        self._arrays: dict[str, Tensor] = {}
        self._kept: dict[str, Tensor] = {}
        """Rows of all steps, [T, W, ...] each."""
        worlds = sum(n for _, n in cast)
        self._state = torch.zeros(worlds, 0, device=sim.device)
        self._thought = torch.zeros(worlds, dtype=torch.int64, device=sim.device)
        self._noise = torch.zeros(0, device=sim.device)

    @property
    def remembered(self) -> list[Tensor]:
        """Tensors that a step changes."""
        return [self._state, self._thought]

    def begin(self, jobs: Sequence[Job], names: Sequence[str], dice: torch.Generator, *, steps: int) -> None:
        """New episodes of so many steps at most, with the networks of today in the worlds whose ``names`` they have."""
        device = self._sim.device
        first = jobs[0].networks[names[0]]  # learners of one agent differ in their weights only
        self._hold, self._observations = first.card.hold, first.card.observations
        shape = steps, len(names), len(self._sim.choices(self._agent))
        noise = torch.rand(shape, generator=dice, device=device)
        if not self._arrays:
            self._offered = torch.as_tensor(first.offered, device=device)
            self._state = torch.zeros(len(names), first.arrays["gru.weight_hh"].shape[1], device=device)
            self._noise = torch.zeros_like(noise)
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

    def choose(self, xz: Tensor, lengths: Tensor, ahead: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        """Choices [W] by `Paths` and ``noise`` [W, C], -1 of those that are not asked, and the parts of a `_Row`."""
        play = self._play
        view = View.of(self._sim, play, self._agent, Paths(xz, lengths, ahead))
        asked, view = self._asked(view)
        names = self._observations
        each, rest = encode(observed(view, names), self._agent, self._sim.bank.objects, observations=names)
        rows, scores = self._rows.flatten(), torch.zeros(len(each), len(view.choices), device=each.device)
        own, after = scored(self._arrays, each[self._rows], rest[self._rows], self._state[self._rows])
        scores = scores.index_copy(0, rows, own.flatten(0, 1))
        state = self._state.index_copy(0, rows, after.flatten(0, 1))
        may = allowed(view) & self._offered
        log_probs = scores.masked_fill(~may, -torch.inf).log_softmax(-1)
        chosen = (log_probs - (-noise.log()).log()).argmax(-1)
        log_prob = log_probs.gather(1, chosen[:, None])[:, 0]
        before = self._state.clone()
        self._state.copy_(torch.where(asked[:, None], state, self._state))
        self._thought.copy_(torch.where(asked, play.steps, self._thought))
        return torch.where(asked, chosen, FREE), each, rest, before, may, chosen, log_prob, asked

    def noise(self, step: Tensor) -> Tensor:
        """Of the step with this number [1], uniform in 0..1, [W, C]."""
        return self._noise.index_select(0, step)[0]

    def keep(self, row: _Row, step: Tensor) -> None:
        """Remembers a row of the step with this number [1]."""
        for name, value in row._asdict().items():
            if name not in self._kept:
                self._kept[name] = torch.zeros(len(self._noise), *value.shape, dtype=value.dtype, device=value.device)
            self._kept[name].index_copy_(0, step, value[None])

    def _asked(self, view: View) -> tuple[Tensor, View]:
        """Agents that choose now (`RecurrentChooser.interrupts`), bool [W], and the view of those who are interrupted."""
        play, does = view.play, view.does
        running = does.skill.clamp_min(0)
        kind, holder = view.choices.kind[running], of_object(play.held_by, view.choices.target[running])
        busy, since = does.skill != FREE, play.steps - self._thought
        walks = busy & ((kind == NAV_OBJECT) | (kind == NAV_GOAL))
        taken = (kind == NAV_OBJECT) & (holder != NOBODY) & (holder != view.who)
        gap = view.other - view.xz
        alert = torch.hypot(gap[:, 0], gap[:, 1]) < ALERT_M
        stops = walks & (taken | (alert & (since >= ALERT_STEPS)) | (since >= self._hold))
        does = does._replace(
            last=torch.where(stops, does.skill, does.last), outcome=torch.where(stops, ABORTED, does.outcome)
        )
        return ~play.ended & (~busy | stops), view._replace(does=does)

    def decisions(
        self, rewards: Tensor, steps: Tensor, gamma: float, partners: tuple[str, ...]
    ) -> dict[str, Decisions]:
        """Those of each learner; ``rewards`` are [T, W], of which each world has played some ``steps`` [W]."""
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
                gain=gain[own].float(), discount=discount[own].float(), counts=asked.sum(0)[rows].cpu().numpy(),
                partners=tuple(partners[w] for w in rows.tolist()),
            )  # fmt: skip
        return found


# --- the network as tensors -----------------------------------------------------------------------------------------------
def arrays_of(networks: Sequence[ChooserNetwork], device: torch.device) -> dict[str, Tensor]:
    """The weights of P choosers on a device, [P, ...] each."""
    names = networks[0].arrays
    return {name: torch.as_tensor(np.stack([n.arrays[name] for n in networks]), device=device) for name in names}


def encode(
    shown: Mapping[str, Tensor], agent: str, objects: int, *, observations: tuple[str, ...] = OBSERVATIONS
) -> tuple[Tensor, Tensor]:
    """Inputs of each object [W, K, F] and the rest [W, R] (`sim_kinematic.policies.choosers.chooser_network.encoded`)."""
    each, rest, own = [], [], SKILLS_WITH_OBJECT * objects
    for name in observations:
        encoding, seen = ENCODINGS.get(name), shown[name]
        if encoding is None:
            each.append(seen[:, :own].reshape(-1, SKILLS_WITH_OBJECT, objects).transpose(1, 2))
            rest.append(seen[:, own:])
        elif encoding.is_of_objects:
            each.append(_inputs(name, seen.reshape(-1, objects, encoding.given)))
            if hides(name, observations):
                each[-1] = each[-1] * (1 - shown["held_by_other"])[..., None]
        else:
            rest.append(_inputs(name, seen))
    assert rest[-1].shape[1] == rest_count(agent)
    return torch.cat(each, -1), torch.cat(rest, -1)


def _inputs(name: str, seen: Tensor) -> Tensor:
    if name.endswith(("gps_compass", "path_ahead")):
        d, a = seen[..., 0::2], seen[..., 1::2]
        return torch.cat([d / 5, torch.exp(-d), a.cos(), a.sin()], -1)
    if name == "other_velocity":
        return seen / 2.5
    if "way_to" in name:
        return torch.cat([seen.clamp_max(30.0) / 10, torch.exp(-seen / 2)], -1)
    return seen / 50 if name == "elapsed_s" else seen


def scored(arrays: Arrays, each: Tensor, rest: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Scores [P, N, C] and the next states [P, N, H] of P networks in N worlds each, as `ChooserNetwork.__call__`, for inputs
    [P, N, K, F] and [P, N, R] and states."""

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


def allowed(view: View) -> Tensor:
    """Which choices make sense to try, bool [W, C] (`sim_kinematic.policies.choosers.recurrent_chooser.allowed`)."""
    numbers = every_choice(view.choices, len(view.xz))
    kind, k, objects = view.choices.kind[numbers], view.choices.target[numbers], view.sim.bank.objects
    held = view.play.held_by
    lies = ((held == NOBODY) & ~view.sim.at_goal(view.hands, view.places)).gather(1, k)
    empty, mine = ~(held == view.who).any(1, keepdim=True), (held == view.who).gather(1, k)
    fetches = (kind == NAV_OBJECT) | (kind == PICK)
    handles = (kind == PICK) | (kind == PLACE)
    came = torch.where(handles, numbers - 2 * objects, numbers)
    last, outcome = view.does.last[:, None], view.does.outcome[:, None]
    arrived, going_on = (outcome == DONE) & (last == came), (outcome == ABORTED) & (last == numbers)
    may = torch.where(fetches, empty & lies, mine)
    return (kind > PLACE) | (may & ((arrived == handles) | going_on))
