"""Waiting times of a user: importing the package, showing help, the demo, a report on 1,000 episodes, and validating them."""

from __future__ import annotations

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


def cpu_s(*command: str) -> float:
    """Return CPU seconds of a command and the processes that it starts."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _wall_s(*command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _make_run(folder: Path, policy: str, count: int = REPORT_EPISODES, steps: int | None = None) -> Path:
    """Return a dataset of ``count`` episodes: ten simulated ones repeated under different names."""
    from h3data.recording import DatasetWriter
    from h3data_homes import HomeSpec, build_home
    from sim_kinematic.motion.spec import SocialNavSpec
    from sim_kinematic.tasks.recorder import simulate
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
    """Measure the demo with warm caches of numba and h3data, and in an empty home folder.

    Run by the Python of an environment with the wheels of ``make wheel``, it is their demo that is timed.
    """
    _wall_s(*cli, "demo", "--steps", "5", "-o", str(folder / "first"))
    warm = _timed_demo(cli, folder / "demo", {})
    for name, seconds in warm.items():
        emit(f"demo.{name}", seconds, "s")
    empty = {"HOME": "home", "XDG_CACHE_HOME": "home/cache", "NUMBA_CACHE_DIR": "numba", "H3DATA_CACHE": "cache"}
    cold = _timed_demo(cli, folder / "cold", {name: str(folder / "empty" / place) for name, place in empty.items()})
    for name, seconds in cold.items():
        emit(f"demo.cold_{name}", seconds, "s")
    emit("demo.cold_to_warm_cpu", cold["cpu_s"] / warm["cpu_s"], "1")
    emit("demo.load", os.getloadavg()[0] / (os.cpu_count() or 1), "1")


def _timed_demo(cli: tuple[str, ...], out: Path, settings: dict[str, str]) -> dict[str, float]:
    """Return the seconds until the demo prints its metrics, shows its first picture, and ends, and its CPU seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [*cli, "demo", "-o", str(out)]
    places = [Path(place) for place in settings.values()]
    for place in places:
        place.mkdir(parents=True, exist_ok=True)
    times: dict[str, float] = {}
    with subprocess.Popen(
        command, cwd=out.parent, env=os.environ | settings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as demo:
        assert demo.stdout is not None
        for line in demo.stdout:
            said = (
                "first_metrics_s"
                if "steps recorded in" in line
                else "first_picture_s"
                if "first picture:" in line
                else ""
            )
            if said:
                times.setdefault(said, time.perf_counter() - start)
    if demo.returncode or len(times) < 2:
        raise RuntimeError(
            f"expected metrics and a picture from {' '.join(command)}, which ended with {demo.returncode}"
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**times, "wall_s": time.perf_counter() - start, "cpu_s": cpu_s}


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit wall seconds, best of three; the demo once with warm and once with empty caches."""
    bare = min(_wall_s(sys.executable, "-c", "pass") for _ in range(3))
    emit("import.h3data_s", min(_wall_s(sys.executable, "-c", "import h3data") for _ in range(3)) - bare, "s")
    cli = (sys.executable, "-m", "h3data_pipelines.cli")
    emit("cli.help_s", min(_wall_s(*cli, "--help") for _ in range(3)), "s")
    with tempfile.TemporaryDirectory() as folder:
        _demo(emit, cli, Path(folder))
        checked = _make_run(Path(folder) / "checked", "rollout_expert", VALIDATED, VALIDATED_STEPS)
        emit(f"validate.{VALIDATED}x{VALIDATED_STEPS}_cpu_s", cpu_s(*cli, "validate", str(checked)), "s")
        runs = [str(_make_run(Path(folder) / policy, policy)) for policy in REPORT_RUNS]
        out = Path(folder) / "report.html"
        emit(
            "report.1000_wall_s", min(_wall_s(*cli, "report", *runs, "-o", str(out), "--force") for _ in range(2)), "s"
        )
        emit("report.1000_mb", out.stat().st_size / 1e6, "MB")
