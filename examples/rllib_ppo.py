"""PPO of RLlib on many worlds at once, by RLlib's entry point for vector environments.

    pip install "h3data[env]" "ray[rllib]"
    python examples/rllib_ppo.py --updates 10 --worlds 16

RLlib would step single environments one after the other. Here all worlds make a step together.
"""

from __future__ import annotations

import argparse
from typing import Any

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune.registry import register_env

import h3data


def make_env(config: dict[str, Any]) -> Any:
    """Return one environment, for its spaces, or ``num_envs`` worlds; observations are one vector, as RLlib's networks
    take them.
    """
    return h3data.make(
        config["task"], config["scenes"], num_envs=config.get("num_envs"), flatten=True, **config["options"]
    )


def ppo_config(task: str, scenes: Any, worlds: int, *, per_update: int = 1024, **options: Any) -> PPOConfig:
    """Return the settings of PPO in this process, without workers; ``options`` are those of `h3data.make`."""
    register_env("h3data", make_env)
    return (
        PPOConfig()
        .environment("h3data", env_config={"task": task, "scenes": scenes, "options": options})
        .env_runners(num_env_runners=0, num_envs_per_env_runner=worlds, gym_env_vectorize_mode="vector_entry_point")
        .learners(num_learners=0)
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64]))
        .training(train_batch_size_per_learner=per_update, minibatch_size=per_update // 4, num_epochs=4, lr=3e-4)
        .debugging(seed=1)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=10)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--scenes", default="small:3")
    given = parser.parse_args()
    ray.init(num_cpus=1, include_dashboard=False)
    algorithm = ppo_config("social_nav", given.scenes, given.worlds).build_algo()
    for k in range(given.updates):
        found = algorithm.train()
        loss, steps = found["learners"]["default_policy"]["total_loss"], found["env_runners"]["num_env_steps_sampled"]
        print(f"update {k}: loss {loss:.3f}, {steps} steps")
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
