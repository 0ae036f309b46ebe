"""Builder of the compiled kernels that h3data's commands use, for this Python and numba (``make kernels``).

It runs the commands of `SESSIONS`, each session in its own process tree and with its own caches, and stores the kernels
that they have loaded or compiled (`h3data.kernels.shipped.RECORD`). Those that `GAINING` names are then compiled for the
higher levels of processors too (`h3data.kernels.shipped.LEVELS`), for the same types of arguments. Kernels whose code has not
changed are loaded from the folders, so only new ones take time: about six minutes on two idle cores if all are new, and one
minute if none are.
"""

from __future__ import annotations

import importlib
import lzma
import os
import pickle
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from h3data.errors import H3DataError
from h3data.files import size_text
from h3data.kernels import decorators, digests, shipped
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


GAINING = ("h3data.bodies.", "h3data.render.")
"""First parts of the names of kernels that are also compiled for higher levels than the lowest one, because they gain speed
there (README.md): not those of floors and paths, nor the simulator's."""


def build() -> str:
    """Run all sessions for the lowest level, compile some of their kernels for higher levels, and replace all folders.

    On a processor that lacks features of a higher level, nothing is compiled for it, and those of its kernels whose code
    has changed are deleted; h3data then takes those of the lowest level.
    """
    *higher, base = shipped.LEVELS
    if sys.platform != "linux" or shipped.lacking(base):
        raise SystemExit(f"Kernels are compiled on Linux; for {base} this processor lacks {shipped.lacking(base)}.")
    with TemporaryDirectory() as scratch, ThreadPoolExecutor(core_count()) as pool:
        recorded = {level: Path(scratch, level) for level in shipped.LEVELS}
        for folder in recorded.values():
            folder.mkdir()
        list(pool.map(lambda name: _run(name, Path(scratch), recorded[base]), SESSIONS))
        # the largest first, dealt out in turn, so that all processes take about as long
        used = sorted(recorded[base].glob("*.nbc.xz"), key=lambda path: -path.stat().st_size)
        used = [path for path in used if path.name.startswith(GAINING)]
        parts = [used[k :: core_count()] for k in range(core_count())]
        for level in higher:
            if not shipped.lacking(level):
                list(pool.map(lambda part, level=level: _compile_apart(part, level, recorded[level]), parts))
            else:
                old = (HERE / shipped.folder_name(level) / path.name for path in used)
                for path in filter(Path.exists, old):
                    shutil.copy(path, recorded[level])
            for path in recorded[level].iterdir():
                if not (recorded[base] / path.name).exists():  # only other kernels call it
                    path.unlink()
        return "\n".join(_replace(level, recorded[level]) for level in recorded)


def compile_again(files: Sequence[Path]) -> None:
    """Compile the kernels of some files for the same types of arguments, in the way that numba's settings say."""
    stamps = {path: path.name.rsplit("-", 1)[0] for path in files}
    for stamp in set(stamps.values()):
        importlib.import_module(stamp.rsplit("-", 1)[0].rpartition(".")[0])
    kernels = {
        shipped.code_stamp(kernel): kernel
        for kernel in decorators._kernels
        if kernel.__module__.split(".")[0] in digests.OURS
    }
    for path, stamp in stamps.items():
        with lzma.open(path) as file:
            signature = pickle.load(file)[3]  # of what `CompileResult._reduce` returns
        kernels[stamp].compile(signature.args)


def _compile_apart(files: Sequence[Path], level: str, recorded: Path) -> None:
    """Run `compile_again` for a level in a process of its own, which stores machine code in ``recorded``."""
    start = time.perf_counter()
    with TemporaryDirectory() as caches:
        _call([sys.executable, __file__, *map(str, files)], level, recorded, Path(caches))
    sys.stderr.write(f"  {level:<14} {time.perf_counter() - start:6.1f} s\n")


def _run(name: str, scratch: Path, recorded: Path) -> None:
    start, folder = time.perf_counter(), scratch / name.replace(" ", "_")
    folder.mkdir()
    for line in SESSIONS[name]:
        words = [word.replace("{scratch}", str(folder)) for word in shlex.split(line)]
        program = ["-m", "h3data_pipelines.cli"] if words[0] == "h3data" else []
        _call([sys.executable, *program, *words[1:]], list(shipped.LEVELS)[-1], recorded, folder)
    sys.stderr.write(f"  {name:<14} {time.perf_counter() - start:6.1f} s\n")


def _call(command: Sequence[str], level: str, recorded: Path, caches: Path) -> None:
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": level,
        "NUMBA_CPU_FEATURES": "",
        # of all sessions of a level
        "NUMBA_CACHE_DIR": str(recorded.with_name(f"numba-{level}")),
        "H3DATA_CACHE": str(caches / "cache"),
        "H3DATA_QUIET": "1",
        shipped.RECORD: str(recorded),
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "pipelines", ROOT / "viewers"))),
    }
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        line = shlex.join(command)[:200]
        raise H3DataError(f"{line} failed; no kernels were replaced.\n{done.stdout[-3000:]}{done.stderr[-3000:]}")


def _replace(level: str, recorded: Path) -> str:
    """Make the folder of a level hold what was recorded. Files that are there already stay as they are, byte for byte."""
    folder = HERE / shipped.folder_name(level)
    before = {path.name for path in folder.glob("*")}
    now = {path.name: path.stat().st_size for path in recorded.glob("*.nbc.xz")}
    folder.mkdir(exist_ok=True)
    for name in now.keys() - before:
        shutil.copy(recorded / name, folder / name)
    for name in before - now.keys():
        (folder / name).unlink()
    lacking = shipped.lacking(level)
    missing = f"; nothing was compiled for this level, as this processor lacks {', '.join(lacking)}" if lacking else ""
    return (
        f"{level}: {len(now)} kernels, {size_text(sum(now.values()))}, in {folder}: "
        f"{len(now.keys() - before)} new, {len(before - now.keys())} deleted{missing}"
    )


if __name__ == "__main__":
    try:
        if sys.argv[1:]:
            compile_again([Path(name) for name in sys.argv[1:]])
        else:
            print(build())  # noqa: T201
    except H3DataError as error:
        raise SystemExit(f"error: {error}") from None
