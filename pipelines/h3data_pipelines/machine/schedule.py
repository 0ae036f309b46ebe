"""Simulation of a job on many cores, shard by shard from measured costs, which gives its duration and bottleneck."""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass

AHEAD = 4
"""Number of results per worker that may wait for the writing process, as in
`h3data_pipelines.execution.ray_cluster`."""
MOST_SHARDS = 200_000
"""Largest number of shards that are simulated; the rest of a longer job continues at the rate of their second half."""


@dataclass(frozen=True, kw_only=True)
class Workload:
    """Shards of equal cost, except for the first use of each home."""

    shards: int
    shard_s: float
    scenes: int
    """Number of different homes, which the shards use in turn."""
    scene_s: float
    """Time to prepare a home that is new to a worker [s]."""
    start_s: float
    """Time that a worker needs to start [s]."""
    driver_s: float
    """Time for a shard in the single process that writes its dataset [s]."""


@dataclass(frozen=True)
class Schedule:
    """Simulated schedule of a job."""

    seconds: float
    cpu_s: float
    """Time for which workers were busy, summed over workers [s]."""
    speedup: float
    """Speed-up over one worker."""
    held_up_by: str
    """Cause of most of the lost time: ``work``, ``writer``, ``scenes`` or ``start``."""


def simulate_schedule(load: Workload, workers: int, *, datasets: int = 1) -> Schedule:
    """Simulate the shards on ``workers`` cores, with the work divided into ``datasets`` jobs that have one writer each.

    Workers take shards in order. The writer of a job takes results in order, one at a time. If `AHEAD` results per
    worker wait for it, workers wait too.
    """
    per_job, cores = -(-load.shards // datasets), max(workers // datasets, 1)
    played = min(per_job, MOST_SHARDS)
    free = [(load.start_s, number) for number in range(min(cores, played))]
    heapq.heapify(free)
    seen: list[set[int]] = [set() for _ in free]
    waiting: deque[float] = deque()
    written = busy = scenes = half = 0.0
    for index in range(played):
        at, worker = heapq.heappop(free)
        if len(waiting) >= AHEAD * cores:  # the writer is behind
            at = max(at, waiting.popleft())
        home = index % load.scenes
        new = home not in seen[worker]
        seen[worker].add(home)
        cost = load.shard_s + (load.scene_s if new else 0.0)
        busy, scenes = busy + cost, scenes + (load.scene_s if new else 0.0)
        heapq.heappush(free, (at + cost, worker))
        written = max(written, at + cost) + load.driver_s
        waiting.append(written)
        if index == played // 2:
            half = written
    rest = per_job - played
    if rest:
        pace = (written - half) / (played - played // 2)
        written, busy = written + rest * pace, busy + rest * load.shard_s
    one = load.start_s + min(load.scenes, load.shards) * load.scene_s + load.shards * max(load.shard_s, load.driver_s)
    lost = {
        "work": per_job * load.shard_s / cores,
        "writer": per_job * load.driver_s if per_job * load.driver_s > 0.9 * written else 0.0,
        "scenes": scenes / cores,
        "start": load.start_s,
    }
    return Schedule(
        written, (busy + cores * load.start_s) * datasets, one / written, max(lost, key=lambda name: lost[name])
    )
