"""The task ``crowd_nav`` as tensors: worlds times steps a second on one CPU thread and, where there is one, on a GPU, and how
far its people differ from those of the CPU.

``crowd_torch.{cpu,cuda}.p4_*`` steps whole worlds with four people by ``orca`` (people, robot, contact, reward, new episodes),
``env_*`` environments that also show `SHOWN`. On a GPU a step is one CUDA graph.

``crowd_torch.{numpy,device}.MODEL.*`` are people of the same episodes beside a robot that stands still, on the CPU and as
tensors in float64: their mean speed, the share of time in which they stand, and the squares of 1 m that each visits in a
minute. They differ as a device cannot search for paths (`h3data_training.torch.crowd.people`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rearrange_torch import cuda_clock, seconds_of_step

if TYPE_CHECKING:
    from h3data_training.torch.crowd.bank import CrowdBank

Emit = Callable[[str, float, str], None]
HOMES, EPISODES, SHOWN = ["medium:1", "small:2", "h3-homes/train#0", "h3-homes/train#1"], 64, ("goal_gps", "lidar")
CPU_WORLDS, CUDA_WORLDS = (64, 1024), (1024, 8192, 32768)
CPU_STEPS, CUDA_STEPS, ROUNDS = 5, 50, 5
PLACES, STANDS_MPS = "h3-homes/val", 0.1


def run(emit: Emit, *, episodes: int = 48) -> None:
    """Emit ``crowd_torch.*``, the differences of ``episodes`` episodes; the lines of the GPU only where there is one."""
    import torch

    from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
    from h3data_training.torch.crowd.bank import CrowdBank

    start = time.process_time()
    bank = CrowdBank.draw(HOMES, EPISODES, task=CrowdNav(), spec=CrowdNavSpec())
    emit("crowd_torch.bank_cpu_s_per_episode", (time.process_time() - start) / EPISODES, "s")
    emit("crowd_torch.bank_bytes_per_episode", sum(leg.nbytes for leg in bank.legs) * 3 / EPISODES, "B")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for worlds in CPU_WORLDS:
        for name, step in _steps(bank, worlds, "cpu"):
            seconds = median(seconds_of_step(step, CPU_STEPS, time.process_time) for _ in range(ROUNDS))
            emit(f"crowd_torch.cpu.{name}_w{worlds}.steps_s", worlds / seconds, "steps/s")
    for model in ("orca", "social_force"):
        for side, walks in _walks(model, episodes).items():
            for name, (value, unit) in _measured(walks).items():
                emit(f"crowd_torch.{side}.{model}.{name}", value, unit)
    torch.set_num_threads(threads)
    if not torch.cuda.is_available():
        print("# crowd_torch.cuda: no GPU that torch can use")
        return
    emit("crowd_torch.cuda.apart_m", _apart(bank), "m")
    for worlds in CUDA_WORLDS:
        for name, step in _steps(bank, worlds, "cuda"):
            seconds = median(seconds_of_step(step, CUDA_STEPS, cuda_clock) for _ in range(ROUNDS))
            emit(f"crowd_torch.cuda.{name}_w{worlds}_graph.steps_s", worlds / seconds, "steps/s")


def _steps(bank: CrowdBank, worlds: int, device: str) -> list[tuple[str, Callable[[], object]]]:
    """Return a step of worlds and one of an environment, whose robots drive at random."""
    import torch

    import h3data
    from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
    from h3data_training.torch.crowd.worlds import CrowdWorlds
    from h3data_training.torch.graph import captured, overwrite

    sim = CrowdWorlds(bank, model="orca", task=CrowdNav(), spec=CrowdNavSpec(), device=device, dtype=torch.float32)
    play = sim.before_the_first(torch.arange(worlds, device=device) % len(bank) - 1)
    action = torch.rand(worlds, 2, device=device, generator=torch.Generator(device).manual_seed(0)) * 2 - 1

    def state() -> None:
        overwrite(play.tensors(), sim.step(play, action).tensors())

    with torch.no_grad():
        advance = captured(state, list(play.tensors())) if device == "cuda" else state

    def alone() -> None:
        with torch.no_grad():
            advance()

    env = h3data.make(
        "crowd_nav", num_envs=worlds, device=device, dtype=torch.float32, episodes=bank, observations=SHOWN
    )
    env.reset(seed=0)
    return [("p4", alone), ("env_p4", lambda: env.step(action))]


def _walks(model: Any, episodes: int) -> dict[str, NDArray[np.float64]]:
    """Return places of people on the CPU and as tensors, [steps, people of all episodes, 2] [m] each."""
    import torch

    from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
    from h3data_training.torch.crowd.bank import CrowdBank
    from h3data_training.torch.crowd.worlds import CrowdWorlds
    from sim_kinematic.envs.world_stepper import WorldStepper

    task, spec = CrowdNav(), CrowdNavSpec(end_on_collision=False)
    bank = CrowdBank.draw(PLACES, episodes, task=task, spec=spec)
    number, everywhere = np.arange(episodes), np.ones(episodes, np.bool_)
    stepper = WorldStepper(task, PLACES, worlds=episodes, spec=spec, partner=model, observations=("goal_gps",))
    stepper.begin([0] * episodes, number.tolist(), everywhere)
    sim, still = CrowdWorlds(bank, model=model, task=task, spec=spec, device="cpu"), torch.zeros(episodes, 2)
    play = sim.step(sim.before_the_first(torch.as_tensor(number) - 1), still)
    walks: dict[str, list[Any]] = {"numpy": [], "device": []}
    for _ in range(spec.max_steps - 1):
        stepper.step({"robot": still.numpy()})
        play = sim.step(play, still)
        walks["numpy"].append(np.concatenate([person.xz for person in stepper.plays[0].world.state.people]))
        walks["device"].append(play.human.xz.flatten(0, 1).numpy().copy())
    return {side: np.array(places) for side, places in walks.items()}


def _measured(walks: NDArray[np.float64]) -> dict[str, tuple[float, str]]:
    """Return figures of people with places [steps, people, 2] [m], each with its unit."""
    speed = 30 * np.hypot(*np.diff(walks, axis=0).transpose(2, 0, 1))
    minutes = len(walks) / 1800
    squares = [len(np.unique(np.floor(walks[:, k]), axis=0)) / minutes for k in range(walks.shape[1])]
    return {
        "speed_mps": (float(speed.mean()), "m/s"),
        "stands": (float((speed < STANDS_MPS).mean()), "1"),
        "squares_per_min": (float(np.mean(squares)), "1/min"),
    }


def _apart(bank: CrowdBank) -> float:
    """Return the farthest distance of people on GPU and CPU after 150 steps in float64 [m]."""
    import torch

    from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
    from h3data_training.torch.crowd.worlds import CrowdWorlds

    places = []
    for device in ("cpu", "cuda"):
        sim = CrowdWorlds(bank, model="orca", task=CrowdNav(), spec=CrowdNavSpec(), device=device, dtype=torch.float64)
        play = sim.before_the_first(torch.arange(len(bank), device=device) - 1)
        still = torch.zeros(len(bank), 2, device=device, dtype=torch.float64)
        with torch.no_grad():
            for _ in range(150):
                play = sim.step(play, still)
        places.append(play.human.xz.cpu())
    return (places[0] - places[1]).abs().max().item()


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
