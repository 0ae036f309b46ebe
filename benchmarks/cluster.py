"""Ray beside the processes of this machine: cost of a shard, speed-up by a second worker, a long job whose nodes are killed.

A cluster is simulated on this machine (``tests/pipelines/ray_nodes.py``), the object store is moto's S3 server. Overhead is CPU
time, so that other work on the machine hardly matters; speed-up is wall time and needs two idle cores.
"""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from h3data.commands.executors import opened

SHARDS = 6
SHARD_S = 10.0
"""CPU time of a shard at which the overhead is measured [s]."""
EPISODES, STEPS = 2000, 30
KILLS = 12
"""Number of killed nodes, one for each further file of 100 episodes in the object store."""
DRIVER_DIES_AT = 4
"""Number of files in the object store at which the driver is killed, before it continues with ``--resume``."""


def run(emit: Callable[[str, float, str], None], episodes: int = EPISODES) -> None:
    """Measure overhead and speed-up, then play episodes into S3 while nodes and the driver die, and again locally."""
    os.environ["RAY_ADDRESS"] = "local"
    _overhead(emit)
    for executor in ("local", "ray"):
        _speed_up(emit, executor)
    os.environ.pop("RAY_ADDRESS")
    _killed(emit, episodes)


def burn(seconds: float) -> float:
    """Occupy a core for a CPU time [s]; returns what it took."""
    start = time.process_time()
    while time.process_time() - start < seconds:
        sum(range(10_000))
    return time.process_time() - start


def count(rounds: int) -> int:
    """Return a fixed amount of work: some 10 s for 20,000 rounds."""
    total = 0
    for _ in range(rounds):
        total += sum(range(20_000))
    return total


def _overhead(emit: Callable[[str, float, str], None]) -> None:
    """Emit the CPU time of this process and its children beyond that of the shards, per CPU time of the shards."""
    with opened("ray", 2) as ray:
        list(ray.run(burn, [0.5] * 4))  # the workers have started
        before = _cpu_s_of_tree()
        worked = sum(ray.run(burn, [SHARD_S] * SHARDS))
        overhead = 100 * (_cpu_s_of_tree() - before - worked) / worked
        before = _cpu_s_of_tree()
        worked = sum(ray.run(burn, [0.1] * 100))
        each_ms = 10 * (_cpu_s_of_tree() - before - worked)
    emit("cluster.ray.overhead_at_10_s", overhead, "%")  # out here: Ray's block has no stdout
    emit("cluster.ray.cpu_ms_per_shard", each_ms, "ms")


def _speed_up(emit: Callable[[str, float, str], None], executor: str) -> None:
    walls = []
    for workers in (1, 2):
        with opened(executor, workers) as who:
            list(who.run(count, [1] * workers * 2))  # a pool of Ray lives on; that of processes starts again, below
            start = time.perf_counter()
            list(who.run(count, [20_000] * SHARDS))
            walls.append(time.perf_counter() - start)
    emit(f"cluster.{executor}.two_workers", walls[0] / walls[1], "x")


def _cpu_s_of_tree() -> float:
    """Return the CPU time of this process and its living descendants [s]."""
    parents: dict[int, tuple[int, float]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        ticks = int(fields[11]) + int(fields[12])
        parents[int(path.parent.name)] = int(fields[1]), ticks / os.sysconf("SC_CLK_TCK")
    ours, total = {os.getpid()}, parents[os.getpid()][1]
    while new := {pid for pid, (parent, _) in parents.items() if parent in ours and pid not in ours}:
        total += sum(parents[pid][1] for pid in new)
        ours |= new
    return total


def _killed(emit: Callable[[str, float, str], None], episodes: int) -> None:
    from h3data.recording import Dataset
    from h3data.recording.storage import RemotePath, place
    from tests.object_store import bucket
    from tests.pipelines.ray_nodes import ray_nodes

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    command = [sys.executable, "-m", "h3data_pipelines.cli", "generate", "social_nav", "--quiet", "--seed", "3"]
    command += ["--episodes", str(episodes), "--max-steps", str(STEPS), "--homes", "2", "--workers", "2"]
    with ExitStack() as stack:
        here = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        start = time.perf_counter()
        done = subprocess.run([*command, "-o", str(here / "ds")], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"The job on this machine ended with code {done.returncode}: {done.stderr[-500:]}")
        emit("cluster.killed.local_wall_s", time.perf_counter() - start, "s")
        nodes, uri = stack.enter_context(ray_nodes(2)), stack.enter_context(bucket())
        root = place(f"{uri}/ds")
        assert isinstance(root, RemotePath)
        by_ray = [*command, "--executor", "ray", "-o", f"{uri}/ds"]
        start = time.perf_counter()
        told = stack.enter_context(tempfile.TemporaryFile("w+"))
        driver, kept = subprocess.Popen(by_ray, stdout=subprocess.DEVNULL, stderr=told), 0
        while driver.poll() is None:
            time.sleep(2.0)
            committed = len(list((root / "meta/episodes").glob("chunk-*/file-*.parquet")))
            if not kept and committed >= DRIVER_DIES_AT:
                driver.send_signal(signal.SIGKILL)
                driver.wait()
                kept = len(Dataset(root))
                driver = subprocess.Popen([*by_ray, "--resume"], stdout=subprocess.DEVNULL, stderr=told)
            elif nodes.killed < min(committed, KILLS):
                nodes.replace(nodes.killed % nodes.count)
        emit("cluster.killed.ray_wall_s", time.perf_counter() - start, "s")
        emit("cluster.killed.exit_code", driver.returncode, "1")
        if driver.returncode:
            told.seek(0)
            sys.stderr.write(told.read()[-2000:])
        emit("cluster.killed.nodes", nodes.killed, "nodes")
        emit("cluster.killed.kept_when_the_driver_died", kept, "episodes")
        emit("cluster.killed.episodes", len(Dataset(root)), "episodes")
        there = {str(p.relative_to(root)): _digest(p.read_bytes()) for p in root.rglob("*") if p.is_file()}
        local = {str(p.relative_to(here / "ds")): _digest(p.read_bytes()) for p in _files(here / "ds")}
        emit("cluster.killed.files", len(local), "files")
        emit("cluster.killed.files_that_differ", len({name for name, _ in there.items() ^ local.items()}), "files")


def _files(root: Path) -> list[Path]:
    return [path for path in root.rglob("*") if path.is_file()]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
