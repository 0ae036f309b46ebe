"""RLlib learns in our vector environments; run by `make check-rl` in an environment of its own."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import ray

from sim_kinematic.motion.spec import SocialNavSpec

W, STEPS = 4, 12
SHORT = SocialNavSpec(max_steps=STEPS, spawn_distance_m=2.0)
example = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "rllib_ppo.py"))

ray.init(num_cpus=1, include_dashboard=False)
try:
    algorithm = example["ppo_config"]("social_nav", "small:3", W, per_update=128, spec=SHORT).build_algo()
    env = algorithm.env_runner.env.unwrapped

    # whole episodes, whose observations and actions are in the spaces
    episodes = algorithm.env_runner.sample(num_episodes=2 * W, random_actions=True)
    assert len(episodes) >= 2 * W
    for episode in episodes:
        assert len(episode) == STEPS, len(episode)
        assert episode.is_truncated
        assert all(env.single_observation_space.contains(shown) for shown in episode.get_observations())
        assert all(env.single_action_space.contains(action) for action in episode.get_actions())
        assert all(math.isfinite(reward) for reward in episode.get_rewards())

    losses = []
    for _ in range(3):
        found = algorithm.train()
        losses.append(found["learners"]["default_policy"]["total_loss"])
    assert all(math.isfinite(loss) for loss in losses), losses
    steps = found["env_runners"]["num_env_steps_sampled_lifetime"]
    assert steps >= 3 * 128, steps
    print(f"RLlib: {steps:.0f} steps in {W} worlds, losses {[round(float(loss), 2) for loss in losses]}")
    algorithm.stop()
finally:
    ray.shutdown()
