"""Training episodes with oracle skills in worlds on a device, all episodes of an update at once.

The decisions equal those of `h3data_training.populations.playing`. The episodes of an update depend on the weights, the
seed, and their numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from h3data_training.cpu_cameras import CpuCameras
from h3data_training.envs.task_torch_env import arm_cameras, arm_pictures, cameras_of
from h3data_training.populations.playing import Batch, Decisions, Job, Played
from h3data_training.populations.settings import ROBOT
from h3data_training.populations.tensor_choosers import Row, TensorSkillPolicy
from h3data_training.torch.graph import can_fuse, captured, fused, overwrite
from h3data_training.torch.rearrange.bank import RearrangeBank, orders
from h3data_training.torch.rearrange.observations import Paths, View
from h3data_training.torch.rearrange.state import FREE, Play
from h3data_training.torch.rearrange.worlds import RearrangeTensors
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.policies.rearrange import planner

APART_M = 2.0
"""Smallest distance between agents at the start [m]."""
SEEN = ("arm_depth", "humanoid_detector")
"""Observations that are computed from pictures."""
LOOK_STEPS = 5
"""Number of steps from one picture to the next. A picture takes longer than the rest of a step, and agents that are
close to each other choose once in five steps (`sim_kinematic.policies.choosers.recurrent_chooser.ALERT_STEPS`). A
picture is at most 4 steps old.
"""
CHECK_STEPS = 25
"""Number of steps between checks whether all episodes are over, which wait for the device."""


class TensorPlayers:
    """Player of training episodes in worlds on a device.

    The interface is that of `h3data_training.populations.playing.Players`.
    """

    workers = 1

    def __init__(
        self,
        bank: RearrangeBank,
        device: torch.device | str,
        *,
        compile: bool | None = None,
        moves_starts: bool = False,
        picture_size: tuple[int, int] | None = None,
    ) -> None:
        """Copy a bank of episodes to the device.

        Args:
            bank: episodes to choose from.
            device: device of the worlds.
            compile: whether the operations of a step are fused; by default on a GPU, if Triton is installed.
            moves_starts: whether agents start at starts of any episodes of the same home.
            picture_size: width and height of the robot's pictures [px]; None for a robot without pictures. Objects are
                rendered at their places in the home even while an agent holds them.
        """
        self._size = picture_size
        self._bank, self.device, self._moves_starts = bank, torch.device(device), moves_starts
        self._compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._worlds: _Worlds | None = None

    @property
    def size(self) -> int:
        """Number of episodes to choose from."""
        return len(self._bank)

    @property
    def homes(self) -> int:
        """Number of homes of the episodes."""
        return len(self._bank.floors)

    def warm_up(self, jobs: Sequence[Job]) -> None:
        """Compile a step, if steps are compiled, by playing some episodes."""
        if self._compiles or self.device.type == "cuda":
            self.play(jobs)

    def play(self, jobs: Sequence[Job]) -> Batch:
        """Play some episodes all at once, and return them in order."""
        casts = _casts(jobs)
        with torch.no_grad():
            if self._worlds is None or self._worlds.casts != casts:
                self._worlds = None  # their memory first
                self._worlds = _Worlds(
                    self._bank,
                    casts,
                    self.device,
                    compiles=self._compiles,
                    moves_starts=self._moves_starts,
                    picture_size=self._size,
                )
            return self._worlds.played(jobs)

    def close(self) -> None:
        """Do nothing, as nothing needs closing."""


Casts = tuple[tuple[tuple[str, int], ...], ...]


def _casts(jobs: Sequence[Job]) -> Casts:
    """Return the learners that play the robot and, where people learn, the person: names, and in how many worlds."""
    people = [job.partner for job in jobs if job.partner in job.networks]
    assert len(people) in (0, len(jobs))
    return tuple(tuple(sorted(Counter(names).items())) for names in ([ROBOT] * len(jobs), people) if names)


class _Worlds:
    """Worlds in which one update after the other is played, in the same places in memory: on a GPU a step is one CUDA graph."""

    def __init__(
        self,
        bank: RearrangeBank,
        casts: Casts,
        device: torch.device,
        *,
        compiles: bool,
        moves_starts: bool,
        picture_size: tuple[int, int] | None,
    ) -> None:
        self._moves_starts = moves_starts
        self.casts = casts
        count, self._longest = sum(n for _, n in casts[0]), bank.spec.max_steps
        planners = () if len(casts) > 1 else ("human",)
        self._sim = RearrangeTensors(bank, device=device, planners=planners, interrupts="always", repeats=False)
        self._play = self._sim.before_the_first(torch.zeros(count, dtype=torch.int64))
        self._choosers = [
            TensorSkillPolicy(self._sim, self._play, cast, agent)
            for cast, agent in zip(casts, (ROBOT, "human"), strict=False)
        ]
        self._cameras = None if picture_size is None else _cameras(bank, count, picture_size, device, compiles)
        self._nothing = torch.full((count,), FREE, dtype=torch.int64, device=device)
        self._step = torch.zeros(1, dtype=torch.int64, device=device)
        self._rewards = torch.zeros(self._longest, count, dtype=self._sim.dtype, device=device)
        # in parts: the time to compile one grows faster than its size
        self._find = fused(self._paths) if compiles else self._paths
        self._choose = [fused(chooser.choose) if compiles else chooser.choose for chooser in self._choosers]
        self._move = fused(self._moved) if compiles else self._moved
        self._advance: Callable[[], object] = self._eager
        self._look: Callable[[], object] = self._draw

    def played(self, jobs: Sequence[Job]) -> Batch:
        """Play some episodes and return their batch, in their order."""
        device, seed = self._sim.device, episode_seed(jobs[0].seed, jobs[0].number) % 2**63
        entries = torch.tensor([job.entry for job in jobs], device=device)
        generator = torch.Generator(device).manual_seed(seed)
        fresh = self._sim.start_at(entries, self._starts(entries, generator))
        if len(self._choosers) == 1:
            orders_ = _orders(jobs, self._sim.bank.objects, device)
            fresh = fresh._replace(human_does=fresh.human_does._replace(order=orders_))
        overwrite(self._play.tensors(), fresh.tensors())
        self._step.zero_()
        for chooser, names in zip(self._choosers, ([ROBOT] * len(jobs), [job.partner for job in jobs]), strict=False):
            chooser.begin(jobs, names, generator, steps=self._longest)
        if device.type == "cuda" and self._advance == self._eager:
            if self._cameras is not None:
                self._draw()  # makes what the graphs write into
                self._look = captured(self._draw, [self._step])
            changed = [t for chooser in self._choosers for t in chooser.remembered]
            self._advance = captured(self._eager, [*self._play.tensors(), *changed, self._step])
        steps = 0
        while steps < self._longest:
            if self._cameras is not None and steps % LOOK_STEPS == 0:
                self._look()
            self._advance()
            steps += 1
            if steps % CHECK_STEPS == 1 and bool(self._play.ended.all()):
                break
        return _batch(self._sim, self._play, jobs, self._choosers, self._rewards[:steps].double())

    def _starts(self, entries: Tensor, generator: torch.Generator) -> Tensor:
        """Return the starts ``(x, z, heading)`` of robot and person, [W, 2, 3].

        With `moves_starts` each agent begins where it does in a random episode of the same home, unless both would be
        too close to each other. There are then as many combinations as pairs of episodes in a home.
        """
        starts = self._sim.tables.starts
        own = starts[entries]
        if not self._moves_starts:
            return own
        place = self._sim.tables.place
        by_home, counts = place.argsort(stable=True), place.bincount()
        home = place[entries][:, None]
        picked = torch.rand(len(entries), 2, generator=generator, device=entries.device)
        nth = torch.minimum((picked * counts[home]).long(), counts[home] - 1)
        other = by_home[(counts.cumsum(0) - counts)[home] + nth]
        found = torch.stack([starts[other[:, who], who] for who in range(2)], 1)
        gap = found[:, 0, :2] - found[:, 1, :2]
        return torch.where((torch.hypot(gap[:, 0], gap[:, 1]) < APART_M)[:, None, None], own, found)

    def _eager(self) -> None:
        """Make one step of all worlds, in place."""
        paths, chosen = self._find(), []
        for chooser, choose in zip(self._choosers, self._choose, strict=True):
            choice, *row = choose(*paths, chooser.noise(self._step))
            chooser.keep(Row(*row), self._step)
            chosen.append(choice)
        self._move(chosen[0], chosen[1] if len(chosen) > 1 else self._nothing)
        self._rewards.index_copy_(0, self._step, self._play.reward[None])
        self._step.add_(1)

    def _draw(self) -> None:
        """Show robots what they see now."""
        assert self._cameras is not None
        self._cameras.pose(self._play.robot, self._play.human, place=self._sim.tables.at(self._play.episode).place)
        seen = arm_pictures(self._cameras, SEEN)
        self._choosers[0].look(seen["arm_depth"][..., 0], seen["humanoid_detector"])

    def _paths(self) -> tuple[Tensor, Tensor, Tensor]:
        paths = Paths.of(self._sim, self._play, self._sim.tables.at(self._play.episode))
        return paths.xz, paths.lengths, paths.ahead

    def _moved(self, robot: Tensor, human: Tensor) -> None:
        overwrite(self._play.tensors(), self._sim.step(self._play, robot, human).tensors())


def _cameras(bank: RearrangeBank, worlds: int, size: tuple[int, int], device: torch.device, compiles: bool) -> Any:
    """Return cameras on the robots' arms; on a CPU those that are slow."""
    views, walker = arm_cameras(SEEN), bank.spec.human
    if device.type == "cuda":
        options = {"worlds": worlds, "views": views, "size": size, "device": device, "compile": compiles}
        return cameras_of(bank, bank.robot, bank.human, walker, **options)
    floors = [floor.floor_y for floor in bank.floors]
    return CpuCameras(bank.scenes, bank.robot.name, bank.human.name, walker, floors=floors, views=views, size=size)


def _orders(jobs: Sequence[Job], objects: int, device: torch.device) -> Tensor:
    """Return the plans of the partners, [W, K], as in `h3data_training.populations.playing.play_episode`."""
    plans = [planner(job.partner, episode_seed(job.seed, job.number), objects).objects for job in jobs]
    return torch.as_tensor(orders(plans, objects), device=device)


def _batch(
    sim: RearrangeTensors, play: Play, jobs: Sequence[Job], choosers: Sequence[TensorSkillPolicy], rewards: Tensor
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
