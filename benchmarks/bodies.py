"""People: CPU seconds to skin a recording of 1,500 frames (kinematics included), and to load all built-in bodies."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.bodies.humanoid_file import builtin_common
from h3data.geometry import ground_pose

FRAMES, REPEATS, SPEED_MPS = 1500, 5, 1.3

Emit = Callable[[str, float, str], None]


def run(emit: Emit) -> None:
    """Emits ``bodies.*``; the smallest of some runs, everything warm but the loading."""
    body = load_humanoid("female_0")
    for lod, name in ((False, "full"), (True, "lod")):
        emit(f"bodies.skin_1500_{name}_cpu_s", min(_skin(body, lod=lod) for _ in range(REPEATS)), "s")
    emit("bodies.pose_1500_cpu_s", min(_timed(lambda: _joints(body)) for _ in range(REPEATS)), "s")
    emit("bodies.load_all_s", min(_timed(_load_all) for _ in range(REPEATS)), "s")
    tracemalloc.start()
    people = _load_all()
    emit("bodies.load_all_mb", tracemalloc.get_traced_memory()[0] / 1e6, "MB")
    tracemalloc.stop()
    emit("bodies.clips_s", _timed(lambda: people[0].clips), "s")


def _timed(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _joints(body: Humanoid) -> np.ndarray:
    distance = np.arange(FRAMES) * SPEED_MPS / 30
    motion = body.clip_for_speed(SPEED_MPS)
    quats, pelvis = body.clip_pose(np.full(FRAMES, motion), distance / body.clips[motion].stride_m)
    base = ground_pose(np.stack([distance, 0 * distance], 1), np.zeros(FRAMES))
    return body.joint_matrices(base, quats, pelvis)


def _skin(body: Humanoid, *, lod: bool) -> float:
    joints = _joints(body)
    next(body.skin_chunks(joints, lod=lod))  # builds the operator

    def work() -> None:
        for _ in body.skin_chunks(joints, lod=lod):
            pass

    return _timed(work)


def _load_all() -> list[Humanoid]:
    load_humanoid.cache_clear()
    builtin_common.cache_clear()
    return [load_humanoid(name) for name in humanoid_names()]


if __name__ == "__main__":
    run(lambda name, value, unit: print(name, f"{value:.4g}", unit))
