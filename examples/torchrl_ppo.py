"""PPO of TorchRL on many worlds at once, with TorchRL's wrapper of Gymnasium around our vector environments.

    pip install "h3data[env]" torchrl
    python examples/torchrl_ppo.py --steps 20000 --worlds 16

With ``autoreset_mode="DISABLED"`` TorchRL itself selects the worlds that begin again, so no episode's last observation
is lost.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import CatTensors, Compose, DoubleToFloat, GymWrapper, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import h3data


def make_env(task: str, scenes: Any, worlds: int, **options: Any) -> TransformedEnv:
    """Return all numbers that the agent observes as one vector, in all worlds at once."""
    env = GymWrapper(h3data.make(task, scenes, num_envs=worlds, autoreset_mode="DISABLED", **options))
    numbers = [key for key, spec in env.observation_spec.items() if spec.ndim == 2]
    joined = CatTensors(in_keys=numbers, out_key="observation", del_keys=False)
    return TransformedEnv(env, Compose(DoubleToFloat(), joined, RewardSum(), StepCounter()))


def make_networks(env: TransformedEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    """Return an actor and a critic, with a hidden layer each."""
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    mean_and_scale = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 2 * actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(mean_and_scale, in_keys=["observation"], out_keys=["loc", "scale"]),
        spec=env.action_spec,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": env.action_spec.space.low[0], "high": env.action_spec.space.high[0]},
        return_log_prob=True,
    )
    critic = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 1))
    return actor, ValueOperator(critic, in_keys=["observation"])


def train(env: TransformedEnv, steps: int, *, per_update: int = 1024, epochs: int = 4) -> list[dict[str, float]]:
    """Learn for a number of steps of all worlds together; return the losses and the rewards of each update."""
    actor, critic = make_networks(env)
    loss_of, advantage_of = ClipPPOLoss(actor, critic), GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss_of.parameters(), lr=3e-4)
    history = []
    for batch in Collector(
        env, actor, frames_per_batch=per_update, total_frames=steps, auto_register_policy_transforms=True
    ):
        for _ in range(epochs):
            with torch.no_grad():
                advantage_of(batch)
            flat = batch.reshape(-1)
            for part in flat[torch.randperm(len(flat))].split(256):
                losses = loss_of(part)
                loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(loss_of.parameters(), 0.5)
                optimizer.step()
        history.append({"loss": loss.item(), "reward_per_step": batch["next", "reward"].mean().item()})
    return history


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--scenes", default="small:3")
    given = parser.parse_args()
    torch.manual_seed(1)
    env = make_env("social_nav", given.scenes, given.worlds)
    env.set_seed(1)
    for k, row in enumerate(train(env, given.steps)):
        print(f"update {k}: loss {row['loss']:.3f}, reward {row['reward_per_step']:.4f} a step")


if __name__ == "__main__":
    main()
