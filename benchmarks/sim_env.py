"""Training environments: CPU seconds of this process, everything warm, the median of some rounds of random actions.

Person and robot touch now and then, so resets are in the figures. Pictures are the arm camera's depth and the ids that the
humanoid detector reads, 224 x 171.
"""

from __future__ import annotations

import resource
from collections.abc import Callable
from statistics import median

import numpy as np

from benchmarks.sim import cpu_s
from sim_kinematic.env import SocialNavEnv
from sim_kinematic.observations import PAPER_OBSERVATIONS, STATE_OBSERVATIONS
from sim_kinematic.vector_env import SocialNavVectorEnv

Emit = Callable[[str, float, str], None]
HOME = "small:1"
RESETS = 1000


def run(emit: Emit) -> None:
    """Emits ``sim.env.*`` and ``sim.reset_growth_mb``: how much more memory 1,000 resets have taken at most."""
    single = SocialNavEnv(HOME)
    single.reset(seed=0)
    emit(
        "sim.env.single_steps_per_cpu_s", 1000 / median(cpu_s(lambda: _play(single, 1000)) for _ in range(5)), "steps/s"
    )
    for worlds, steps in ((16, 400), (256, 60), (1024, 20)):
        emit(f"sim.env.w{worlds}_env_steps_per_cpu_s", _vector(worlds, steps, STATE_OBSERVATIONS), "steps/s")
    for worlds, steps in ((1, 100), (16, 12)):
        emit(f"sim.env.w{worlds}_depth_fps", _vector(worlds, steps, PAPER_OBSERVATIONS), "frames/s")
    emit("sim.env.reset_ms", 1e3 * median(cpu_s(single.reset) for _ in range(100)), "ms")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(RESETS):
        single.reset()
    emit("sim.reset_growth_mb", (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024, "MiB")


def _vector(worlds: int, steps: int, observations: tuple[str, ...]) -> float:
    env = SocialNavVectorEnv(worlds, HOME, observations=observations)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, worlds, 2))

    def go() -> None:
        for action in actions:
            env.step(action)

    go()
    return worlds * steps / median(cpu_s(go) for _ in range(5))


def _play(env: SocialNavEnv, steps: int) -> None:
    for action in np.random.default_rng(0).uniform(-1, 1, (steps, 2)):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}"))
