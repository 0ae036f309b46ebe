"""Script that trains and evaluates the rows of the paper's table of ablations, several runs at once.

    PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers python -m bake.ablations OUT --updates 717 --gpus 2 --at-once 3

trains every row with every seed under every set of rules for the same number of updates, with the same worlds and
rollouts. OUT/RULES/ROW.SEED is the folder of a run of ``h3data train social_nav``, and ROW.SEED.log is its output. When
all runs of a set of rules have ended, one ``h3data evaluate`` of them writes OUT/RULES/table. The same command
continues where it stopped: after its ``--seconds``, after Ctrl-C or SIGTERM, at which runs save their state, and after
kill -9, which loses the half minute since their last checkpoints.
"""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import tyro

from h3data.errors import InputError
from h3data_training.curve import curve_of
from sim_kinematic.policies.network import RUN_POLICY, read_arrays
from sim_kinematic.sensing.table import PAPER_OBSERVATIONS
from sim_kinematic.tasks.social_nav import SocialNav

DEPTH, DETECTOR, GPS = PAPER_OBSERVATIONS
ROWS: dict[str, tuple[str, ...]] = {
    "rgb": ("arm_rgb", DETECTOR, GPS),
    "all": (DEPTH, DETECTOR, GPS),
    "no_gps": (DEPTH, DETECTOR),
    "no_detector": (DEPTH, GPS),
    "no_depth": (DETECTOR, GPS),
}
"""Observations of each row, the slowest row first, so that no GPU waits for it at the end."""
H3DATA = (sys.executable, "-m", "h3data_pipelines.cli")
SETUP_S, GRACE_S = 120.0, 20.0
"""Remaining time below which no run starts, because its set-up alone needs it, and time that a run has to save itself
[s]."""
LOOK_S = 0.1
"""Interval at which ended runs are detected [s]."""
TRIES = 3
"""Number of times that a run is started in one call if a signal kills it; a run that fails otherwise is not repeated."""


@dataclass(frozen=True, kw_only=True)
class Ablations:
    """Train and evaluate the rows of the table of ablations."""

    out: tyro.conf.Positional[Path]
    """Folder of the runs."""
    updates: int
    """Number of updates of every run."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Names of the rows of the table."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds of every row."""
    rules: tuple[Literal["natural", "paper"], ...] = ("natural", "paper")
    """Sets of rules under which all rows are trained and evaluated."""
    gpus: int = 0
    """Number of GPUs; 0 trains on the CPU."""
    at_once: int = 3
    """Number of runs at once on each GPU, or on the CPU."""
    size: str = "96x72"
    """Size of colour pictures, which have baked light."""
    train: str = "--recipe fast"
    """Additional options of h3data train for all rows, such as --train="--recipe fast --worlds 2048"."""
    seconds: float | None = None
    """Time limit of this call [s]; unfinished runs are saved, and the next call continues them."""
    evaluate: str = "--scenes h3-homes/test --episodes 150"
    """Options of h3data evaluate, given like --train; empty for no evaluation."""

    def __post_init__(self) -> None:
        unknown = [row for row in self.rows if row not in ROWS]
        if unknown or self.updates < 1 or self.at_once < 1 or self.gpus < 0:
            raise InputError(
                f"Expected rows among {', '.join(ROWS)} and at least 1 update and 1 run at once, got "
                f"{', '.join(self.rows)}, {self.updates} and {self.at_once}."
            )

    def runs(self) -> list[Run]:
        """Return all runs, ordered by row (the slowest first) and then by seed."""
        ordered = [row for row in ROWS if row in self.rows]
        return [
            Run(self.out / rules / f"{row}.{seed}") for row in ordered for seed in self.seeds for rules in self.rules
        ]

    def command(self, run: Run, *, stop_after_s: float | None) -> list[str]:
        """Return the command that trains a run or continues it."""
        colour = ["--light", "baked", "--size", self.size] if "arm_rgb" in ROWS[run.row] else []
        options = [*shlex.split(self.train), "--observations", ",".join(ROWS[run.row]), *colour]
        options += ["--rules", run.rules, "--seed", str(run.seed), "--updates", str(self.updates)]
        options += ["--device", "cuda" if self.gpus else "cpu", "--resume", "-o", str(run.folder)]
        if stop_after_s is not None:
            options += ["--stop-after", f"{stop_after_s / 60:.3f}"]
        return [*H3DATA, "train", SocialNav.name, *options]

    def table_command(self, rules: str) -> list[str]:
        """Return the command that evaluates all runs under a set of rules, all seeds of a row as one policy."""
        policies = ",".join(f"weights:{self.out / rules / row}.*/{RUN_POLICY}" for row in ROWS if row in self.rows)
        options = [
            *shlex.split(self.evaluate),
            "--rules",
            rules,
            "--policies",
            policies,
            "-o",
            str(self.out / rules / "table"),
        ]
        return [*H3DATA, "evaluate", SocialNav.name, *options]


@dataclass(frozen=True)
class Run:
    """Training run of one row with one seed under one set of rules."""

    folder: Path
    """Folder RULES/ROW.SEED of the run."""

    @property
    def row(self) -> str:
        """Name of the row."""
        return self.folder.name.partition(".")[0]

    @property
    def seed(self) -> int:
        """Seed of training."""
        return int(self.folder.name.partition(".")[2])

    @property
    def rules(self) -> str:
        """Name of the set of rules."""
        return self.folder.parent.name

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"{self.rules}/{self.folder.name}"

    def updates(self) -> int:
        """Number of updates of the saved policy; 0 if there is none."""
        if not (self.folder / RUN_POLICY).exists():
            return 0
        return int(json.loads(str(read_arrays(self.folder / RUN_POLICY)[1]["card"]))["training"]["updates"])


class _Processes:
    """Runs under way, each in a slot of a GPU, until all are over or the time is."""

    def __init__(self, options: Ablations, say: Callable[[str], None]) -> None:
        self.options, self.say = options, say
        self.ends_s = None if options.seconds is None else time.monotonic() + options.seconds
        self.slots = [gpu for _ in range(options.at_once) for gpu in range(max(options.gpus, 1))]
        self.going: list[tuple[Run, int, subprocess.Popen[bytes]]] = []
        self.tries: dict[Run, int] = {}

    def left_s(self) -> float:
        """Return the seconds that this call has left."""
        return float("inf") if self.ends_s is None else self.ends_s - time.monotonic()

    def start(self, command: Sequence[str], log: Path, gpu: int) -> subprocess.Popen[bytes]:
        """Start a command that ends with this process."""
        # one thread each: several at once would wait for each other
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "NUMBA", "OPENBLAS", "MKL")}
        seen = {"CUDA_VISIBLE_DEVICES": str(gpu)} if self.options.gpus else {}
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as stream:
            return subprocess.Popen(
                command,
                stdout=stream,
                stderr=stream,
                env={**os.environ, **threads, **seen},
                preexec_fn=_end_with_parent,
            )

    def train(self) -> list[Run]:
        """Train until all runs are over or the time is, and return the runs that are not over."""
        left = [run for run in self.options.runs() if run.updates() != self.options.updates]
        failed: list[Run] = []
        try:
            while self.going or (left and self.left_s() > SETUP_S):
                while left and self.slots and self.left_s() > SETUP_S:
                    run, gpu = left.pop(0), self.slots.pop(0)
                    stop_after_s = None if self.ends_s is None else self.left_s() - GRACE_S
                    command = self.options.command(run, stop_after_s=stop_after_s)
                    self.going.append(
                        (run, gpu, self.start(command, run.folder.with_name(f"{run.folder.name}.log"), gpu))
                    )
                time.sleep(LOOK_S)
                if self.left_s() < 0:
                    for _, _, process in self.going:
                        process.kill()
                for one in [one for one in self.going if one[2].poll() is not None]:
                    self.going.remove(one)
                    run, gpu, process = one
                    self.slots.append(gpu)
                    self.say(_summary(run, process.returncode))
                    if run.updates() == self.options.updates:
                        continue
                    self.tries[run] = self.tries.get(run, 0) + 1
                    again = process.returncode < 0 and self.tries[run] < TRIES
                    (left if again else failed).append(run)
        finally:
            for _, _, process in self.going:
                process.terminate()
            for _, _, process in self.going:
                process.wait()
        return left + failed

    def evaluate(self) -> bool:
        """Evaluate all rows under each set of rules, and return whether every table is done."""
        whole = True
        for rules in self.options.rules if self.options.evaluate else ():
            log = self.options.out / rules / "table.log"
            process = self.start(self.options.table_command(rules), log, 0)
            try:
                code = process.wait(None if self.ends_s is None else max(self.left_s() - GRACE_S / 2, 1.0))
            except subprocess.TimeoutExpired:
                process.terminate()
                code = process.wait()
            self.say(f"{rules}: table, exit code {code}; {log}")
            whole &= code == 0
        return whole


def _end_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies, also of kill -9: two processes must not write one folder."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _summary(run: Run, code: int) -> str:
    """Return a line on a run that has ended."""
    try:
        curve = curve_of(run.folder)
    except InputError:
        return f"{run.name}: exit code {code}, no update; {run.folder}.log"
    return (
        f"{run.name}: exit code {code}, {len(curve)} updates, {curve[-1]['decisions'] / 1e6:.2f} M decisions, "
        f"{median(row['decisions_per_s'] for row in curve):.0f} decisions/s (median); {run.folder}.log"
    )


def main(options: Ablations, say: Callable[[str], None] = lambda line: print(line, flush=True)) -> int:  # noqa: T201
    """Train and evaluate; return 0 if everything is done, and 1 if the next call has to continue."""
    processes = _Processes(options, say)
    left = processes.train()
    if left:
        say(f"{len(left)} of {len(options.runs())} runs are not over. Hint: the same command goes on.")
        return 1
    return 0 if processes.evaluate() else 1


def _interrupt(number: int, frame: Any) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        sys.exit(main(tyro.cli(Ablations)))
    except KeyboardInterrupt:
        sys.exit("Stopped; all runs are saved. Hint: the same command goes on.")
