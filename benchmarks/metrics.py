"""How fast the metric sweep is, apart from reading files."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from h3data.geometry import ground_pose
from h3data.metrics.kernels import count
from h3data.recording.records import STEP_NS

EPISODES, STEPS = 10_000, 1_500
BLOCK = 500
"""Episodes in memory at once: 750,000 rows, 50 MB."""


def run(emit: Callable[[str, float, str], None]) -> None:
    """Sweep 10,000 synthetic episodes of 1,500 steps on one core: one block of 500, again and again."""
    columns = synthetic_columns(BLOCK, STEPS)
    warm = {k: v[:STEPS] for k, v in columns.items() if k != "offsets"}
    count(**warm, offsets=np.array([0, STEPS]))
    start = time.process_time()
    found = 0
    for _ in range(EPISODES // BLOCK):
        found += int((count(**columns).first_found >= 0).sum())
    seconds = time.process_time() - start
    emit("metrics.kernel_rows_per_cpu_s", EPISODES * STEPS / seconds, "rows/s")
    emit("metrics.kernel_10000x1500_cpu_s", seconds, "s")
    emit("metrics.kernel_found_fraction", found / EPISODES, "1")


def synthetic_columns(episodes: int, steps: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Ragged columns of two agents that wander through a home, mostly 0.5 to 4 m apart."""
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
