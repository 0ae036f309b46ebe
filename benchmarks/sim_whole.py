"""Whole steps in a large furnished home, and whether they stay as fast: the protocol of ``h3data bench sim``.

``sim.whole_step.*`` is one step of a robot and a person with FCL contact and one depth image of the robot's arm camera
(224x171), home of 370 k triangles; ``w16_fps`` on two processes. ``sim.long_run_ratio`` is how fast the same 1,000 steps are
in a world that has done many others in between, by CPU time, over how fast they were when it was new:

    python -m benchmarks.sim_whole 100000  # so many in between; `make bench` takes 2,000
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from h3data_pipelines.benchmark.protocol import BenchmarkWorlds, Cell
from h3data_pipelines.machine.bench import measure, process_pool

Emit = Callable[[str, float, str], None]
RUNS, STEPS, PROCESSES = 3, 210, 2
COMPARED, BETWEEN = 1000, 2000


def run(emit: Emit, between: int = BETWEEN) -> None:
    """Emits ``sim.whole_step.*`` and ``sim.long_run_ratio``."""
    with process_pool(PROCESSES) as pool:
        for worlds in (1, 16):
            cell = Cell(home="large", pictures="arm", worlds=worlds)
            row = measure(cell, pool, runs=RUNS, steps=STEPS if worlds == 1 else STEPS // 5)
            emit(f"sim.whole_step.w{worlds}_fps", row["fps_mean"], "frames/s")
            emit(f"sim.whole_step.w{worlds}_cpu_ms", row["cpu_ms_per_frame"], "ms")
    emit("sim.long_run_ratio", long_run_ratio(between), "x")


def long_run_ratio(between: int) -> float:
    """Speed of 1,000 steps after ``between`` others over the speed of the same ones before them, robot and person."""
    worlds = BenchmarkWorlds(Cell())
    worlds.run(0, steps=100)  # compiles, fills caches
    first = worlds.run(1, steps=COMPARED).cpu_s
    worlds.run(2, steps=between)
    return first / worlds.run(1, steps=COMPARED).cpu_s


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True), *map(int, sys.argv[1:]))
