"""People: CPU seconds to skin a recording of 1,500 frames (kinematics included), to load all built-in
bodies; microseconds to reach; milliseconds to skin on a GPU, if there is one."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.humanoid_file import builtin_common
from h3data.bodies.people.reach import reach, reach_poses
from h3data.geometry import ground_pose

FRAMES, REPEATS, SPEED_MPS, QUERIES = 1500, 5, 1.3, 10_000

Emit = Callable[[str, float, str], None]


def run(emit: Emit) -> None:
    """Emit ``bodies.*``; the smallest of some runs, everything warm but the loading."""
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
    _reach(body, emit)
    _skin_on_gpu(body, emit)


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


def _skin_on_gpu(body: Humanoid, emit: Emit) -> None:
    """Emit wall milliseconds for all frames, from joint matrices to vertices on the device; nothing without a GPU."""
    import torch

    if not torch.cuda.is_available():
        return
    from h3data_gpu.skinning import TorchSkin

    joints = torch.from_numpy(_joints(body)).to("cuda", torch.float32)
    for lod, name in ((False, "full"), (True, "lod")):
        skin = TorchSkin(body, lod=lod, device="cuda")
        for _ in range(5):
            skin(joints)
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(50):
            skin(joints)
        torch.cuda.synchronize()
        emit(f"bodies.skin_1500_{name}_gpu_ms", (time.perf_counter() - start) / 50 * 1e3, "ms")


def _reach(body: Humanoid, emit: Emit) -> None:
    """Measure one query with its answer, one of a batch, and one that is refused with advice."""
    targets = np.random.default_rng(0).uniform([0.2, 0.3, -0.1], [0.5, 1.2, 0.4], (QUERIES, 3))
    good = targets[reach_poses(body, targets).status == 0]
    reach(body, [2.0, 1.0, 0.0])  # everything compiled and made
    few = good[:500]
    emit(
        "bodies.reach_us", min(_timed(lambda: [reach(body, t) for t in few]) for _ in range(REPEATS)) / 500 * 1e6, "us"
    )
    batch = min(_timed(lambda: reach_poses(body, targets)) for _ in range(REPEATS))
    emit("bodies.reach_batch_us", batch / QUERIES * 1e6, "us")
    far = targets[:50] + np.array([2.0, 0, 0])
    emit(
        "bodies.reach_refused_us",
        min(_timed(lambda: [reach(body, t) for t in far]) for _ in range(REPEATS)) / 50 * 1e6,
        "us",
    )


def _load_all() -> list[Humanoid]:
    load_humanoid.cache_clear()
    builtin_common.cache_clear()
    return [load_humanoid(name) for name in humanoid_names()]


if __name__ == "__main__":
    run(lambda name, value, unit: print(name, f"{value:.4g}", unit))
