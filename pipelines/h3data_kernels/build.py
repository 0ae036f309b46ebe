"""Builder of the compiled kernels that h3data's commands use, for this Python and numba (``make kernels``).

It runs the commands of `SESSIONS`, each session in its own process tree and with its own caches, and stores the kernels
that they have loaded or compiled (`h3data.kernels.shipped.RECORD`). Kernels whose code has not changed are loaded from
the folder, so only new kernels take time: about five minutes on two idle cores if all are new, and one minute if none
are.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from h3data.errors import H3DataError
from h3data.files import size_text
from h3data.kernels import shipped
from h3data_pipelines.execution.processes import core_count

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TESTS = "python -m pytest -q -p no:cacheprovider"
DOCS = f"{TESTS} -m slow tests/product/test_docs_run.py -k"
SESSIONS: dict[str, tuple[str, ...]] = {
    "README": (f"{DOCS} README",),  # its commands as a reader types them
    "documentation": (f'{DOCS} "environments or sessions or rerender or first-table or export or view or report"',),
    "training": (f'{DOCS} "training or skills"',),
    "demo": (
        "h3data demo -o {scratch}/demo",
        "h3data demo -o {scratch}/flat --light flat --steps 60",
        "h3data doctor",
        "h3data warmup",
    ),
    "crowds": (
        "h3data generate crowd_nav --scenes small:1 --episodes 1 --max-steps 60 --policy mpc --sensors lidar,lidar_legs "
        "-o {scratch}/mpc",
        "h3data generate crowd_nav --scenes small:1 --episodes 1 --max-steps 60 --policy orca --partner social_force "
        "-o {scratch}/orca",
    ),
    "live play": (
        f"{TESTS} -m slow tests/play/test_live.py -k rehearsal",
        f"{TESTS} tests/play/test_wire.py tests/play/test_apps.py",
    ),
    "Habitat": (f"{TESTS} tests/habitat/navmesh tests/scene/freespace tests/pipelines/test_scenes_command.py",),
    "pictures for a GPU": (f"{TESTS} -m slow tests/training/torch/test_cameras.py -k arms_picture",),
    "oracle skills": (f"{TESTS} tests/sim/agents/test_oracle.py",),
    "floors of others": (  # found in maps and triangles, where no rooms tell of them
        f"{TESTS} tests/ros/test_maps.py -k drawn_and_measured",
        f"{TESTS} tests/worlds/test_usd_foreign.py -k right_size_and_floor",
    ),
}
"""Commands that users run, by their names in progress messages, and tests in place of commands that need users' files.
``{scratch}`` is a folder of the session; everything runs in the checkout, with Habitat's files in
``../shared/real``."""


def build() -> str:
    """Run all sessions and replace the folder of kernels; print its contents."""
    if sys.platform != "linux" or not shipped.folder_name().endswith(shipped.LEVEL):
        raise SystemExit(f"Kernels are shipped for Linux on x86-64; this is {shipped.folder_name()}.")
    with TemporaryDirectory() as scratch, ThreadPoolExecutor(core_count()) as pool:
        recorded = Path(scratch, "kernels")
        recorded.mkdir()
        list(pool.map(lambda name: _run(name, Path(scratch), recorded), SESSIONS))
        return _replace(HERE / shipped.folder_name(), recorded)


def _run(name: str, scratch: Path, recorded: Path) -> None:
    start, folder = time.perf_counter(), scratch / name.replace(" ", "_")
    folder.mkdir()
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": shipped.LEVEL,
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(scratch / "numba"),
        "H3DATA_CACHE": str(folder / "cache"),
        "H3DATA_QUIET": "1",
        shipped.RECORD: str(recorded),
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "pipelines", ROOT / "viewers"))),
    }
    for line in SESSIONS[name]:
        words = [word.replace("{scratch}", str(folder)) for word in shlex.split(line)]
        program = ["-m", "h3data_pipelines.cli"] if words[0] == "h3data" else []
        command = [sys.executable, *program, *words[1:]]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise H3DataError(f"{line} failed; no kernels were replaced.\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    sys.stderr.write(f"  {name:<14} {time.perf_counter() - start:6.1f} s\n")


def _replace(folder: Path, recorded: Path) -> str:
    """Make ``folder`` hold what was recorded. Files that are there already stay as they are, byte for byte."""
    before = {path.name for path in folder.glob("*")}
    now = {path.name: path.stat().st_size for path in recorded.glob("*.nbc.xz")}
    folder.mkdir(exist_ok=True)
    for name in now.keys() - before:
        shutil.copy(recorded / name, folder / name)
    for name in before - now.keys():
        (folder / name).unlink()
    return (
        f"{len(now)} kernels, {size_text(sum(now.values()))}, in {folder}: "
        f"{len(now.keys() - before)} new, {len(before - now.keys())} deleted"
    )


if __name__ == "__main__":
    try:
        print(build())  # noqa: T201
    except H3DataError as error:
        raise SystemExit(f"error: {error}") from None
