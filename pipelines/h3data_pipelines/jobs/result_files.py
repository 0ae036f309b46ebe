"""Results of evaluations in a folder, with one small file per episode.

An interrupted evaluation of any kind continues with the first episode that has no file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol, TypeVar

from h3data.commands.command import claim_folder, keeping, write_text
from h3data.commands.executors import check_workers, opened
from h3data.errors import FormatError, InputError, JobStopError
from h3data.terminal import counted
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import stopped_job

RESULTS = "episodes"


class EpisodeJob(Protocol):
    """Job that evaluates something in one episode."""

    @property
    def base(self) -> Job:
        """Episode to play."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return all values that determine the results, which are stored with them as ``job`` and ``episode``."""
        ...


J = TypeVar("J", bound=EpisodeJob)
R = TypeVar("R")


def check_options(*, resume: bool, force: bool, workers: int, executor: str) -> None:
    """Check options before an evaluation starts.

    Raises:
        InputError: the executor or number of workers is invalid, or both ``resume`` and ``force`` are set.
    """
    check_workers(executor, workers)
    if force and resume:
        raise InputError("Choose one: --resume goes on with an evaluation, --force replaces it.", code="H3-JOB-043")


def results_of(
    jobs: Sequence[J],
    out: Path,
    work: Callable[[J], R],
    *,
    lost: Callable[[J, Exception], R],
    store: Callable[[R], dict[str, Any]],
    prepare: Callable[[], None] = lambda: None,
    is_whole: Callable[[J], bool] = lambda job: True,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    executor: str = "local",
    progress: Callable[..., Any] | None = None,
) -> tuple[list[dict[str, Any]], int]:
    """Return the results of all jobs, in order, and the number of new results; existing results are not computed again.

    Args:
        jobs: Jobs, one for each episode.
        out: A new folder, or the folder of an interrupted evaluation with the same options.
        work: Function that plays one job, in another process.
        lost: Function that returns the result of a job whose process died.
        store: Function that stores the data of a result outside its file, and returns the contents of the file.
        prepare: Function that is called when the folder exists.
        is_whole: Function that returns whether the data that ``store`` has written for a job exists.
        resume, force, workers, executor, progress: Options of `h3data_pipelines.jobs.evaluation_runs.evaluate_task`.

    Raises:
        InputError: the folder holds results of other options, or other files.
        FormatError: a file among the results is not a result.
        JobStopError: the whole job cannot continue; the results so far are kept.
    """
    folder = out / RESULTS
    if resume and not folder.is_dir():
        raise InputError(
            f"There is no evaluation to go on with; leave out --resume, or check -o: {out}", code="H3-JOB-044"
        )
    files = {job.base.index: folder / f"{job.base.index:06d}.json" for job in jobs}
    with opened(executor, workers) as workforce:  # first: where nobody can work, nothing is deleted or written
        claim_folder(out, force=force or folder.is_dir())  # with episodes/ it is an evaluation to go on with
        folder.mkdir(exist_ok=True)
        if force:
            for file in folder.glob("[0-9]*.json"):
                file.unlink()
        prepare()
        wanted = [job for job in jobs if not (_is_done(files[job.base.index], job) and is_whole(job))]
        bar = (progress or NoProgress)(
            total=len(jobs), initial=len(jobs) - len(wanted), desc="evaluate", unit="episode"
        )
        with (
            keeping(lambda: _kept(files.values(), out)),
            bar,
            closing(workforce.run(work, wanted, lost=lost)) as results,
        ):
            new = 0
            try:
                for result in results:
                    stored = store(result)
                    write_text(files[stored["job"]["episode"]["index"]], json.dumps(stored) + "\n")
                    new += 1
                    bar.update()
            except JobStopError as stop:
                raise stopped_job(stop, [job.base.index for job in wanted[new:]]) from None
    return [json.loads(files[job.base.index].read_text(encoding="utf-8")) for job in jobs], len(wanted)


def _kept(files: Iterable[Path], out: Path) -> str:
    done = sum(file.is_file() for file in files)
    return f"results of {counted(done, 'episode')} in {out}: the same command goes on"


def write_table(out: Path, text: str, data: dict[str, Any]) -> None:
    """Write the table of all results as text and as JSON."""
    write_text(out / "table.txt", text + "\n")
    write_text(out / "table.json", json.dumps(data, indent=2) + "\n")


class NoProgress:
    """A progress bar that shows nothing."""

    def __init__(self, **_options: object) -> None: ...

    def __enter__(self) -> NoProgress:
        return self

    def __exit__(self, *_error: object) -> None: ...

    def update(self) -> None:
        """Count one more episode."""


def _is_done(file: Path, job: EpisodeJob) -> bool:
    """Return whether the results of this very job are there, none of them failed; others' are refused."""
    if not file.is_file():
        return False
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        was, failed = found["job"], found["failed"]
    except (ValueError, KeyError, TypeError):
        raise FormatError(
            f"This is no result of h3data evaluate. Remove it, or choose another -o: {file}", code="H3-JOB-046"
        ) from None
    if was != job.to_json():
        raise InputError(
            f"The folder holds results with other options. Use the same ones, --force, or another -o: {file}",
            code="H3-JOB-045",
        )
    return not failed
