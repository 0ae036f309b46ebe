"""Stable-Baselines3 checks our vector environments and learns in them; run by `make check-rl` in an environment of its own."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor

import h3data
from sim_kinematic.motion.spec import SocialNavSpec

W, STEPS = 4, 12
SHORT = SocialNavSpec(max_steps=STEPS, spawn_distance_m=2.0)
adapter = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "sb3_vec_env.py"))["Sb3VecEnv"]

check_env(h3data.make("social_nav", "small:3", spec=SHORT))

# the worlds of the adapter are the single environments, and an episode's last observation is told
env = adapter("social_nav", "small:3", W, spec=SHORT)
env.seed(5)
shown = env.reset()
single = h3data.make("social_nav", "small:3", spec=SHORT)
alone, _ = single.reset(seed=5 + W - 1)
for step in range(STEPS):
    assert np.array_equal(shown["humanoid_gps"][-1], alone["humanoid_gps"]), step
    shown, reward, done, infos = env.step(np.full((W, 2), 0.3, np.float32))
    alone, own_reward, *_ = single.step(np.full(2, 0.3, np.float32))
    assert np.float32(own_reward) == reward[-1], step
assert done.all()
assert all(info["TimeLimit.truncated"] for info in infos)
assert np.array_equal(infos[-1]["terminal_observation"]["humanoid_gps"], alone["humanoid_gps"])
assert not np.array_equal(shown["humanoid_gps"][-1], alone["humanoid_gps"])

env = VecMonitor(adapter("social_nav", "small:3", W, spec=SHORT))
env.seed(1)
model = PPO("MultiInputPolicy", env, n_steps=32, batch_size=32, seed=1, device="cpu").learn(256)
assert model.num_timesteps == 256
assert len(model.ep_info_buffer) >= W
print(f"Stable-Baselines3: {model.num_timesteps} steps in {W} worlds, {len(model.ep_info_buffer)} episodes")
