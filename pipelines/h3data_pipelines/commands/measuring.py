"""Command ``h3data metrics``, which makes tables of recordings and datasets by several profiles and explains values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file, open_episode
from h3data.commands.executors import ExecutorOption, check_workers, opened
from h3data.errors import InputError
from h3data_pipelines.execution.processes import core_count

if TYPE_CHECKING:
    from h3data.metrics import Metric


@dataclass(frozen=True)
class Metrics:
    """Compute task metrics from recordings alone, with 95% intervals, compare two runs, or explain a value.

    Profiles: `paper` (S, SPS, F, CR, BYR, TD, FD and SR, RE, CR, RC, TS as published), `habitat` and `habitat@0.3.0` (as
    habitat-lab computes them, bug for bug), `field` (proxemics, efficiency, smoothness), `partnr` (percent complete and
    others), `task` (success, reward, time of any task), and the profiles of installed packages.

    Examples:
        h3data metrics out/demo/episode.mcap
        h3data metrics ds/ --profile field -o metrics.csv
        h3data metrics ds/ --profile my_package.metrics:PROFILE
        h3data metrics ds/ --series rows.parquet --events events.csv
        h3data metrics run_a/ run_b/ --paired
        h3data metrics list
        h3data metrics explain SPS
        h3data metrics explain SPS ds#3
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files, datasets, folders of these, which are searched recursively, or their URIs; or `list`; or
    `explain NAME [RECORDING]`."""
    profile: str | None = None
    """Name of a profile, or module:name (default: the profile of the recordings' task)."""
    paired: bool = False
    """Compare two runs over the same episodes, episode by episode."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result to this file: .json, or one row per episode as .csv or .parquet."""
    series: Path | None = None
    """Also write the per-row quantities and flags from which the metrics are computed to this .parquet or .csv file."""
    events: Path | None = None
    """Also write the spans of rows in which flags hold (found, yields, collision, ...) to this .parquet or .csv
    file.
    """
    workers: int | None = None
    """Number of threads (default: one per core), or of Ray's workers."""
    executor: ExecutorOption = "local"
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the table of metrics, the comparison of two runs, or the explanation of a metric."""
        words = [str(path) for path in self.recordings]
        if words == ["list"]:
            return _list()
        if words[:1] in (["explain"], ["list"]) and not self.recordings[0].exists() and len(words) not in (2, 3):
            raise InputError(
                "Expected `h3data metrics list`, or `h3data metrics explain NAME [RECORDING]`.", code="H3-OPTION-044"
            )
        if words[:1] == ["explain"] and len(words) in (2, 3):
            return _explain(words[1], Path(words[2]) if len(words) == 3 else None, self.profile)
        if not words:
            raise InputError("Expected at least one recording (.mcap) or dataset.", code="H3-METRIC-002")
        for path in (self.out, self.series, self.events):
            if path is not None:
                claim_file(path, force=self.force)
        return self._compare() if self.paired else self._measure()

    def _measure(self) -> Outcome:
        from h3data.metrics.batch import measure_tables
        from h3data.metrics.reading import recordings
        from h3data.recording.finding import find_sources
        from h3data_pipelines.metric_files import write_events, write_series, write_table

        with self._by() as who:
            tables = measure_tables(self.recordings, self.profile, **who)
        first = tables[0]
        if len(tables) > 1 and (self.out or self.series or self.events):
            tasks = ", ".join(f"{t.episodes[0].task} ({len(t)} episodes, profile {t.profile})" for t in tables)
            raise InputError(
                f"A file holds the metrics of one task, these recordings are of several: {tasks}. Name those of one task, "
                "or use --profile task, which measures any.",
                code="H3-OPTION-045",
            )
        if self.out is not None:
            write_table(first, self.out)
        sources = list(find_sources(self.recordings))
        if self.series is not None:
            write_series(recordings(sources, self.profile), self.series, profile=self.profile)
        if self.events is not None:
            write_events(recordings(sources, self.profile), self.events, profile=self.profile)
        exit_code = 1 if first.left_out else 0
        if len(tables) < 2:
            return Outcome(text=first.to_text(), data=first.to_dict(), exit_code=exit_code)
        text = "\n\n".join(f"{t.episodes[0].task}: {len(t)} episodes\n{t.to_text()}" for t in tables)
        data = {"tables": [{"task": t.episodes[0].task, **t.to_dict()} for t in tables]}
        return Outcome(text=text, data=data, exit_code=exit_code)

    @contextmanager
    def _by(self) -> Iterator[dict[str, Any]]:
        """Yield the workers as `h3data.metrics.batch` takes them: threads, which do as well here as processes, or Ray."""
        from h3data.metrics.batch import lost_part

        check_workers(self.executor, self.workers)
        if self.executor == "local":
            yield {"workers": self.workers}
            return
        with opened(self.executor, self.workers or core_count()) as executor:
            yield {"spread": partial(executor.run, lost=lost_part)}

    def _compare(self) -> Outcome:
        from h3data.commands.command import write_text
        from h3data.metrics.batch import measure_files
        from h3data.metrics.differences import compare_tables

        if len(self.recordings) != 2:
            raise InputError(
                f"--paired compares two runs, got {len(self.recordings)}. Example: h3data metrics A B --paired",
                code="H3-OPTION-046",
            )
        if self.out is not None and self.out.suffix != ".json":
            raise InputError(f"A comparison is written as .json, got {self.out.name!r}.", code="H3-OPTION-047")
        if self.series is not None or self.events is not None:
            raise InputError("--series and --events describe one run; leave out --paired.", code="H3-OPTION-048")
        with self._by() as who:
            first, second = (measure_files([path], self.profile, **who) for path in self.recordings)
        a, b = (path.stem or str(path) for path in self.recordings)
        differences = compare_tables(first, second, names=(a, b) if a != b else ("A", "B"))
        if self.out is not None:
            write_text(self.out, differences.to_json() + "\n")
        exit_code = 1 if first.left_out or second.left_out else 0
        return Outcome(text=differences.to_text(), data=differences.to_dict(), exit_code=exit_code)


def _list() -> Outcome:
    from h3data.metrics import all_metrics
    from h3data_pipelines.metric_texts import list_metrics

    return Outcome(text=list_metrics(), data={"metrics": [_described(m) for m in all_metrics()]})


def _explain(name: str, path: Path | None, profile: str | None) -> Outcome:
    from h3data.metrics import find_metric, measure, profiles_named
    from h3data_pipelines.metric_texts import explain, explain_episode

    metric = find_metric(name, profile=profile)
    if profile is None or all(metric not in p.metrics for p in profiles_named(profile)):
        profile = metric.profile
    data: dict[str, Any] = {"metric": _described(metric)}
    if path is None:
        return Outcome(text=explain(metric), data=data)
    recording = open_episode(path)
    text = explain_episode(metric, recording, profile=profile)
    measured = measure(recording, profile).to_dict()
    data |= {
        "episode": measured["episode_id"],
        "value": measured["values"].get(metric.name),
        "note": measured["notes"].get(metric.name),
        "explanation": text,
    }
    return Outcome(text=text, data=data)


_DESCRIBED = (
    "id",
    "name",
    "title",
    "formula",
    "unit",
    "direction",
    "source",
    "columns",
    "optional",
    "undefined",
    "reading",
)


def _described(metric: Metric) -> dict[str, Any]:
    return {name: getattr(metric, name) for name in _DESCRIBED} | {"range": list(metric.range)}
