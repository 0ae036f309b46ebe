"""Waiting times of a user: importing the package, showing help, the demo, a report on 1,000 episodes, and validating them."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

VALIDATED, VALIDATED_STEPS = 1_000, 300
REPORT_RUNS, REPORT_EPISODES = ("rollout_expert", "random"), 500


def _wall_s(*command: str) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def _cpu_s(*command: str) -> float:
    """CPU seconds of a command and the processes that it starts."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _wall_s(*command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _make_run(folder: Path, policy: str, count: int = REPORT_EPISODES, steps: int | None = None) -> Path:
    """A dataset of ``count`` episodes: ten simulated ones over and over, under different names."""
    from h3data.recording import DatasetWriter
    from h3data_homes import HomeSpec, build_home
    from sim_kinematic.motion.spec import SocialNavSpec
    from sim_kinematic.tasks.runner import simulate
    from sim_kinematic.tasks.social_nav import SocialNav

    homes = [build_home(HomeSpec(preset="small", seed=seed)) for seed in range(2)]
    spec = SocialNavSpec() if steps is None else SocialNavSpec(max_steps=steps)
    worlds = [SocialNav().episode(homes[k % 2], seed=k, spec=spec) for k in range(10)]
    recordings = [simulate(SocialNav(), world, {"robot": policy}) for world in worlds]
    with DatasetWriter(folder) as writer:
        for k in range(count):
            recording = recordings[k % len(recordings)]
            episode = replace(recording.episode, uid=f"{policy}-{k}", episode_id=f"{k:06d}")
            writer.add(replace(recording, episode=episode))
    return folder


def _demo(emit: Callable[[str, float, str], None], cli: tuple[str, ...], folder: Path) -> None:
    """The demo with what numba and h3data keep, and with empty caches; kernels of the package h3data-kernels count as there."""
    _wall_s(*cli, "demo", "--steps", "5", "-o", str(folder / "first"))
    start = time.perf_counter()
    warm = _cpu_s(*cli, "demo", "-o", str(folder / "demo"))
    emit("demo.wall_s", time.perf_counter() - start, "s")
    emit("demo.warm_cpu_s", warm, "s")
    parts = json.loads((folder / "demo" / "summary.json").read_text())["parts_s"]
    emit("demo.first_metrics_s", parts["simulate"] + parts["metrics"], "s")
    emit("demo.first_picture_s", parts["simulate"] + parts["metrics"] + parts["first picture"], "s")
    os.environ |= {"NUMBA_CACHE_DIR": str(folder / "kernels"), "H3DATA_CACHE": str(folder / "cache")}
    emit("demo.cold_cpu_s", _cpu_s(*cli, "demo", "-o", str(folder / "cold")), "s")
    for name in ("NUMBA_CACHE_DIR", "H3DATA_CACHE"):
        del os.environ[name]


def run(emit: Callable[[str, float, str], None]) -> None:
    """Wall seconds, best of three; the demo once with warm and once with empty caches."""
    bare = min(_wall_s(sys.executable, "-c", "pass") for _ in range(3))
    emit("import.h3data_s", min(_wall_s(sys.executable, "-c", "import h3data") for _ in range(3)) - bare, "s")
    cli = (sys.executable, "-m", "h3data_pipelines.cli")
    emit("cli.help_s", min(_wall_s(*cli, "--help") for _ in range(3)), "s")
    with tempfile.TemporaryDirectory() as folder:
        _demo(emit, cli, Path(folder))
        checked = _make_run(Path(folder) / "checked", "rollout_expert", VALIDATED, VALIDATED_STEPS)
        emit(f"validate.{VALIDATED}x{VALIDATED_STEPS}_cpu_s", _cpu_s(*cli, "validate", str(checked)), "s")
        runs = [str(_make_run(Path(folder) / policy, policy)) for policy in REPORT_RUNS]
        out = Path(folder) / "report.html"
        emit(
            "report.1000_wall_s", min(_wall_s(*cli, "report", *runs, "-o", str(out), "--force") for _ in range(2)), "s"
        )
        emit("report.1000_mb", out.stat().st_size / 1e6, "MB")
