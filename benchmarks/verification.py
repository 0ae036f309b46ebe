"""CPU time of ``h3data benchmark verify`` for all 150 episodes of ``h3-social-nav@1``, which one policy has played.

Figures are user and system seconds of the command, so they include its start. They stand beside those of the run.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.product import cpu_s

BENCHMARK, POLICY = "h3-social-nav@1", "heuristic_expert"


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit ``verification.social_nav_150.{run,verify}_cpu_s``."""
    cli = (str(Path(sys.executable).with_name("h3data")), "benchmark")
    with tempfile.TemporaryDirectory() as folder:
        result = str(Path(folder) / "result")
        emit(
            "verification.social_nav_150.run_cpu_s",
            cpu_s(*cli, "run", BENCHMARK, "--policy", POLICY, "-o", result),
            "s",
        )
        emit("verification.social_nav_150.verify_cpu_s", cpu_s(*cli, "verify", result), "s")
