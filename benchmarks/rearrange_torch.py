"""Rearrangement with oracle skills as tensors: worlds times steps a second on one CPU thread and, where there is one, on a GPU.

``rearrange_torch.{cpu,cuda}.state_*`` steps the state alone (robots drive, people walk, grips, planners, contact, rewards, new
episodes), ``env_*`` whole environments with `STATE_SENSES`: the robot chooses at random what its hand allows whenever it is
free, a planner of ``plan_pop_4`` is beside it. On a GPU a step is one CUDA graph, of operations one by one (``graph``) or fused
(``compiled``); ``rearrange_torch.cuda.apart_m`` is how far places are from those of the CPU after 300 steps of float64.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

    from h3data_training.torch.rearrange.bank import RearrangeBank

Emit = Callable[[str, float, str], None]
HOMES, EPISODES = ["small:1", "small:2", "h3-homes/train#0", "h3-homes/train#1"], 64
CPU_WORLDS, CUDA_WORLDS = (256, 2048), (1024, 8192, 65536)
CPU_STEPS, CUDA_STEPS, ROUNDS = 10, 50, 5


def run(emit: Emit) -> None:
    """Emit ``rearrange_torch.*``; the lines of the GPU only where there is one."""
    import torch

    from h3data_training.torch.rearrange.bank import RearrangeBank

    start = time.process_time()
    bank = RearrangeBank.draw(HOMES, EPISODES)
    emit("rearrange_torch.bank_cpu_s_per_episode", (time.process_time() - start) / EPISODES, "s")
    emit(
        "rearrange_torch.bank_bytes_per_episode",
        (bank.first.nbytes + bank.after.nbytes + bank.left.nbytes) / EPISODES,
        "B",
    )
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for worlds in CPU_WORLDS:
        for name, step in _steps(bank, worlds, "cpu", compile=False):
            seconds = median(seconds_of_step(step, CPU_STEPS, time.process_time) for _ in range(ROUNDS))
            emit(f"rearrange_torch.cpu.{name}_w{worlds}.steps_s", worlds / seconds, "steps/s")
    torch.set_num_threads(threads)
    if not torch.cuda.is_available():
        print("# rearrange_torch.cuda: no GPU that torch can use")
        return
    emit("rearrange_torch.cuda.apart_m", _apart(bank), "m")
    for worlds in CUDA_WORLDS:
        for compile, how in ((False, "graph"), (True, "compiled")):
            for name, step in _steps(bank, worlds, "cuda", compile=compile):
                seconds = median(seconds_of_step(step, CUDA_STEPS, cuda_clock) for _ in range(ROUNDS))
                emit(f"rearrange_torch.cuda.{name}_w{worlds}_{how}.steps_s", worlds / seconds, "steps/s")


def _steps(bank: RearrangeBank, worlds: int, device: str, *, compile: bool) -> list[tuple[str, Callable[[], object]]]:
    """Return a step of the state and one of an environment, each with the choices in a table of random numbers."""
    import torch

    from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv
    from h3data_training.torch.graph import captured, fused, overwrite
    from h3data_training.torch.rearrange.worlds import RearrangeTensors

    sim = RearrangeTensors(bank, device=device, dtype=torch.float32)
    first = torch.arange(worlds, device=device) % len(bank) - 1
    play = sim.before_the_first(first)
    human = torch.full_like(first, -1)
    scores = torch.rand(997, len(sim.robot_choices), device=device, generator=torch.Generator(device).manual_seed(0))
    row = torch.arange(worlds, device=device)

    def chosen(mask: torch.Tensor) -> torch.Tensor:
        return torch.where(mask, scores[row % len(scores)], -1.0).argmax(1)

    def move(choice: torch.Tensor) -> None:
        overwrite(play.tensors(), sim.step(play, choice, human).tensors())

    step = fused(move) if compile else move

    def state() -> None:
        step(chosen(_allowed(sim, play)))
        row.add_(1)

    with torch.no_grad():
        advance = captured(state, [*play.tensors(), row]) if device == "cuda" else state
    env = RearrangeTorchEnv(worlds, device=device, dtype=torch.float32, episodes=bank, compile=compile)
    _, info = env.reset(seed=0)
    known: dict[str, Any] = {"mask": info["action_mask"] > 0}

    def environment() -> None:
        row.add_(1)
        *_, told = env.step(chosen(known["mask"]))
        known["mask"] = told["action_mask"] > 0

    return [("state", _without_gradients(advance)), ("env", _without_gradients(environment))]


def _allowed(sim: Any, play: Any) -> torch.Tensor:
    from h3data_training.torch.rearrange.observations import View

    return View.of(sim, play, "robot").allowed()


def _without_gradients(work: Callable[[], object]) -> Callable[[], None]:
    import torch

    def step() -> None:
        with torch.no_grad():
            work()

    return step


def _apart(bank: RearrangeBank) -> float:
    """Return the farthest distance of places on GPU and CPU after 300 steps of the same planners in float64 [m]."""
    import torch

    from h3data_training.torch.rearrange.worlds import RearrangeTensors

    places = []
    for device in ("cpu", "cuda"):
        sim = RearrangeTensors(bank, device=device, dtype=torch.float64, planners=("robot", "human"), partner="both")
        play = sim.start(sim.before_the_first(torch.arange(len(bank), device=device) - 1))
        nothing = torch.full((len(bank),), -1, device=device)
        with torch.no_grad():
            for _ in range(300):
                play = sim.step(play, nothing, nothing)
        places.append(torch.cat([play.robot.xz, play.human.xz], 1).cpu())
    return (places[0] - places[1]).abs().max().item()


def cuda_clock() -> float:
    """Return the time [s] when the GPU has done what it was given."""
    import torch

    torch.cuda.synchronize()
    return time.perf_counter()


def seconds_of_step(step: Callable[[], object], times: int, clock: Callable[[], float]) -> float:
    """Return the mean time of ``times`` steps [s], after a first one."""
    step()
    start = clock()
    for _ in range(times):
        step()
    return (clock() - start) / times


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
