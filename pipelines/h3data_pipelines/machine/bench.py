"""Command ``h3data bench``, which runs the paper's speed benchmark on this machine and shows the paper's numbers."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import InputError
from h3data.progress import progress

if TYPE_CHECKING:
    from h3data_pipelines.machine.bench_protocol import Cell, Run

ALL = "all"
HOMES = ("small", "medium", "large")
OBJECTS = ("2", "10")
AGENTS = ("robot", "human", "robot_robot", "human_robot")
WORLDS = ("1", "16")
ACTIONS = ("nav", "pick")
BODIES = ("skinned", "bones")
STARTED_WITHIN_S = 600.0
"""Time within which all processes must have built their worlds [s]."""
PAPER = {
    ("small", "robot", 1): "245±19",
    ("large", "robot", 1): "154±14",
    ("small", "human", 1): "188±2",
    ("small", "robot_robot", 1): "150±13",
    ("small", "human_robot", 1): "136±8",
    ("small", "human_robot", 16): "1191±3",
}
"""Frames per second in the paper by home, agents and worlds, for 2 objects, navigation and skinned people on one V100
(section 3, appendix on speed).
"""
NOTES = (
    "FPS: steps of all worlds per second, mean ± standard error over the runs. CPU: user and system time per step and world.",
    "Paper: one Nvidia V100; its appendix gives 155±26 for the human. One depth image per agent: 128x128, 256x256 for two.",
)


@dataclass(frozen=True)
class Bench:
    """Measure steps per second by the paper's protocol, on CPU or GPU.

    A run has 300 steps of random actions with a depth image for each agent, of which the first 10 are not timed. The
    value "all" of an option means every value.

    Examples:
        h3data bench sim
        h3data bench sim --homes small --agents human_robot --worlds 1,16 --runs 10
        h3data bench sim --homes all --objects all --actions all --bodies all --runs 10 --json
        h3data bench sim --agents human_robot --worlds 16,1024 --backend gpu
    """

    group: tyro.conf.Positional[str]
    """Benchmark to run: sim (the simulator with depth images)."""
    homes: tuple[str, ...] = ("small",)
    """Sizes of homes: small, medium, large."""
    objects: tuple[str, ...] = ("2",)
    """Number of objects; the paper has 2 and 10."""
    agents: tuple[str, ...] = (ALL,)
    """Agents of the worlds: robot, human, robot_robot, human_robot."""
    worlds: tuple[str, ...] = ("1", "16")
    """Number of worlds stepped at once; the paper has 1 and 16."""
    actions: tuple[str, ...] = ("nav",)
    """Actions of the agents: nav (they drive or walk), or pick (they stand, and an arm or a hand reaches)."""
    bodies: tuple[str, ...] = ("skinned",)
    """Bodies of people: skinned, or bones (rendered as rigid capsules)."""
    runs: int = 3
    """Number of runs per row; the paper has 10."""
    steps: int = 300
    """Number of steps per run; the first 10 are not timed."""
    backend: Literal["cpu", "gpu"] = "cpu"
    """Renderer backend; gpu runs all worlds in one process."""
    cores: int | None = None
    """Number of processes that share the worlds (default: all cores of this machine; 1 with gpu)."""
    seed: int = 0
    """Seed of all random numbers."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Run the benchmark and return steps per second for each setting, with the paper's numbers."""
        cells = self.cells()
        cores = self.processes()
        if self.backend == "gpu":
            _check_gpu()
        rows = []
        with process_pool(cores) as pool, progress(total=len(cells), desc="bench", unit="cell") as bar:
            for cell in cells:
                bar.set_postfix_str(f"{cell.home} {cell.agents} x{cell.worlds}")
                rows.append(measure(cell, pool, runs=self.runs, steps=self.steps, backend=self.backend, seed=self.seed))
                bar.update()
        hardware = hardware_name(self.backend)
        text = "\n".join([f"{hardware}, {self.runs} runs of {self.steps} steps", "", *_table(rows), "", *NOTES])
        data = {"hardware": hardware, "backend": self.backend, "runs": self.runs, "steps": self.steps, "cells": rows}
        return Outcome(text=text, data=data)

    def cells(self) -> list[Cell]:
        """Return the rows to measure, or raise an `InputError` that names an invalid option."""
        from h3data_pipelines.machine.bench_protocol import UNTIMED, Cell

        if self.group != "sim":
            raise InputError(
                f"Unknown benchmark {self.group!r}. Expected: sim. Hint: the others run in a checkout: make bench.",
                code="H3-MACHINE-004",
            )
        if self.runs < 1:
            raise InputError(f"--runs must be at least 1, got {self.runs}.", code="H3-MACHINE-005")
        if self.steps <= UNTIMED:
            raise InputError(
                f"--steps must be more than {UNTIMED}, the steps that are not timed; got {self.steps}.",
                code="H3-MACHINE-006",
            )
        chosen: Any = product(  # texts that `_names` has checked
            _names("--homes", self.homes, HOMES),
            _numbers("--objects", self.objects, OBJECTS),
            _names("--agents", self.agents, AGENTS),
            _numbers("--worlds", self.worlds, WORLDS),
            _names("--actions", self.actions, ACTIONS),
            _names("--bodies", self.bodies, BODIES),
        )
        cells: list[Any] = [
            Cell(home=home, objects=objects, agents=agents, worlds=worlds, action=action, skinned=body == "skinned")
            for home, objects, agents, worlds, action, body in chosen
            if body == "skinned" or "human" in agents  # robots have no skin
        ]
        if not cells:
            raise InputError(
                "Nothing is left to measure: robots have no skin. Hint: --bodies skinned.", code="H3-MACHINE-007"
            )
        return cells

    def processes(self) -> int:
        """Return the largest number of processes that share the worlds."""
        if self.cores is not None and self.cores < 1:
            raise InputError(f"--cores must be at least 1, got {self.cores}.", code="H3-MACHINE-008")
        if self.backend == "gpu":
            if self.cores not in (None, 1):
                raise InputError(
                    "With --backend gpu one process renders all worlds. Hint: leave out --cores.", code="H3-MACHINE-009"
                )
            return 1
        return self.cores or len(os.sched_getaffinity(0))


# --- measuring ------------------------------------------------------------------------------------------------------------
class Pool:
    """Pool of processes that start each timed run together; a pool of one runs in this process."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._executors: dict[int, ProcessPoolExecutor] = {}

    def run(self, shares: list[int], cell: Cell, **options: Any) -> list[list[Run]]:
        """Run the benchmark in each process and return the results; ``shares`` are the numbers of worlds of each."""
        if len(shares) == 1:
            return [_run_share(cell, shares[0], **options)]
        executor = self._executor(len(shares))
        waiting = [executor.submit(_run_share, cell, share, **options) for share in shares]
        return [one.result() for one in waiting]

    def _executor(self, count: int) -> ProcessPoolExecutor:
        if count not in self._executors:
            context = get_context("spawn")
            self._executors[count] = ProcessPoolExecutor(
                count, mp_context=context, initializer=_meet_at, initargs=(context.Barrier(count),)
            )
        return self._executors[count]

    def close(self) -> None:
        """Stop all processes."""
        for executor in self._executors.values():
            executor.shutdown(cancel_futures=True)


@contextmanager
def process_pool(size: int) -> Iterator[Pool]:
    """Start a `Pool`, whose processes are stopped at the end of the block."""
    pool = Pool(size)
    try:
        yield pool
    finally:
        pool.close()


_barrier: Any = None


def _meet_at(barrier: Any) -> None:
    global _barrier
    _barrier = barrier


def _run_share(
    cell: Cell, worlds: int, *, runs: int, steps: int, backend: Literal["cpu", "gpu"], seed: int
) -> list[Run]:
    """Return results of one process; several processes begin each run together."""
    from h3data_pipelines.machine.bench_protocol import UNTIMED, BenchmarkWorlds

    try:
        benchmark = BenchmarkWorlds(cell, worlds=worlds, backend=backend)
        benchmark.run(seed, steps=2 * UNTIMED)  # compiles, fills caches
        results = []
        for k in range(runs):
            if _barrier is not None:
                _barrier.wait(STARTED_WITHIN_S)
            results.append(benchmark.run(seed + k, steps=steps))
        return results
    except BaseException:
        if _barrier is not None:
            _barrier.abort()  # else the others would wait for the time limit
        raise


def measure(
    cell: Cell, pool: Pool, *, runs: int, steps: int, backend: Literal["cpu", "gpu"] = "cpu", seed: int = 0
) -> dict[str, Any]:
    """Measure one row of the table and return its values.

    The values are the cell, ``fps`` of each run, their mean and standard error, CPU time per frame [ms], and the
    paper's figure.

    The frames per second of a run are worlds x timed steps / mean time of the processes, as in Habitat's script.
    """
    from h3data_pipelines.machine.bench_protocol import UNTIMED

    count = min(pool.size, cell.worlds)
    shares = [cell.worlds // count + (k < cell.worlds % count) for k in range(count)]
    results = pool.run(shares, cell, runs=runs, steps=steps, backend=backend, seed=seed)
    wall = np.array([[run.wall_s for run in process] for process in results]).mean(0)
    cpu = np.array([[run.cpu_s for run in process] for process in results]).sum(0)
    frames = (steps - UNTIMED) * cell.worlds
    fps = frames / wall
    usual = cell.objects == 2 and cell.action == "nav" and cell.skinned and cell.pictures == "each"
    return {
        **asdict(cell),
        "image": list(cell.image_size),
        "processes": count,
        "fps": fps.tolist(),
        "fps_mean": float(fps.mean()),
        "fps_standard_error": float(fps.std(ddof=1) / np.sqrt(runs)) if runs > 1 else float("nan"),
        "cpu_ms_per_frame": float(1e3 * np.median(cpu) / frames),
        "paper": PAPER.get((cell.home, cell.agents, cell.worlds)) if usual else None,
    }


# --- text -----------------------------------------------------------------------------------------------------------------
def hardware_name(backend: str = "cpu") -> str:
    """Return the name of this machine's processor, its number of cores, and its GPU if that renders."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cpu = f"{names[0] if names else platform.processor() or platform.machine()}, {len(os.sched_getaffinity(0))} cores"
    if backend == "cpu":
        return cpu
    import torch

    return f"{torch.cuda.get_device_name()}; {cpu}"


def _check_gpu() -> None:
    """Refuse a missing GPU at once, not after the home is built."""
    import torch

    from h3data.errors import MissingExtraError

    if not torch.cuda.is_available():
        raise MissingExtraError(
            "--backend gpu needs a CUDA device, and PyTorch finds none. Hint: --backend cpu.", code="H3-MACHINE-001"
        )


def _table(rows: Iterable[dict[str, Any]]) -> list[str]:
    head = ["home", "objects", "agents", "worlds", "action", "body", "images", "FPS", "CPU ms", "paper FPS"]
    lines = [head]
    for row in rows:
        error = row["fps_standard_error"]
        lines.append(
            [
                row["home"],
                str(row["objects"]),
                row["agents"],
                f"{row['worlds']} on {row['processes']}",
                row["action"],
                ("skinned" if row["skinned"] else "bones") if "human" in row["agents"] else "-",
                f"{len(row['agents'].split('_'))} {row['image'][0]}x{row['image'][1]}",
                f"{row['fps_mean']:.0f}" + (f"±{error:.0f}" if error == error else ""),
                f"{row['cpu_ms_per_frame']:.2f}",
                row["paper"] or "-",
            ]
        )
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    return ["  ".join(f"{word:<{width}}" for word, width in zip(line, widths, strict=True)).rstrip() for line in lines]


def _names(option: str, given: tuple[str, ...], choices: tuple[str, ...]) -> tuple[str, ...]:
    names = choices if given == (ALL,) else tuple(dict.fromkeys(given))
    unknown = [name for name in names if name not in choices]
    if unknown:
        raise InputError(
            f"{option}: unknown {', '.join(map(repr, unknown))}. Expected some of: {', '.join(choices)}; or all.",
            code="H3-MACHINE-002",
        )
    return names


def _numbers(option: str, given: tuple[str, ...], usual: tuple[str, ...]) -> tuple[int, ...]:
    words = usual if given == (ALL,) else tuple(dict.fromkeys(given))
    if not all(word.isascii() and word.isdecimal() and int(word) >= 1 for word in words):
        raise InputError(
            f"{option}: expected positive whole numbers, or all; got {', '.join(given)!r}.", code="H3-MACHINE-020"
        )
    return tuple(map(int, words))
