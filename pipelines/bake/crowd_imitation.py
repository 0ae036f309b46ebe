"""Script that trains `datasets/policies/crowd_imitation.npz`: a network that imitates `mpc` among people (DAgger).

In the first round `mpc` drives, in later ones the network learned so far, and `mpc` says in each step what it would do
there. The network learns from all rounds. About five minutes of one core.

    PYTHONPATH=pipelines python -m bake.crowd_imitation datasets/policies/crowd_imitation.npz
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import h3data
from h3data_crowds.crowd_nav import CrowdNav
from h3data_crowds.imitation import command, observe
from h3data_crowds.robots import CRUISE_MPS, mpc
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies.network import Network, from_torch, save_network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import AgentView

ROUNDS, EPISODES, STEPS = 3, 24, 1200
HOMES, SEED = 37, 1000
UNITS, EPOCHS, BATCH = 128, 40, 512


class Pupil:
    """A robot that drives by a network, or by `mpc` while there is none, and notes what `mpc` would do."""

    def __init__(self, network: Network | None) -> None:
        """Create the robot of one episode."""
        self._network = network
        self.shown: list[np.ndarray] = []
        self.told: list[tuple[float, float]] = []

    def act(self, view: AgentView) -> Velocity:
        """Return the next command."""
        base: BaseSpec = view.base
        best = mpc(view, base)
        self.shown.append(observe(view, base))
        self.told.append((best.forward * base.max_speed_mps / CRUISE_MPS, best.turn))
        return best if self._network is None else command(self._network, view, base)


def learn(shown: np.ndarray, told: np.ndarray) -> Network:
    """Return a network that has learned the commands ``told`` [N, 2] for the inputs ``shown`` [N, K]."""
    import torch
    from torch import nn

    torch.set_num_threads(1)
    torch.manual_seed(0)
    mean, scale = shown.mean(0), np.maximum(shown.std(0), 1e-3)
    net = nn.Sequential(
        nn.Linear(shown.shape[1], UNITS), nn.Tanh(), nn.Linear(UNITS, UNITS), nn.Tanh(), nn.Linear(UNITS, 2)
    )
    x, y = torch.as_tensor((shown - mean) / scale).float(), torch.as_tensor(told).float()
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=EPOCHS * -(-len(x) // BATCH))
    loss = torch.zeros(())
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(x)).split(BATCH):
            # of two ways past somebody, the middle is none: an absolute error is drawn to one of them
            loss = (net(x[rows]) - y[rows]).abs().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return from_torch(net, task=CrowdNav().name, observations=("crowd",), mean=mean, scale=scale)


def main(out: str) -> None:
    """Train the network and write it."""
    network, shown, told = None, [], []
    for number in range(ROUNDS):
        reached = 0
        for k in range(EPISODES):
            seed, home = SEED + number * EPISODES + k, (number * EPISODES + k) % HOMES
            pupil = Pupil(network)
            recording = h3data.simulate(
                CrowdNav, f"h3-homes/train#{home}", agents={"robot": pupil}, seed=seed, max_steps=STEPS
            )
            reached += bool(recording.columns["metrics.success"].any())
            shown += pupil.shown
            told += pupil.told
        sys.stdout.write(f"round {number}: {reached} of {EPISODES} arrive; {len(told)} steps in all\n")
        sys.stdout.flush()
        network = learn(np.array(shown), np.array(told))
        save_network(network, Path(out))


if __name__ == "__main__":
    main(*sys.argv[1:])
