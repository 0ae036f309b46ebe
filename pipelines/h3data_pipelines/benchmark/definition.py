"""Definition of a benchmark in a folder with ``benchmark.toml``, a list of episodes, and the results of baselines.

The benchmarks that ship with the package are in ``datasets/benchmarks``; any other folder of this form can be run by its path.
A benchmark never changes: new episodes, rules or metrics are a new version.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from h3data.builtin import builtin_root
from h3data.errors import FormatError, InputError, suggest
from h3data.plugins import names_from_data
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from h3data_pipelines.jobs.evaluations import episode_uid

if TYPE_CHECKING:
    from h3data.metrics import Metric
    from h3data_pipelines.jobs.evaluations import Evaluation

FORMAT = 1
FOLDER = "benchmarks"
"""Name of the folder of benchmarks in the data of the package."""
DEFINITION, EPISODES, BASELINES = "benchmark.toml", "episodes.json", "baselines.json"


class BenchmarkFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Contents of ``benchmark.toml``."""

    format: int
    name: str
    version: int
    about: str
    task: str
    scenes: list[str]
    episodes: int
    seed: int = 0
    partners: list[str] = []
    """Policies of people, for tasks in which every robot plays with several of them."""
    rules: str | None = None
    """Name of a set of rules: ``natural`` or ``paper``."""
    overrides: dict[str, Any] = {}
    """Fields of the task's rules that differ from this set of rules."""
    metrics: list[str]
    """Names of the metrics that are columns of the leaderboard."""
    rank: str
    """Metric by which the rows of the leaderboard are sorted, best first."""


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """A benchmark that can be run."""

    folder: Path
    file: BenchmarkFile
    sha256: str
    """Digest of the definition and of the list of episodes."""

    @property
    def label(self) -> str:
        """Name and version, such as ``h3-social-nav@1``."""
        return f"{self.file.name}@{self.file.version}"

    def request(self, policies: tuple[str, ...]) -> EvaluationRequest:
        """Return the evaluation of some policies under the rules of this benchmark."""
        of = self.file
        return EvaluationRequest(
            task=of.task,
            policies=policies,
            partners=tuple(of.partners) or ("all",),
            scenes=tuple(of.scenes),
            episodes=of.episodes,
            seed=of.seed,
            rules=of.rules,
            overrides=tuple(of.overrides.items()),
        )

    def jobs(self) -> list[Evaluation]:
        """Return the jobs of all episodes, without a policy."""
        from sim_kinematic.policies.assignment import policy_names
        from sim_kinematic.tasks.registry import find_task

        return self.request(tuple(policy_names(find_task(self.file.task), "robot")[:1])).jobs()

    def metrics(self) -> list[Metric]:
        """Return the metrics in the columns of the leaderboard, including the ranking metric."""
        from h3data.metrics.registry import profile_for
        from sim_kinematic.tasks.registry import find_task

        task = find_task(self.file.task)
        known = {metric.name: metric for metric in profile_for(task.name, {}, task.profile or None).metrics}
        if unknown := [name for name in (*self.file.metrics, self.file.rank) if name not in known]:
            raise FormatError(
                f"{self.label}: unknown metrics {', '.join(unknown)}. Expected some of {', '.join(known)}. "
                f"File: {self.folder / DEFINITION}",
                code="H3-OPTION-083",
            )
        return [known[name] for name in self.file.metrics]

    def episode_uids(self) -> list[str]:
        """Return the identity (`episode_uid`) of each episode, in order.

        Raises:
            FormatError: the list of episodes is missing or malformed.
        """
        path = self.folder / EPISODES
        try:
            listed = json.loads(path.read_text(encoding="utf-8"))["episodes"]
            uids = [str(entry["uid"]) for entry in listed]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as fault:
            raise FormatError(
                f"Expected the episodes of {self.label}, got {fault!r}. File: {path}", code="H3-OPTION-086"
            ) from None
        if len(uids) != self.file.episodes:
            raise FormatError(
                f"Expected {self.file.episodes} episodes, as {DEFINITION} says, got {len(uids)}. File: {path}",
                code="H3-OPTION-084",
            )
        return uids


def list_episodes(jobs: list[Evaluation]) -> Iterator[dict[str, Any]]:
    """Yield the number, scene, seed and identity of each episode, which are the entries of ``episodes.json``."""
    for job in jobs:
        base = job.base
        yield {
            "index": base.index,
            "scene": base.scene,
            "seed": base.seed,
            "uid": episode_uid(base.found_task, base.episode()),
        }


def benchmark_labels() -> tuple[str, ...]:
    """Return names and versions of the benchmarks that ship with the package."""
    return tuple(sorted(path.parent.name for path in (builtin_root() / FOLDER).glob(f"*/{DEFINITION}")))


def find_benchmark(name: str) -> Benchmark:
    """Return the benchmark with a name (in its newest version), with a name and version, or in a folder.

    Raises:
        InputError: no benchmark has this name.
        FormatError: its files are damaged, or of another version of the format.
    """
    labels = benchmark_labels()
    versions = sorted((label for label in labels if label.rpartition("@")[0] == name), key=_version)
    label = versions[-1] if versions else name
    if label in labels:
        return read_benchmark(builtin_root() / FOLDER / label)
    if (Path(name) / DEFINITION).is_file():
        return read_benchmark(Path(name))
    raise InputError(
        f"There is no benchmark {name!r}.{suggest(name, labels, more=f', or a folder with {DEFINITION}')}",
        code="H3-OPTION-097",
    )


def read_benchmark(folder: Path) -> Benchmark:
    """Return the benchmark in a folder.

    Raises:
        FormatError: its definition is damaged, or of another version of the format.
        UntrustedNameError: the definition names a task or policy that is not built in, installed or trusted.
    """
    path, episodes = folder / DEFINITION, folder / EPISODES
    try:
        text = path.read_bytes()
        file = msgspec.toml.decode(text, type=BenchmarkFile)
    except (OSError, msgspec.DecodeError, ValueError, RecursionError) as fault:
        raise FormatError(f"Expected a benchmark, got: {fault} File: {path}", code="H3-OPTION-085") from None
    if file.format != FORMAT:
        raise FormatError(
            f"Expected format {FORMAT} of benchmarks, got {file.format}. File: {path}", code="H3-OPTION-081"
        )
    if file.episodes < 1 or not file.scenes or not file.metrics:
        raise FormatError(f"Expected at least one scene, episode and metric. File: {path}", code="H3-OPTION-082")
    _check_names(file)
    listed = episodes.read_bytes() if episodes.is_file() else b""
    return Benchmark(folder=folder, file=file, sha256=hashlib.sha256(text + b"\0" + listed).hexdigest())


def _check_names(file: BenchmarkFile) -> None:
    """Look up what a definition names, which may be anybody's: only what is built in, installed or trusted is imported.

    Raises:
        UntrustedNameError: it names a module of the working directory.
    """
    from sim_kinematic.policies.assignment import resolve_policy
    from sim_kinematic.tasks.registry import find_task

    with names_from_data():
        task = find_task(file.task)
        for partner in file.partners:
            resolve_policy(task, "human", partner)


def _version(label: str) -> int:
    number = label.rpartition("@")[2]
    return int(number) if number.isdecimal() else -1
