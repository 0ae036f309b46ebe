"""The Rerun file of 1,500 steps: a robot, a person and 20 objects that move, without pictures; memory of long ones."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from h3data.recording import Recording

STEPS, OBJECTS, LONG = 1500, 20, 60_000


def _recording(steps: int) -> Recording:
    """Return a simulated episode, repeated up to ``steps`` rows; 20 of its objects circle around their places."""
    from h3data_homes import HomeSpec, build_home
    from sim_kinematic.motion.spec import SocialNavSpec
    from sim_kinematic.tasks.recorder import simulate
    from sim_kinematic.tasks.social_nav import SocialNav

    home = build_home(HomeSpec(preset="small", seed=15))
    spec = SocialNavSpec(max_steps=STEPS, end_on_collision=False)
    recording = simulate(SocialNav(), SocialNav().episode(home, seed=15, spec=spec))
    rows = np.arange(steps) % len(recording)
    columns = {name: column[rows] for name, column in recording.columns.items()}
    columns["time_ns"] = np.arange(steps, dtype=np.int64) * recording.episode.dt_ns
    small = [b for b in recording.bodies if b.layer != "ceiling"][-OBJECTS:]
    angle = np.arange(steps)[:, None] * 0.02 + np.arange(OBJECTS)
    tracks = np.tile(np.stack([b.pose for b in small]), (steps, 1, 1)).astype(np.float32)
    tracks[..., 0] += 0.1 * np.cos(angle)
    tracks[..., 2] += 0.1 * np.sin(angle)
    moving = {b.name: k for k, b in enumerate(small)}
    bodies = tuple(replace(b, moving=moving.get(b.name, -1)) for b in recording.bodies)
    return replace(recording, bodies=bodies, columns={**columns, "object_pose": tracks}, skills=(), events=())


def _write(recording: Recording, path: Path) -> float:
    """Return the CPU seconds of the replay and the file."""
    from h3data.replay import Replay
    from h3data_viewers import write_rrd

    start = time.process_time()
    write_rrd(recording, path, replay=Replay(recording, detail=False), overwrite=True)
    return time.process_time() - start


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _extra_memory() -> None:
    """Print how much the peak of memory grows while a long recording's file is written, after a short one's [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        _write(_recording(STEPS), Path(folder) / "e.rrd")
        long = _recording(LONG)
        before = _peak_mb()
        _write(long, Path(folder) / "e.rrd")
        print(_peak_mb() - before, (Path(folder) / "e.rrd").stat().st_size / 1e6)


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit CPU seconds, best of five, and memory in a separate process."""
    recording = _recording(STEPS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e.rrd"
        emit("view.rrd_1500_cpu_s", min(_write(recording, path) for _ in range(5)), "s")
        emit("view.rrd_mb", path.stat().st_size / 1e6, "MB")
    command = (sys.executable, "-c", "from benchmarks.view import _extra_memory; _extra_memory()")
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    extra, size = (float(part) for part in answer.split())
    emit(f"view.rrd_{LONG}_extra_memory_mb", extra, "MB")
    emit(f"view.rrd_{LONG}_mb", size, "MB")
