"""Scores of shipped policies of rearrangement on a device and on the CPU, in the same fresh episodes with oracle skills.

``device_scores.ROBOT.PARTNER.cpu`` is the success rate that ``h3data evaluate rearrange --skills oracle --scenes
h3-homes/val --seed 9301 --episodes 150`` gives, whose episodes are sampled and played here in the same manner;
``.device`` is that of worlds as tensors (`h3data_training.populations.worlds`), in which these policies have learned, on
the GPU if there is one and else on the CPU. Choices are random numbers, other ones on either side, so the device plays
all episodes `ROUNDS` times. ``.apart`` is the difference, and ``.apart_ci`` half the width of its 95% interval.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

if TYPE_CHECKING:
    from h3data_training.torch.rearrange.bank import RearrangeBank
    from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode

Emit = Callable[[str, float, str], None]
PAIRS = (("learn_single", "learn_single_partner_0"), ("plan_pop_3_robot", "plan_pop_3"))
"""Robots with partners that they have learned with."""
EPISODES, ROUNDS, SCENES, SEED = 150, 8, "h3-homes/val", 9301


def run(emit: Emit, episodes: int = EPISODES) -> None:
    """Emit ``device_scores.*``."""
    import torch

    from h3data_training.torch.rearrange.bank import RearrangeBank

    torch.set_num_threads(1)
    drawn = list(fresh_episodes(episodes))
    bank = RearrangeBank.of(drawn)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    for robot, partner in PAIRS:
        there, here = device_successes(bank, robot, partner, device), cpu_successes(drawn, robot, partner)
        apart = there.mean(0) - here  # paired: the same episodes on both sides
        name = f"device_scores.{robot}.{partner}"
        emit(f"{name}.device", there.mean(), "success rate")
        emit(f"{name}.cpu", here.mean(), "success rate")
        emit(f"{name}.apart", apart.mean(), "success rate")
        emit(f"{name}.apart_ci", 1.96 * apart.std() / np.sqrt(episodes), "success rate")


def fresh_episodes(count: int) -> Iterator[RearrangeEpisode]:
    """Yield the episodes that ``h3data evaluate rearrange --skills oracle`` plays."""
    from h3data_pipelines.jobs.episodes import Choices, make_jobs
    from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode

    for job in make_jobs(Choices(task="rearrange", oracle=True), scenes=(SCENES,), episodes=count, seed=SEED):
        episode = job.episode()
        assert isinstance(episode, RearrangeEpisode)
        yield episode


def cpu_successes(episodes: list[RearrangeEpisode], robot: str, partner: str) -> Any:
    """Return whether each episode succeeds on the CPU, [N]."""
    from sim_kinematic.tasks.play import WorldRollout
    from sim_kinematic.tasks.rearrange.task import Rearrange
    from sim_kinematic.tasks.recorder import run as play_on

    chosen, task = {"robot": robot, "human": partner}, Rearrange()
    return np.array([play_on(WorldRollout.of(task, one, chosen)) == "success" for one in episodes])


def device_successes(bank: RearrangeBank, robot: str, partner: str, device: str, rounds: int = ROUNDS) -> Any:
    """Return whether each episode succeeds on a device in each round, [rounds, N]."""
    import torch

    from h3data_training.populations import worlds
    from h3data_training.populations.playing import Job
    from h3data_training.populations.settings import ROBOT
    from h3data_training.populations.worlds import TensorPlayers
    from sim_kinematic.policies.learned import is_learned, network_of
    from sim_kinematic.policies.rearrange import partner_plan

    names = {ROBOT: robot, **({partner: partner} if is_learned(partner) else {})}
    networks: Any = {name: network_of(file) for name, file in names.items()}
    # robots are trained at a temperature of 1, at which the device always chooses
    assert all(network.card.temperature == 1.0 for network in networks.values())
    players = TensorPlayers(bank, device)
    # planners bring things in the order of the episode, as in an evaluation, and not in that of a training episode
    orders: dict[str, Any] = (
        {} if partner in networks else {"_orders": lambda *_: torch.as_tensor(bank.orders(partner), device=device)}
    )
    plans = [partner if partner in networks else partner_plan(partner, seed) for seed in bank.seeds.tolist()]
    found = []
    for number in range(rounds):
        jobs = [Job(number, n, plan, networks, seed=1, gamma=0.99) for n, plan in enumerate(plans)]
        with patch.multiple(worlds, **orders) if orders else nullcontext():
            found.append([played.ended == "success" for played in players.play(jobs).played])
    return np.array(found)
