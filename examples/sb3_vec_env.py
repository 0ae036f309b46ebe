"""PPO of Stable-Baselines3 on many worlds at once: an adapter of 60 lines between its vector environments and ours.

    pip install "h3data[env]" stable-baselines3
    python examples/sb3_vec_env.py --steps 20000 --worlds 16

Stable-Baselines3 would step single environments one after the other. Here all worlds make a step together.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import h3data


class Sb3VecEnv(VecEnv):
    """Worlds of h3data as Stable-Baselines3 expects them, with a new episode in the step in which one ends."""

    def __init__(self, task: str, scenes: Any, worlds: int, **options: Any) -> None:
        self.env: Any = h3data.make(task, scenes, num_envs=worlds, autoreset_mode="SAME_STEP", **options)
        self.render_mode = self.env.render_mode
        self._actions: Any = None
        super().__init__(worlds, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> Any:
        # one seed begins a run of episodes in every world; later resets go on with them
        seed, self._seeds = self._seeds[0], [None] * self.num_envs
        return self.env.reset(seed=seed)[0]

    def step_async(self, actions: Any) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        shown, reward, terminated, truncated, info = self.env.step(self._actions)
        facts = [{name: info[name][w] for name in ("success",) if name in info} for w in range(self.num_envs)]
        for w in np.flatnonzero(terminated | truncated):
            facts[w]["terminal_observation"] = info["final_obs"][w]
            facts[w]["TimeLimit.truncated"] = bool(truncated[w] and not terminated[w])
        return shown, reward.astype(np.float32), terminated | truncated, facts

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        values = self.env.get_attr(attr_name)
        return [values[w] for w in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        if indices is not None:
            raise NotImplementedError("All worlds have the attribute, or none.")
        self.env.set_attr(attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        values = self.env.call(method_name, *args, **kwargs)
        return [values[w] for w in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Any:
        return list(self.env.call("render"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--scenes", default="small:3")
    given = parser.parse_args()
    env = VecMonitor(Sb3VecEnv("social_nav", given.scenes, given.worlds))
    env.seed(1)
    model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=256, seed=1, device="cpu", verbose=1)
    model.learn(given.steps)
    print(f"{model.num_timesteps} steps in {given.worlds} worlds")


if __name__ == "__main__":
    main()
