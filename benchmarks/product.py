"""What a user waits for: importing the package, the help, the demo, a report of 1,000 episodes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

REPORT_RUNS, REPORT_EPISODES = ("rollout_expert", "random"), 500


def _wall_s(*command: str) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def _make_run(folder: Path, policy: str) -> Path:
    """A dataset of `REPORT_EPISODES` episodes: ten simulated ones over and over, under different names."""
    from h3data.recording import DatasetWriter
    from h3data.scene import HomeSpec, build_home
    from sim_kinematic.tasks.runner import simulate
    from sim_kinematic.tasks.social_nav import SocialNav

    homes = [build_home(HomeSpec(preset="small", seed=seed)) for seed in range(2)]
    worlds = [SocialNav().episode(homes[k % 2], seed=k) for k in range(10)]
    recordings = [simulate(SocialNav(), world, {"robot": policy}) for world in worlds]
    with DatasetWriter(folder) as writer:
        for k in range(REPORT_EPISODES):
            recording = recordings[k % len(recordings)]
            episode = replace(recording.episode, uid=f"{policy}-{k}", episode_id=f"{k:06d}")
            writer.add(replace(recording, episode=episode))
    return folder


def run(emit: Callable[[str, float, str], None]) -> None:
    """Wall seconds, best of three; the demo once, with warm caches."""
    bare = min(_wall_s(sys.executable, "-c", "pass") for _ in range(3))
    emit("import.h3data_s", min(_wall_s(sys.executable, "-c", "import h3data") for _ in range(3)) - bare, "s")
    cli = (sys.executable, "-m", "h3data_pipelines.cli")
    emit("cli.help_s", min(_wall_s(*cli, "--help") for _ in range(3)), "s")
    with tempfile.TemporaryDirectory() as folder:
        _wall_s(*cli, "demo", "--steps", "5", "-o", str(Path(folder) / "warm"))
        emit("demo.wall_s", _wall_s(*cli, "demo", "-o", str(Path(folder) / "demo")), "s")
        runs = [str(_make_run(Path(folder) / policy, policy)) for policy in REPORT_RUNS]
        out = Path(folder) / "report.html"
        emit(
            "report.1000_wall_s", min(_wall_s(*cli, "report", *runs, "-o", str(out), "--force") for _ in range(2)), "s"
        )
        emit("report.1000_mb", out.stat().st_size / 1e6, "MB")
