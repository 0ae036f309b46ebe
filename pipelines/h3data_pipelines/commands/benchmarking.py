"""Command ``h3data benchmark``, which runs a named benchmark, verifies results of it, and makes a leaderboard."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import ForceFlag, Group, JsonFlag, Outcome, claim_file, write_text
from h3data.commands.executors import ExecutorOption
from h3data.commands.options import command_of
from h3data.errors import InputError, suggest_keywords
from h3data.progress import progress
from h3data.terminal import aligned, counted

if TYPE_CHECKING:
    from h3data.commands.arguments import FilePath
    from h3data_pipelines.arguments import Policies
    from h3data_pipelines.benchmark.result import BenchmarkRun
    from h3data_pipelines.benchmark.verification import ResultVerification


@dataclass(frozen=True)
class BenchmarkList:
    """List the benchmarks that ship with the package.

    Examples:
        h3data benchmark list
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the name, task, number of episodes and description of each benchmark."""
        from h3data_pipelines.benchmark.definition import benchmark_labels, find_benchmark

        found = [find_benchmark(label) for label in benchmark_labels()]
        data = [
            {
                "benchmark": one.label,
                "task": one.file.task,
                "episodes": one.file.episodes,
                "partners": one.file.partners,
                "rank": one.file.rank,
                "about": one.file.about,
            }
            for one in found
        ]
        lines = [["Benchmark", "Task", "Episodes", ""]]
        lines += [[one.label, one.file.task, str(one.file.episodes), one.file.about] for one in found]
        return Outcome(text=aligned(lines), data={"benchmarks": data})


@suggest_keywords
def run_benchmark(
    benchmark: str,
    out: FilePath,
    *,
    policies: Policies = (),
    workers: int = 1,
    executor: str = "local",
    resume: bool = False,
    force: bool = False,
) -> BenchmarkRun:
    """Play policies in all episodes of a benchmark: ``run_benchmark("h3-social-nav@1", "out/mine", policies=[Mine])``.

    ``h3data benchmark run --help`` explains the options, which have the same names there.

    Returns:
        The table with 95% intervals, which is also in ``benchmark.json`` of the folder, and the failed episodes.

    Raises:
        InputError: there is no such benchmark or policy, or the folder holds other files.
    """
    return result_of(BenchmarkRunCommand, locals())


@command_of(run_benchmark)
class BenchmarkRunCommand:
    """Play policies in all episodes of a benchmark, and store the recordings with the table of metrics.

    The folder gets the recordings, the results of each episode, and benchmark.json: the table with 95% intervals, the machine,
    the versions and the digest of every file. Anyone who has the folder can check it with h3data benchmark verify. An
    interrupted run continues where it stopped.

    Examples:
        h3data benchmark run h3-social-nav@1 --policy end_to_end -o out/end_to_end
        h3data benchmark run h3-social-nav@1 --policies heuristic_expert,weights:net.npz --workers 4 -o out/mine
        h3data benchmark run h3-rearrange@1 --policy my_package:MyPlanner -o out/planner
    """

    benchmark: tyro.conf.Positional[str]
    """Name of the benchmark (h3data benchmark list), optionally with its version, or a folder with a benchmark.toml."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the result."""
    policies: tuple[str, ...]
    """Policies of the robot: names as for h3data evaluate, or all."""
    workers: int
    """Number of worker processes."""
    executor: ExecutorOption
    resume: bool
    """Continue a run that was started with the same policies, and fail if there is none. Without this option, an existing run
    is continued too."""
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Play all episodes and return the table."""
        import msgspec

        from h3data_pipelines.benchmark import result
        from h3data_pipelines.benchmark.definition import find_benchmark

        done = result.run_benchmark(
            find_benchmark(self.benchmark),
            self.policies,
            self.out,
            resume=self.resume,
            force=self.force,
            workers=self.workers,
            executor=self.executor,
            progress=progress,
        )
        data = {**msgspec.to_builtins(done.result), "failed": list(done.failed)}
        data.pop("files")
        return Outcome(text=done.to_text(), data=data, result=done, exit_code=0 if done.result.is_complete else 1)


@suggest_keywords
def verify_benchmark(
    result: FilePath, *, benchmark: FilePath | None = None, episodes: int | None = None, seed: int = 0, workers: int = 1
) -> ResultVerification:
    """Check whether the table of a result follows from its recordings, as in ``verify_benchmark("out/mine").is_true``.

    ``h3data benchmark verify --help`` explains the options, which have the same names there.

    Returns:
        The numbers of checked recordings and episodes, and the faults that were found.

    Raises:
        InputError: the folder holds no result, or there is no such benchmark.
    """
    return result_of(BenchmarkVerify, locals())


@command_of(verify_benchmark)
class BenchmarkVerify:
    """Check whether the table of a result follows from its recordings.

    Each recording is compared with the episode that the benchmark names, simulated again from the robot's actions,
    while the policies of people decide again, and measured again. The table has to follow from these measurements. The
    robots' policies are not needed. The exit code is 1 if there are faults. On the same processor architecture,
    recordings are equal bit for bit; on others the last bits may differ.

    Examples:
        h3data benchmark verify out/end_to_end
        h3data benchmark verify out/end_to_end --episodes 20 --seed 7
        h3data benchmark verify out/mine --workers 4 --json
    """

    result: tyro.conf.Positional[Path]
    """Folder of the result."""
    benchmark: Path | None
    """Name or folder of the benchmark (default: the shipped one that the result names)."""
    episodes: int | None
    """Number of episodes to check, sampled at random (default: all)."""
    seed: int
    """Seed of the random sample of episodes."""
    workers: int
    """Number of worker processes."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Verify the result and return the verdict, which is also stored in the result's folder."""
        from h3data_pipelines.benchmark.leaderboard import VERDICT, write_verdict
        from h3data_pipelines.benchmark.verification import verify_result

        found = verify_result(
            self.result,
            benchmark=None if self.benchmark is None else str(self.benchmark),
            episodes=self.episodes,
            seed=self.seed,
            workers=self.workers,
            progress=progress,
        )
        write_text(self.result / VERDICT, json_module.dumps(write_verdict(found), indent=1) + "\n")
        return Outcome(text=found.to_text(), data=found.to_dict(), result=found, exit_code=0 if found.is_true else 1)


@dataclass(frozen=True)
class BenchmarkTable:
    """Make a leaderboard of a benchmark with its baselines and any results, best first.

    The column "Checked" shows which results h3data benchmark verify has checked, and how many of their episodes.

    Examples:
        h3data benchmark table --benchmark h3-social-nav@1
        h3data benchmark table out/end_to_end out/mine
        h3data benchmark table out/*/ -o leaderboard.html
        h3data benchmark table out/mine -o leaderboard.md
    """

    results: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders of results of one benchmark."""
    benchmark: str | None = None
    """Name or folder of the benchmark (default: the one that the first result names)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Page to write: .html or .md (default: Markdown on stdout)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the leaderboard, and write it to the file in ``out`` if one is named."""
        from h3data_pipelines.benchmark.definition import find_benchmark
        from h3data_pipelines.benchmark.leaderboard import leaderboard
        from h3data_pipelines.benchmark.result import read_result

        if not self.results and self.benchmark is None:
            raise InputError(
                "Expected folders of results, or --benchmark NAME for its baselines alone; got neither.",
                code="H3-OPTION-095",
            )
        name = self.benchmark or read_result(self.results[0]).benchmark
        board = leaderboard(find_benchmark(name), self.results)
        data = board.to_dict()
        if self.out is None:
            return Outcome(text=board.to_markdown(), data=data, result=board)
        if self.out.suffix not in (".html", ".md"):
            raise InputError(f"Expected a page .html or .md to write with -o, got {self.out}.", code="H3-OPTION-096")
        page = board.to_html() if self.out.suffix == ".html" else board.to_markdown()
        write_text(claim_file(self.out, force=self.force), page)
        text = f"{self.out}: {counted(len(board.entries), 'row')} of {board.benchmark.label}"
        return Outcome(text=text, data={**data, "page": str(self.out)}, result=board)


BENCHMARK = Group(
    "Run named benchmarks, and check anybody's results of them.",
    {"list": BenchmarkList, "run": BenchmarkRunCommand, "verify": BenchmarkVerify, "table": BenchmarkTable},
)
