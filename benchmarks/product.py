"""What a user waits for: importing the package, the help, the demo."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path


def _wall_s(*command: str) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def run(emit: Callable[[str, float, str], None]) -> None:
    """Wall seconds, best of three; the demo once, with warm caches."""
    bare = min(_wall_s(sys.executable, "-c", "pass") for _ in range(3))
    emit("import.h3data_s", min(_wall_s(sys.executable, "-c", "import h3data") for _ in range(3)) - bare, "s")
    cli = (sys.executable, "-m", "h3data_pipelines.cli")
    emit("cli.help_s", min(_wall_s(*cli, "--help") for _ in range(3)), "s")
    with tempfile.TemporaryDirectory() as folder:
        _wall_s(*cli, "demo", "--steps", "5", "-o", str(Path(folder) / "warm"))
        emit("demo.wall_s", _wall_s(*cli, "demo", "-o", str(Path(folder) / "demo")), "s")
