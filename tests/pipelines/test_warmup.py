"""Kernels are compiled once per machine, by however many processes, and `h3data warmup` does it ahead."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from h3data.kernels import shipped
from h3data_pipelines.machine import warmup
from h3data_pipelines.machine.warmup import Warmup, compiled_aside

MODULE = """
from h3data.kernels import kernel

@kernel()
def doubled(x):
    total = 0.0
    for k in range(3):
        total += 2 * x
    return total
"""
COMPILE = "import time; from warm_kernel import doubled; doubled(1.0); print(sum(doubled.stats.cache_misses.values()))"
WORKERS = """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

def work(_):
    from warm_kernel import doubled
    doubled(1.0)
    return sum(doubled.stats.cache_misses.values())

if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        print(*pool.map(work, range(2)))
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "warm_kernel.py").write_text(MODULE)
    path = os.pathsep.join([str(tmp_path), *(p for p in sys.path if p)])
    return {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": path}


def _python(*arguments: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True)


@pytest.mark.slow
def test_processes_that_start_together_compile_a_kernel_once(environment: dict[str, str]) -> None:
    command = [sys.executable, "-c", COMPILE]
    processes = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert sum(int(process.communicate()[0]) for process in processes) == 1


@pytest.mark.slow
def test_workers_compile_once_and_say_so_once(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "workers.py").write_text(WORKERS)
    done = _python(str(tmp_path / "workers.py"), environment=environment)
    assert sum(map(int, done.stdout.split())) == 1
    assert done.stderr.count("Compiling kernels, once per machine") == 1
    assert "`h3data warmup`" in done.stderr
    assert not _python(str(tmp_path / "workers.py"), environment=environment).stderr


@pytest.mark.slow
def test_the_announcement_can_be_silenced(environment: dict[str, str]) -> None:
    assert not _python("-c", COMPILE, environment={**environment, "H3DATA_QUIET": "1"}).stderr
    quiet = 'import logging; logging.getLogger("h3data.kernels").setLevel("WARNING"); '
    (Path(environment["PYTHONPATH"].split(os.pathsep)[0]) / "warm_kernel.py").write_text(MODULE + "\n")
    assert not _python("-c", quiet + COMPILE, environment=environment).stderr


@pytest.mark.slow
def test_a_killed_process_leaves_no_lock(environment: dict[str, str]) -> None:
    killed = COMPILE.replace(
        "doubled(1.0)",
        "from h3data.kernels import decorators; from pathlib import Path; "
        + (
            "c = doubled._cache._cache_file._index_path; decorators._locked(Path(c + '.lock')).__enter__(); "
            "import os; os.kill(os.getpid(), 9)"
        ),
    )
    subprocess.run([sys.executable, "-c", killed], env=environment, check=False)
    assert _python("-c", COMPILE, environment=environment).stdout == "1\n"


@pytest.mark.slow
def test_warmup_says_what_it_compiled(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(warmup, "WORK", {"pictures": warmup.WORK["pictures"]})
    monkeypatch.setenv("NUMBA_CPU_NAME", "host")  # without kernels that come compiled
    outcome = Warmup().run()
    assert outcome.data["kernels"] >= 15
    assert outcome.data["megabytes"] > 0.5
    assert outcome.data["parts"]["pictures"]["wall_s"] > 0
    assert Path(outcome.data["folder"]).is_dir()
    again = Warmup().run()
    assert again.data["compiled"] == 0
    assert "There was nothing to compile" in again.text
    assert "pictures" in capfd.readouterr().err


def test_work_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "WORK", {"nothing": print})  # the process that should do it knows no such work
    with pytest.raises(Exception, match=r"(?s)nothing.*KeyError.*H3-MACHINE-019"):
        Warmup().run()


def test_compiling_aside_ends_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "folders", tuple)
    monkeypatch.setattr(warmup, "compiled_files", dict)
    with compiled_aside(["pictures"]) as aside:
        assert aside is not None
        assert aside.poll() is None
    assert aside.poll() is not None


def test_nothing_is_compiled_aside_where_kernels_come_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shipped, "folders", lambda: (tmp_path,))
    monkeypatch.setattr(warmup, "_start", None)
    with compiled_aside(["pictures"]) as aside:
        assert aside is None


@pytest.mark.slow
def test_after_warmup_the_demo_compiles_nothing(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "H3DATA_CACHE": str(tmp_path / "cache")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = ("-m", "h3data_pipelines.cli")
    _python(*command, "warmup", environment=environment)
    demo = _python(*command, "demo", "--steps", "30", "-o", str(tmp_path / "demo"), environment=environment)
    assert "Compiling" not in demo.stderr
