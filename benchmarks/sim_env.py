"""Training environments: CPU seconds of this process, everything warm, the median of some rounds of random actions.

Person and robot touch now and then, so resets are in the figures. Pictures are the arm camera's depth and the ids that the
humanoid detector reads, 224 x 171. In rearrangement drawing an episode takes longest, so resets are apart there: steps are
those of one episode, 1/30 s each; of the upper layer all that its random choices take.
"""

from __future__ import annotations

import resource
from collections.abc import Callable
from statistics import median
from time import process_time

import numpy as np

import h3data
from benchmarks.sim import cpu_s
from sim_kinematic.envs.single import TaskEnv
from sim_kinematic.policies.rearrange_observations import PAPER_SENSES, STATE_SENSES
from sim_kinematic.sensing.table import PAPER_OBSERVATIONS, STATE_OBSERVATIONS
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

Emit = Callable[[str, float, str], None]
HOME = "small:1"
RESETS = 1000


def run(emit: Emit) -> None:
    """Emit ``sim.env.*`` and ``sim.reset_growth_mb``: how much more memory 1,000 resets have taken at most."""
    single = h3data.make("social_nav", HOME)
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
    _rearrange(emit)


def _rearrange(emit: Emit) -> None:
    """Emit ``sim.rearrange_env.*``, ``sim.rearrange.w256_steps_per_cpu_s`` and the same of whole skills.

    In the first, robots choose anew at every step while the person is close, and after some rounds most of them are, so that
    nearly every round is one step of one interrupted skill. Where choices are not interrupted, skills run to their ends.
    """
    endless = RearrangeSpec(max_steps=10**6, end_on_collision=False)
    rng = np.random.default_rng(0)
    for name, senses, size in (
        ("state", STATE_SENSES, None),
        ("depth", PAPER_SENSES, None),
        ("depth_detector", (*PAPER_SENSES, "humanoid_detector"), None),
        ("depth_rgb_160x120", (*PAPER_SENSES, "arm_rgb"), (160, 120)),
        ("depth_rgb", (*PAPER_SENSES, "arm_rgb"), None),
    ):
        env = h3data.make(
            "rearrange", HOME, level="low", partner="both", observations=senses, spec=endless, rgb_size=size
        )
        env.reset(seed=0)
        actions = rng.uniform(-1, 1, (100, 10))
        seconds = median(cpu_s(lambda env=env, actions=actions: [env.step(a) for a in actions]) for _ in range(5))
        emit(f"sim.rearrange_env.low_{name}_steps_per_cpu_s", len(actions) / seconds, "steps/s")
    for name, senses in {"state": STATE_SENSES, "depth": PAPER_SENSES}.items():
        env = h3data.make("rearrange", HOME, partner="both", observations=senses)
        steps = choices = seconds = 0.0
        for seed in range(10):
            _, info = env.reset(seed=seed)
            over = False
            while not over:
                chosen = int(rng.choice(np.flatnonzero(info["action_mask"])))
                begun = process_time()
                _, _, terminated, truncated, info = env.step(chosen)
                seconds += process_time() - begun
                steps, choices, over = steps + info["steps"], choices + 1, terminated or truncated
        emit(f"sim.rearrange_env.high_{name}_steps_per_cpu_s", steps / seconds, "steps/s")
        emit(f"sim.rearrange_env.high_{name}_choices_per_cpu_s", choices / seconds, "choices/s")
    emit("sim.rearrange.w256_steps_per_cpu_s", _rearranging(256, endless, rng), "steps/s")
    whole = _rearranging(256, endless, rng, interrupts=False)
    emit("sim.rearrange.w256_whole_skills_steps_per_cpu_s", whole, "steps/s")
    watched = h3data.make("rearrange", HOME, render_mode="rgb_array")
    watched.reset(seed=0)
    emit("sim.rearrange_env.render_ms", 1e3 * median(cpu_s(watched.render) for _ in range(20)), "ms")
    emit("sim.rearrange_env.reset_ms", 1e3 * median(cpu_s(watched.reset) for _ in range(20)), "ms")


def _rearranging(worlds: int, spec: RearrangeSpec, rng: np.random.Generator, *, interrupts: bool = True) -> float:
    """Return simulated steps of all worlds per CPU second, whose robots choose skills at random beside a planner."""
    env = h3data.make(
        "rearrange",
        HOME,
        partner="both",
        observations=STATE_SENSES,
        spec=spec,
        num_envs=worlds,
        interrupts_when_close=interrupts,
    )
    _, info = env.reset(seed=0)
    rates = []
    for _ in range(3):
        steps = seconds = 0.0
        for _ in range(10):
            chosen = (rng.random(info["action_mask"].shape) * info["action_mask"]).argmax(1)
            begun = process_time()
            *_, info = env.step(chosen)
            seconds += process_time() - begun
            steps += float(info["steps"].sum())
        rates.append(steps / seconds)
    return median(rates)


def _vector(worlds: int, steps: int, observations: tuple[str, ...]) -> float:
    env = h3data.make("social_nav", HOME, num_envs=worlds, observations=observations)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, worlds, 2))

    def go() -> None:
        for action in actions:
            env.step(action)

    go()
    return worlds * steps / median(cpu_s(go) for _ in range(5))


def _play(env: TaskEnv, steps: int) -> None:
    for action in np.random.default_rng(0).uniform(-1, 1, (steps, 2)):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}"))
