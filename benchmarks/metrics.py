"""Speed of metrics: the rows of encounters alone, and 10,000 episodes from a Parquet dataset to the table."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from h3data.geometry import ground_pose
from h3data.metrics.paper.encounter import encounter_series
from h3data.metrics.paper.encounter_kernel import fill_series  # with numba, as in any process that simulates or draws
from h3data.recording import STEP_NS, Agent, DatasetWriter, Episode, Recording

EPISODES, STEPS = 10_000, 1_500
BLOCK = 500
"""Episodes in memory at once: 750,000 rows, 50 MB."""
JOINED = 25
"""Episodes of one call of the kernel; `h3data metrics` gives it 33 of this length at a time."""


def run(emit: Callable[[str, float, str], None]) -> None:
    """Measure the series alone on one core, one episode a call and 25 a call, then a dataset from disk to the table."""
    columns = synthetic_columns(BLOCK, STEPS)
    offsets = columns.pop("offsets")
    del columns["collision"]
    a, b = offsets[:2]
    arguments: dict[str, Any] = {name: column[a:b] for name, column in columns.items()}
    encounter_series(**arguments)
    assert fill_series.signatures, "the kernel is not used"
    start = time.process_time()
    found = 0
    for _ in range(EPISODES // BLOCK):
        for a, b in itertools.pairwise(offsets):
            arguments = {name: column[a:b] for name, column in columns.items()}
            series = encounter_series(**arguments)
            found += bool(series["found"].any())
    seconds = time.process_time() - start
    emit("metrics.kernel_rows_per_cpu_s", EPISODES * STEPS / seconds, "rows/s")
    emit("metrics.kernel_10000x1500_cpu_s", seconds, "s")
    emit("metrics.kernel_found_fraction", found / EPISODES, "1")
    start = time.process_time()
    for first in range(0, EPISODES, JOINED):
        a, *starts, b = offsets[first % BLOCK : first % BLOCK + JOINED + 1]
        arguments = {name: column[a:b] for name, column in columns.items()}
        encounter_series(**arguments, starts=np.array([a, *starts]) - a)
    emit("metrics.kernel_joined_rows_per_cpu_s", EPISODES * STEPS / (time.process_time() - start), "rows/s")
    root = stored_dataset(emit)
    for profile in ("paper", "field", "habitat"):
        _from_disk(emit, root, profile, f"{EPISODES}x{STEPS}")


def stored_dataset(emit: Callable[[str, float, str], None]) -> Path:
    """Return a dataset of 10,000 social navigation episodes in the folder for temporary files, kept for the next time."""
    root = Path(tempfile.gettempdir()) / f"h3data-bench-metrics-{EPISODES}x{STEPS}-v1"
    if not (root / "complete").exists():
        shutil.rmtree(root, ignore_errors=True)
        start = time.perf_counter()
        with DatasetWriter(root / "dataset") as out:
            for number in range(EPISODES // BLOCK):
                for recording in synthetic_recordings(number):
                    out.add(recording)
        emit("metrics.dataset_write_wall_s", time.perf_counter() - start, "s")
        (root / "complete").touch()
    return root / "dataset"


def synthetic_recordings(number: int) -> Iterator[Recording]:
    """Yield blocks of episodes with the columns that `h3data generate` records, if metrics may read them."""
    columns = synthetic_columns(BLOCK, STEPS, seed=number)
    agents = (Agent(name="robot", kind="robot"), Agent(name="human", kind="human"))
    for e in range(BLOCK):
        rows = slice(e * STEPS, (e + 1) * STEPS)
        name = f"{number * BLOCK + e:06d}"
        robot, human = columns["robot_pose"][rows], columns["human_pose"][rows]
        info = {"max_steps": STEPS, "oracle_min_steps": 60 + e}
        yield Recording(
            episode=Episode(uid=f"bench-{name}", episode_id=name, task="social_nav", scene="none", info=info),
            agents=agents,
            columns={
                "time_ns": columns["time_ns"][rows],
                "agent_0.base_pose": robot,
                "agent_1.base_pose": human,
                "metrics.dist_agents": np.linalg.norm(robot[:, :3] - human[:, :3], axis=1),
                "metrics.geodesic_agents": columns["reach_m"][rows],
                "metrics.collision": columns["collision"][rows],
            },
        )


def _from_disk(emit: Callable[[str, float, str], None], root: Path, profile: str, name: str) -> None:
    """Open, read, measure and tabulate in a fresh process, so that its memory is its own; start-up is not counted."""
    script = f"""
import time
import h3data.metrics, h3data.metrics.batch as batch, h3data.metrics.reading as reading
h3data.metrics.measure(next(reading.recordings([{str(root)!r}], {profile!r})), {profile!r})
wall, cpu = time.perf_counter(), time.process_time()
table = batch.measure_files([{str(root)!r}], {profile!r})
wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
again = time.perf_counter()
table.summary()
again = time.perf_counter() - again
# not ru_maxrss, which begins with the memory of the process that started this one
peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(len(table), wall, cpu, again, peak * 1024)
"""
    said = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    episodes, wall, cpu, intervals, memory = (float(word) for word in said.split())
    if episodes != EPISODES:
        raise RuntimeError(f"expected {EPISODES} episodes, the table has {episodes:.0f}: {root}")
    emit(f"metrics.{profile}.{name}_wall_s", wall, "s")
    emit(f"metrics.{profile}.{name}_cpu_s", cpu, "s")
    emit(f"metrics.{profile}.{name}_intervals_s", intervals, "s")
    emit(f"metrics.{profile}.{name}_peak_bytes", memory, "B")


def synthetic_columns(episodes: int, steps: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the ragged columns of two agents that wander through a home, mostly 0.5 to 4 m apart."""
    random = np.random.default_rng(seed)
    rows = episodes * steps

    def wander(spread: float) -> np.ndarray:
        position = np.cumsum(random.normal(0, spread, (episodes, steps, 2)), axis=1)
        return position.reshape(rows, 2)

    human = wander(0.02)
    angle = np.cumsum(random.normal(0, 0.03, rows))
    distance = 2.2 + 1.6 * np.sin(np.arange(rows) / 90 + random.random())
    robot = human + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    towards = np.arctan2(robot[:, 1] - human[:, 1], human[:, 0] - robot[:, 0]) + random.normal(0, 0.5, rows)
    return {
        "robot_pose": ground_pose(robot, towards).astype(np.float32),
        "human_pose": ground_pose(human, angle).astype(np.float32),
        "reach_m": (distance * random.uniform(1, 1.2, rows)).astype(np.float32),
        "time_ns": np.tile(np.arange(steps) * STEP_NS, episodes),
        "collision": random.random(rows) < 1e-4,
        "offsets": np.arange(episodes + 1) * steps,
    }
