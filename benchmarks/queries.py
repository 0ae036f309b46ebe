"""Reading datasets other than episode by episode: training windows, SQL, tensors; on 20 episodes as our simulator's.

Windows (robot, person, 20 objects, action; 4 + 8 steps) come in random order: kept in memory, from memory-mapped Arrow
files, and from Parquet with nothing kept between two of them. Figures are CPU time, the median of some rounds without the
garbage collector: a collection of the modules that are loaded takes longer than some rounds.
"""

from __future__ import annotations

import gc
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import numpy as np

from benchmarks.recording import STEPS, synthetic_episode
from benchmarks.sim import cpu_s
from h3data.recording import Dataset, DatasetWriter
from h3data_pipelines.commands.sql import connect, select
from h3data_training.samples import WindowDataset

EPISODES, ROUNDS = 20, 5
COLUMNS = ["agent_0.base_pose", "agent_1.base_pose", "object_pose", "agent_0.action"]
QUERY = "select episode_index, avg(dist_agents), bool_or(collision) from steps group by 1"


def run(emit: Callable[[str, float, str], None]) -> None:
    """Measure each and say what they found."""
    kept = os.environ.get("H3DATA_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["H3DATA_CACHE"] = f"{folder}/cache"
        try:
            _measure(emit, f"{folder}/ds")
        finally:
            if kept is None:
                del os.environ["H3DATA_CACHE"]
            else:
                os.environ["H3DATA_CACHE"] = kept


def _measure(emit: Callable[[str, float, str], None], root: str) -> None:
    episodes = [synthetic_episode(k, human="coded") for k in range(4)]
    with DatasetWriter(root) as writer:
        for k in range(EPISODES):
            episode = episodes[k % len(episodes)]
            writer.add(replace(episode, episode=replace(episode.episode, uid=f"bench-{k}")))
    dataset = Dataset(root)
    for name, count, options in (
        ("memory", 5000, {}),
        ("mapped", 5000, {"disk_cache": True, "cache_bytes": 0}),
        ("parquet", 200, {"cache_bytes": 0}),
    ):
        windows = WindowDataset(dataset, COLUMNS, history=4, horizon=8, **options)
        for index in range(0, len(windows), STEPS // 2):
            windows[index]  # imports; fills what is kept
        order = np.random.default_rng(0).permutation(len(windows))[:count].tolist()
        seconds = _cpu_s(lambda windows=windows, order=order: [windows[index] for index in order])
        emit(f"queries.windows_{name}_per_cpu_s", count / seconds, "windows/s")
    steps = EPISODES * STEPS
    emit("queries.to_torch_steps_per_cpu_s", steps / _cpu_s(lambda: dataset.to_torch(COLUMNS)), "steps/s")
    connection = connect({"ds": dataset}, profile=None)
    select(connection, QUERY).fetchall()
    emit("queries.sql_group_by_cpu_ms", 1e3 * _cpu_s(lambda: select(connection, QUERY).fetchall(), 40), "ms")


def _cpu_s(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    gc.collect()
    gc.disable()
    try:
        return median(cpu_s(work) for _ in range(rounds))
    finally:
        gc.enable()
