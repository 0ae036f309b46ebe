"""TorchRL checks our environments and learns in them; run by `make check-rl` in an environment of its own."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import GymWrapper, check_env_specs

import h3data
from sim_kinematic.motion.spec import SocialNavSpec

W, STEPS = 4, 12
SHORT = SocialNavSpec(max_steps=STEPS, spawn_distance_m=2.0)
example = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "torchrl_ppo.py"))

check_env_specs(GymWrapper(h3data.make("social_nav", "small:3", spec=SHORT)))
env = example["make_env"]("social_nav", "small:3", W, spec=SHORT)
check_env_specs(env)

# an episode ends with its own last observation, and everything seen and done is in the spaces
ahead = TensorDictModule(lambda gps: torch.full((len(gps), 2), 0.3), in_keys=["humanoid_gps"], out_keys=["action"])
env.set_seed(5)
for policy in (ahead, None):
    seen = env.rollout(2 * STEPS, policy, break_when_any_done=False)
    ended = seen["next", "truncated"].squeeze(-1)
    assert ended[:, STEPS - 1 :: STEPS].all(), ended
    assert ended.sum() == 2 * W, ended
    assert not torch.equal(seen["next", "humanoid_gps"][:, STEPS - 1], seen["humanoid_gps"][:, STEPS])
    assert torch.equal(seen["next", "humanoid_gps"][:, : STEPS - 1], seen["humanoid_gps"][:, 1:STEPS])
    for k in range(2 * STEPS):
        assert env.observation_spec.is_in(seen[:, k].select(*env.observation_spec.keys())), k
        assert env.action_spec.is_in(seen["action"][:, k]), k

torch.manual_seed(1)
history = example["train"](env, 512, per_update=128, epochs=2)
assert len(history) == 4
assert all(math.isfinite(value) for row in history for value in row.values()), history
print(f"TorchRL: 512 steps in {W} worlds, losses {[round(row['loss'], 2) for row in history]}")
