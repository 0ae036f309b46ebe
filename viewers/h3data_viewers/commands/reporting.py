"""Command ``h3data report``: a self-contained HTML report on datasets, with tables as Markdown and LaTeX on request."""

from __future__ import annotations

import math
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    FailedOption,
    ForceFlag,
    JsonFlag,
    LightOption,
    Outcome,
    PeopleOption,
    StandInsFlag,
    StepsModelOption,
    claim_file,
    write_text,
)
from h3data.commands.executors import ExecutorOption, check_workers, opened
from h3data.commands.options import command_line, command_of
from h3data.errors import InputError, suggest_keywords

if TYPE_CHECKING:
    from typing import Literal

    from h3data.bodies.people.rigid_parts import PeopleStyle
    from h3data.commands.arguments import FilePath, Names, Paths
    from h3data.render.light.sources import LightMode
    from h3data_viewers.html_report.data import Run
    from h3data_viewers.html_report.report import Report


@suggest_keywords
def report(
    datasets: Paths,
    out: FilePath = "report.html",
    *,
    title: str = "",
    markdown: FilePath | None = None,
    latex: FilePath | None = None,
    pictures: int = 6,
    assets: Paths = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    stand_ins: bool = False,
    replays: bool = False,
    unseen_partners: Names = (),
    seeds: Names = (),
    study_model: Literal["auto", "poisson", "observation"] = "auto",
    failed: Literal["leave-out", "limit"] = "leave-out",
    added_time: bool = False,
    workers: int = 1,
    executor: str = "local",
    force: bool = False,
) -> Report:
    """Write a self-contained HTML report on datasets and recordings.

    The arguments are the options of the command ``h3data report``.

    Returns:
        The report: its runs, its tables, and the names of what could not be measured.

    Raises:
        InputError: there is nothing to report on, an option is wrong, or a file exists.
    """
    return result_of(ReportCommand, locals())


@command_of(report)
class ReportCommand:
    """Write a self-contained HTML report: tables next to the paper's, charts, key frames.

    It shows distributions, trajectories, paired differences, and the best and worst episodes.
    Each input is a dataset, a folder of .mcap files or a single .mcap file. Episodes are grouped by policy; runs over the
    same episodes are compared episode by episode. The folder of a run of h3data train adds its learning
    curves, and so does a file learning.csv in a dataset.

    Examples:
        h3data report ds/ -o report.html
        h3data report expert/ random/ still/ -o report.html --latex tables.tex
        h3data report ds/ -o report.html --replays
        h3data report out/nav -o training.html
        h3data report ds/ --markdown tables.md --pictures 0
        h3data report out/zsc --unseen-partners plan_pop_1,plan_pop_2
        h3data report crowd/ --added-time
        h3data report study/ --study-model observation --failed limit
        h3data report runs/ --executor ray --workers 32
    """

    datasets: tyro.conf.Positional[tuple[Path, ...]]
    """Datasets, .mcap files, folders of h3data evaluate, and folders that contain any of these."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """HTML file to write."""
    title: str
    """Title of the report (default: the tasks)."""
    markdown: Path | None
    """Also write the tables to this Markdown file."""
    latex: Path | None
    """Also write the tables to this LaTeX file (needs booktabs)."""
    pictures: int
    """Number of episodes per task shown with key frames."""
    replays: bool
    """Also write an HTML replay of each episode shown with key frames, and link it: REPORT_replays/, 1 to 3 MB each."""
    people: PeopleOption
    light: LightOption
    assets: tuple[Path, ...]
    """Folders to search for recorded asset files (default: H3DATA_ASSETS)."""
    stand_ins: StandInsFlag
    unseen_partners: tuple[str, ...]
    """Partners that no robot was trained with; the heat maps show the mean over them (default: as in the recordings)."""
    seeds: tuple[str, ...]
    """Policies that differ only by their training seed, as a pattern in quotes such as "weights:out/s*/policy.npz":
    they share one row with the mean over seeds and its standard deviation (default: as in the evaluation)."""
    study_model: StepsModelOption
    failed: FailedOption
    added_time: bool
    """Simulate recordings with people of crowds again without robots, and show the delay that robots cause (slow)."""
    workers: int
    """Number of local processes, or of Ray workers, that read and measure the recordings."""
    executor: ExecutorOption
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the report, and its tables as Markdown and LaTeX if asked to."""
        from h3data_viewers.html_report.added_time import added_time_table
        from h3data_viewers.html_report.reading import lost_part
        from h3data_viewers.html_report.report import make_report, replay_folder

        check_workers(self.executor, self.workers)
        if not self.datasets:
            raise InputError("Expected at least one dataset or recording.", code="H3-RENDER-079")
        if self.pictures < 0:
            raise InputError(f"--pictures must not be negative, got {self.pictures}.", code="H3-RENDER-080")
        targets = [path for path in (self.out, self.markdown, self.latex) if path is not None]
        # one would overwrite the other
        if len({path.resolve() for path in targets}) < len(targets):
            raise InputError("-o, --markdown and --latex must be different files.", code="H3-RENDER-081")
        for path in targets:
            claim_file(path, force=self.force)
        if self.replays and self.pictures == 0:
            raise InputError("--replays needs episodes with key frames: leave out --pictures 0.", code="H3-RENDER-082")
        folder = replay_folder(self.out)
        if self.replays and folder.exists() and not self.force:
            raise InputError(
                f"The folder of the replays exists. Use --force to overwrite them, or another -o: {folder}",
                code="H3-RENDER-083",
            )
        with opened(self.executor, self.workers) as executor:
            report = make_report(
                self.datasets,
                title=self.title,
                pictures=self.pictures,
                assets=self.assets,
                people=self.people,
                light=self.light,
                stand_ins=self.stand_ins,
                study_model=self.study_model,
                failed=self.failed,
                unseen_partners=self.unseen_partners,
                seeds=self.seeds,
                more=[added_time_table(self.datasets)] if self.added_time else (),
                replays=folder if self.replays else None,
                spread=partial(executor.run, lost=lost_part),
                command=f"{command_line('report', self)} -o {shlex.quote(self.out.name)}",
            )
        report.write(self.out)
        if self.markdown is not None:
            write_text(self.markdown, report.to_markdown())
        if self.latex is not None:
            write_text(self.latex, report.to_latex())
        # the report is written, but a script should know that episodes are missing
        exit_code = int(bool(report.data.unmeasured))
        return Outcome(
            text=_text(report, [*targets, *report.replays]), data=self._data(report), result=report, exit_code=exit_code
        )

    def _data(self, report: Report) -> dict[str, Any]:
        return {
            "out": str(self.out),
            "bytes": self.out.stat().st_size,
            "title": report.title,
            "runs": [
                {"name": run.name, "policy": run.policy, "task": run.task}
                | {key: run.table.to_dict()[key] for key in ("metrics", "summary")}
                | {"episodes": len(run.episodes)}
                | ({"seeds": _over_seeds(run)} if run.seeds else {})
                for run in report.data.runs
            ],
            "tables": [table.key for table in report.tables],
            "missing": list(report.missing),
            "replays": [str(path) for path in report.replays],
            "unmeasured": {reason: list(names) for reason, names in report.data.unmeasured.items()},
        }


def _over_seeds(run: Run) -> dict[str, Any]:
    """Return the mean and standard deviation over the seeds of a run, by metric; NaN becomes None."""
    known = {name: (found.mean, found.deviation) for name, found in run.means().items()}
    return {
        "policies": list(run.seeds),
        "metrics": {
            name: {"mean": _or_none(mean), "deviation": _or_none(deviation)}
            for name, (mean, deviation) in known.items()
        },
    }


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _text(report: Report, written: list[Path]) -> str:
    runs = [f"  {run.name}: {run.size}, {run.task}" for run in report.data.runs]
    failed = [f"not measured: {len(names)}, {reason}" for reason, names in report.data.unmeasured.items()]
    size = written[0].stat().st_size / 1e6
    return "\n".join([f"{written[0]} ({size:.1f} MB)", *map(str, written[1:]), *runs, *failed])
