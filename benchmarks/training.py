"""Social navigation as it is trained: the paper's network (ResNet18, LSTM) and pictures of 224 x 171 on a GPU.

``training.cuda.paper_network_w*.acting_*`` is the environment with the arm's depth picture and the network that acts in it, one
CUDA graph a decision, rollouts kept, nothing learned; ``environment_*`` is the environment alone, ``learning_*`` is both and
what is learned from each rollout. ``_hold3`` holds an action for three steps, as the recipe ``fast`` does. Worlds are in homes
of both generations. Lines that begin with ``#`` say how far it is and which kernels take the time of a decision.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from h3data_training.ppo import Learner
    from h3data_training.settings import Settings
    from h3data_training.torch.episodes import EpisodeBank

Line = tuple[str, float, str]
"""Name, value and unit."""
Emit = Callable[[str, float, str], None]
HOMES = "h3-homes/train#10,h3-homes/train#24,h3-homes-v2/train#10,h3-homes-v2/train#22"


class Case(NamedTuple):
    """Worlds and rollout that some lines are measured with."""

    worlds: int
    hold: int = 1
    """Steps for which an action is held."""
    learned: int = 0
    """Decisions of a rollout that is learned from; 0: nothing is learned."""

    @property
    def name(self) -> str:
        return f"paper_network_w{self.worlds}{f'_hold{self.hold}' * (self.hold > 1)}"


CASES = (Case(2048), Case(512), Case(96), Case(96, learned=128), Case(512, learned=32), Case(2048, hold=3))
"""Measured cases, the most informative first."""
ROLLOUT = 32
"""Number of decisions of a rollout without learning."""
PICTURES_AT_ONCE = 8192
"""Number of pictures in a minibatch; the backward pass stores about 20 GB for them."""
ENOUGH_S = 240.0
"""Time after which no further case is started [s]; a case takes about 35 s, mostly for compilation."""


def run(emit: Emit) -> None:
    """Emit ``training.cuda.*``; nothing where there is no GPU."""
    import torch

    began = time.perf_counter()
    if not torch.cuda.is_available():
        print("# training.cuda: no GPU that torch can use")
        return
    from h3data_training.settings import recipe

    torch.set_float32_matmul_precision("high")  # as in training
    settings = recipe("paper", scenes=HOMES, episodes_per_home=8)
    measure(emit, settings, CASES, device="cuda", passes=64, over=lambda: time.perf_counter() - began > ENOUGH_S)


def measure(
    emit: Emit,
    settings: Settings,
    cases: Sequence[Case],
    *,
    device: str,
    passes: int,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Emit the lines of all cases.

    Args:
        emit: Told each line.
        settings: Of the run; worlds, hold, rollout and minibatches follow from the cases.
        cases: As `CASES`.
        device: Where worlds and network are.
        passes: Decisions that are timed in each line where nothing is learned.
        over: Whether there is no time for a further case.
    """
    from h3data_training.episodes import make_bank

    start = time.perf_counter()
    bank = make_bank(settings, seed=0)
    print(f"# {len(bank.scenes)} homes after {time.perf_counter() - start:.0f} s", flush=True)
    for case in cases:
        name = f"training.{device}.{case.name}"
        if over():
            print(f"# no time for {name}{', learning' * (case.learned > 0)}")
            continue
        for line, value, unit in _lines(case, settings, bank, device, passes):
            emit(f"{name}.{line}", value, unit)


def _lines(case: Case, settings: Settings, bank: EpisodeBank, device: str, passes: int) -> Iterator[Line]:
    parts = 1
    while case.worlds % (2 * parts) == 0 and case.worlds * case.learned > PICTURES_AT_ONCE * parts:
        parts *= 2
    s = replace(settings, worlds=case.worlds, hold=case.hold, rollout=case.learned or ROLLOUT, minibatches=parts)
    learner = _learner(s, bank, device)
    yield from _learning(learner) if case.learned else _acting(learner, passes)


def _acting(learner: Learner, passes: int) -> Iterator[Line]:
    from h3data_training.ppo import schedule

    s, device = learner.settings, learner.worlds.device.type
    plan = schedule(s, 0.5, 100)
    seconds = _seconds(lambda: learner._collect(plan), max(passes // s.rollout, 1), device)
    rate = s.worlds * s.rollout / seconds
    yield "acting_decisions_per_s", rate, "1/s"
    yield "acting_steps_per_s", rate * s.hold, "steps/s"
    action = learner.memory.last.clone()
    rate = s.worlds / _seconds(lambda: learner.worlds.repeat_action(action), passes, device)
    yield "environment_steps_per_s", rate * s.hold, "steps/s"
    if device == "cuda":
        _kernels(lambda: learner._collect(plan), s.rollout)


def _learning(learner: Learner) -> Iterator[Line]:
    from h3data_training.ppo import schedule

    s = learner.settings
    plan = schedule(s, 0.5, 100)
    rate = s.decisions_per_update / _seconds(lambda: learner.update(plan), 2, learner.worlds.device.type)
    yield "learning_decisions_per_s", rate, "1/s"
    yield "learning_steps_per_s", rate * s.hold, "steps/s"


def _learner(settings: Settings, bank: EpisodeBank, device: str) -> Learner:
    import torch

    from h3data_training.ppo import Learner
    from h3data_training.worlds import ActionRepeatEnv

    gc.collect()  # of the case before: what its graphs hold is freed with them
    if device == "cuda":
        torch.cuda.empty_cache()
    start = time.perf_counter()
    learner = Learner(settings, ActionRepeatEnv(settings, bank, device=device), seed=0)
    memory = f", {torch.cuda.memory_reserved() / 1e9:.1f} GB" if device == "cuda" else ""
    print(f"# {settings.worlds} worlds after {time.perf_counter() - start:.0f} s{memory}", flush=True)
    return learner


def _seconds(work: Callable[[], object], times: int, device: str) -> float:
    """Return the time of one call [s], after a first one."""
    work()
    start = _clock(device)
    for _ in range(times):
        work()
    return (_clock(device) - start) / times


def _clock(device: str) -> float:
    import torch

    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def _kernels(work: Callable[[], object], decisions: int, most: int = 16) -> None:
    """Print the kernels that take the time of a decision."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        work()
        _clock("cuda")
    rows = sorted(seen.key_averages(), key=lambda row: -row.self_device_time_total)
    total = sum(row.self_device_time_total for row in rows)
    print(
        f"# kernels: {total / 1e3 / decisions:.3f} ms a decision, {sum(row.count for row in rows) / decisions:.0f} launches"
    )
    for row in rows[:most]:
        print(
            f"#   {row.self_device_time_total / 1e3 / decisions:.3f} ms, {row.count / decisions:.1f} x {row.key[:110]}"
        )


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
