"""Training episodes that processes play with homes in memory, with observations, choices and rewards of learners.

An episode depends only on the weights, the seed and its number. Therefore any process can play it, and a lost episode
is played again.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields
from itertools import pairwise
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from os import _exit
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError
from h3data.geometry import Array
from h3data_training.populations.settings import ROBOT
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.policies.assignment import AssignedPolicy
from sim_kinematic.policies.choosers.chooser_network import OBSERVATIONS, SkillPolicyNetwork, encoded
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy
from sim_kinematic.policies.rearrange import planner
from sim_kinematic.policies.rearrange_observations import observe
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.policies.visual_policy import picture_of
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import run

LOST_IN_A_ROW = 3
"""Number of consecutive lost processes, without an episode in between, after which a run gives up."""


class Job(NamedTuple):
    """Job that plays one training episode."""

    number: int
    """Number of the episode in the run."""
    entry: int
    """Entry of the pool that describes the episode."""
    partner: str
    """Partner of the robot: a plan, or a learner by name."""
    networks: Mapping[str, SkillPolicyNetwork]
    """Networks of the learners that play, by name."""
    seed: int
    """Seed of the run."""
    gamma: float
    """Discount of one simulated step."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Decisions:
    """All D decisions of one learner in E episodes, by episode, as arrays or as tensors on a device."""

    each: Any
    """Inputs that belong to one object, [D, K, F] (`sim_kinematic.policies.choosers.chooser_network.encoded`)."""
    rest: Any
    """Inputs that belong to no single object, [D, R]."""
    pictures: Any
    """Square roots of depth images, float16 [D, H, W] in 0..1; [D, 0, 0] for a policy without pictures."""
    told: Any
    """Exact state for the critic of a policy that observes only pictures, [D, N]; [D, 0] for other policies."""
    state: Any
    """Recurrent state before the decision, [D, H]."""
    allowed: Any
    """True for choices that are allowed, bool [D, C]."""
    chosen: Any
    """Choices made, int64 [D]."""
    log_prob: Any
    gain: Any
    """Reward until the next decision, discounted to the time of this decision, [D]."""
    discount: Any
    """Discount of returns from the next decision on, [D]; 0 after the last decision, because the time is observed and
    the end of an episode is final.
    """
    counts: NDArray[np.int64]
    """Number of decisions in each episode, [E]; their sum is D."""
    partners: tuple[str, ...]
    """Partner of the robot in each episode, [E]."""

    def __len__(self) -> int:
        return len(self.chosen)


@dataclass(frozen=True, kw_only=True)
class Played:
    """Result of one training episode."""

    partner: str
    steps: int
    ended: str
    reward: float
    placed: int
    """Number of objects at their goals that the robot was the last to put there."""
    at_goal: int
    """Number of objects that are at their goals."""


class Batch(NamedTuple):
    """Training episodes, and all decisions in them by learner."""

    played: tuple[Played, ...]
    decisions: Mapping[str, Decisions]

    @classmethod
    def joined(cls, parts: Sequence[Batch]) -> Batch:
        """Return several batches joined into one, episode after episode."""
        found: dict[str, list[Decisions]] = {}
        for part in parts:
            for name, decisions in part.decisions.items():
                found.setdefault(name, []).append(decisions)
        columns = [f.name for f in fields(Decisions) if f.name != "partners"]
        joined = {
            name: Decisions(
                **{column: np.concatenate([getattr(one, column) for one in own]) for column in columns},
                partners=tuple(partner for one in own for partner in one.partners),
            )
            for name, own in found.items()
        }
        return cls(tuple(played for part in parts for played in part.played), joined)


class _Sampler(RecurrentSkillPolicy):
    """Chooser that samples by the scores, and stores all its observations."""

    def __init__(self, network: SkillPolicyNetwork, objects: int, *, robot: bool, rng: np.random.Generator) -> None:
        super().__init__(network, objects, robot=robot)
        self._rng = rng
        self.rows: list[tuple[Any, ...]] = []
        self.steps: list[int] = []

    def choose(self, view: RearrangeView, each: Array, rest: Array, scores: Array) -> int:
        log_probs = log_softmax(scores.astype(np.float64))
        chosen = int(np.argmax(log_probs + self._rng.gumbel(size=len(scores))))
        card = self.network.card
        seen, told = np.zeros((0, 0), np.float16), np.zeros(0, np.float32)
        if self.network.sees:
            seen = np.sqrt(picture_of(card, self.shown)[..., 0].astype(np.float32)).astype(np.float16)
            told = np.concatenate(
                [x.ravel() for x in encoded(observe(view, OBSERVATIONS), agent=card.agent, objects=card.objects)]
            )
        self.rows.append((each, rest, seen, told, self.state, np.isfinite(scores), chosen, log_probs[chosen]))
        self.steps.append(view.step)
        return chosen

    def decisions(self, rewards: Sequence[float], gamma: float, partner: str) -> Decisions:
        """Return all decisions with the reward that followed each; ``rewards`` are those of each simulated step."""
        columns = (np.array(column) for column in zip(*self.rows, strict=True))
        each, rest, pictures, told, state, allowed, chosen, log_prob = columns
        gains, spans = discounted(np.array(rewards), self.steps, gamma)
        return Decisions(
            each=each,
            rest=rest,
            pictures=pictures,
            told=told,
            state=state,
            allowed=allowed,
            chosen=chosen,
            log_prob=log_prob.astype(np.float32),
            gain=gains.astype(np.float32),
            discount=np.append(gamma ** spans[:-1], 0.0).astype(np.float32),
            counts=np.array([len(chosen)]),
            partners=(partner,),
        )


def log_softmax(scores: Array) -> Array:
    """Return the logarithms of the probabilities for scores [C]; minus infinity remains minus infinity."""
    shifted = scores - scores.max()
    return shifted - np.log(np.exp(shifted).sum())


def discounted(rewards: Array, steps: Sequence[int], gamma: float) -> tuple[Array, NDArray[np.int64]]:
    """Return the discounted reward between consecutive decisions [D], and the number of steps between them.

    Decisions are made at ``steps`` [D], and rewards are discounted to these steps. If several decisions are made at one
    step, all but the last of them have no reward.
    """
    edges = np.append(steps, len(rewards))
    gains = [float(rewards[a:b] @ gamma ** np.arange(b - a)) for a, b in pairwise(edges)]
    return np.array(gains), np.diff(edges)


def play_episode(job: Job, episode: RearrangeEpisode) -> Batch:
    """Play one training episode."""
    objects = len(episode.targets)
    samplers: dict[str, _Sampler] = {}
    policies = []
    for kind, name in ((ROBOT, ROBOT), ("human", job.partner)):
        if name in job.networks:
            rng = generator(job.seed, f"choices/{name}", step=job.number)
            samplers[name] = _Sampler(job.networks[name], objects, robot=kind == ROBOT, rng=rng)
            policies.append(AssignedPolicy(samplers[name], name, kind))
        else:
            plan = planner(name, episode_seed(job.seed, job.number), objects)
            policies.append(AssignedPolicy(plan, name, kind, name))
    play, rewards = WorldRollout.of(Rearrange(), episode, policies), []
    run(play, progress=lambda _: rewards.append(play.reward))
    there = [name for name, at_goal in zip(play.team.objects.names, play.team.at_goal.tolist(), strict=True) if at_goal]
    by = {event.target: event.agent for event in play.events if event.kind == "place"}
    played = Played(
        partner=job.partner,
        steps=play.step,
        ended=play.ended,
        reward=float(np.sum(rewards)),
        placed=sum(by.get(name) == 0 for name in there),
        at_goal=len(there),
    )
    found = {name: sampler.decisions(rewards, job.gamma, job.partner) for name, sampler in samplers.items()}
    return Batch((played,), found)


# --- processes ----------------------------------------------------------------------------------------------------------
_EPISODES: Sequence[RearrangeEpisode] = ()
"""Episodes of this process, in their state when it was forked."""


class Players:
    """Pool of processes that play training episodes, or only this process if there is one worker."""

    def __init__(
        self,
        episodes: Sequence[RearrangeEpisode],
        workers: int,
        *,
        device: str = "cpu",
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Prepare players of a list of episodes; ``device`` is that on which learners use the decisions."""
        global _EPISODES
        self.device = device
        _EPISODES = self._episodes = tuple(episodes)
        self.workers, self._say = workers, say
        self._pool: ProcessPoolExecutor | None = None

    @property
    def size(self) -> int:
        """Number of episodes to choose from."""
        return len(self._episodes)

    @property
    def homes(self) -> int:
        """Number of homes of the episodes."""
        return len({id(episode.scene) for episode in self._episodes})

    def warm_up(self, jobs: Sequence[Job]) -> None:
        """Compile and load code once, before several processes start, by playing the first of some episodes."""
        self.play(jobs[:1])

    def play(self, jobs: Sequence[Job]) -> Batch:
        """Play episodes in order, and leave out episodes that raise an error.

        Raises:
            H3DataError: processes are lost repeatedly, or every episode raises an error.
        """
        played: dict[int, Batch | str] = {}
        lost = 0
        while len(played) < len(jobs):
            before = len(played)
            missing = [job for job in jobs if job.number not in played]
            try:
                for job, result in zip(missing, self._results(missing), strict=True):
                    played[job.number] = result
            except BrokenProcessPool:
                self.close()
                lost = lost + 1 if len(played) == before else 1
                if lost == LOST_IN_A_ROW:
                    raise H3DataError(
                        f"Processes that play were lost {lost} times without an episode in between: killed, or out of "
                        "memory. The checkpoint is as it was. Hint: fewer --workers, then --resume.",
                        code="H3-TRAIN-024",
                    ) from None
                self._say("a process that plays was lost; its episodes are played again")
        faults = [f"episode {n}: {fault}" for n, fault in played.items() if isinstance(fault, str)]
        for fault in faults:
            self._say(f"left out {fault}")
        if len(faults) == len(jobs):
            raise H3DataError(f"No episode could be played: {faults[0]}", code="H3-TRAIN-023")
        return Batch.joined([result for job in jobs if isinstance(result := played[job.number], Batch)])

    def _results(self, jobs: Sequence[Job]) -> Any:
        if self.workers == 1:
            return map(_tried, jobs)
        if self._pool is None:
            global _EPISODES
            _EPISODES = self._episodes
            self._pool = ProcessPoolExecutor(self.workers, mp_context=get_context("fork"), initializer=_begin)
        return self._pool.map(_tried, jobs)

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


def _begin() -> None:
    """Prepare a process that ignores Ctrl-C, which reaches all processes, and ends with the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        _exit(1)


def _tried(job: Job) -> Batch | str:
    try:
        return play_episode(job, _EPISODES[job.entry])
    except Exception as fault:  # one episode of thousands: the others count
        return f"{type(fault).__name__}: {fault}"
