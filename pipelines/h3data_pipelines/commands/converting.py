"""Command ``h3data convert``, which converts MCAP logs to a Parquet dataset and back without loss."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, ShareScenesFlag, claim_file, claim_folder
from h3data.commands.executors import ExecutorOption, check_workers, opened
from h3data.errors import H3DataError, InputError
from h3data.progress import progress
from h3data.recording.episodes import StoredEpisode, common_cameras
from h3data.recording.finding import find_episodes
from h3data.recording.storage import AnyPath, place
from h3data.terminal import counted
from h3data_pipelines.dataset_folders import remove_dataset, unfinished_dataset, uninterrupted
from h3data_pipelines.jobs.episode_parts import EpisodePart, episode_parts

if TYPE_CHECKING:
    from h3data.recording import DatasetWriter, Recording

_TOGETHER = 8
"""Number of episodes of a shard."""


@dataclass(frozen=True)
class Convert:
    """Convert recordings between the session log (MCAP) and the dataset (Parquet, LeRobot v3 layout), without loss.

    OUT determines the direction. OUT.mcap becomes one log. A folder becomes a dataset if the input consists of logs,
    and a folder of logs if the input is a dataset.

    Examples:
        h3data convert recordings/ ds/
        h3data convert ds/ logs/
        h3data convert ds#3 episode.mcap
        h3data convert recordings/ ds/ --resume
        h3data convert ds/ s3://bucket/ds
        h3data convert hitl_sessions/ ds/ --nominal-fps 30 --check
    """

    source: tyro.conf.Positional[Path]
    """An .mcap file, a dataset, one of its episodes (ds#3), or a folder of these, searched recursively; or a URI."""
    out: tyro.conf.Positional[Path]
    """An .mcap file or a folder, or a URI: s3://bucket/ds."""
    to: Literal["auto", "mcap", "dataset"] = "auto"
    """Format of the recordings in the output folder, if it does not follow from the input."""
    nominal_fps: int | None = None
    """Steps per second of LeRobot's time stamps in a dataset of episodes with different or irregular rates. The true
    times remain in time_ns (default: the rate of the first episode, which all episodes must have).
    """
    share_scenes: ShareScenesFlag = False
    workers: int = 1
    """Number of processes that write logs; a dataset is always written by one process."""
    executor: ExecutorOption = "local"
    check: bool = False
    """Read everything back and compare it with the input bit for bit."""
    resume: bool = False
    """Continue an interrupted conversion of the same input; finished output is kept."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Convert the recordings, with ``workers`` processes, and return the number of episodes and files."""
        if self.force and self.resume:
            raise InputError("Choose one: --resume continues the output, --force replaces it.", code="H3-OPTION-022")
        if self.nominal_fps is not None and not 1 <= self.nominal_fps <= 1000:
            raise InputError(
                f"--nominal-fps must be at least 1 and at most 1000, got {self.nominal_fps}.", code="H3-OPTION-023"
            )
        check_workers(self.executor, self.workers)
        sources = find_episodes([self._source])
        if self._out.suffix == ".mcap" and not self._out.is_dir():
            if len(sources) != 1 or self.to == "dataset":
                raise InputError(
                    f"{len(sources)} episodes cannot become one .mcap file. Name a folder instead: {self._out}",
                    code="H3-OPTION-026",
                )
            return self._report([self.log(sources[0], self._out)], "mcap")
        self._refuse_itself()
        to = self.to
        if to == "auto":
            of_datasets = {source.index is not None or "#" in source.name for source in sources}
            if len(of_datasets) > 1:
                raise InputError(
                    "The input holds logs and datasets. Choose the output: --to mcap or --to dataset.",
                    code="H3-OPTION-027",
                )
            to = "mcap" if of_datasets.pop() else "dataset"
        return self._report(self._dataset(sources) if to == "dataset" else self._logs(sources), to)

    @property
    def _source(self) -> AnyPath:
        return place(self.source)

    @property
    def _out(self) -> AnyPath:
        return place(self.out)

    def _refuse_itself(self) -> None:
        """Refuse an output inside the input, which would be read too, and one around it, which would be replaced."""
        source, out = (Path(os.path.abspath(p)) if isinstance(p, Path) else p for p in (self._source, self._out))
        if out == source or source in out.parents or out in source.parents:
            raise InputError(
                f"One of input and output contains the other; choose another output folder: {self._out}",
                code="H3-OPTION-024",
            )

    # --- to logs --------------------------------------------------------------------------------------------------
    def _logs(self, sources: list[StoredEpisode]) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        parts = episode_parts([self._source], together=_TOGETHER)
        with opened(self.executor, self.workers) as executor:
            if not self.resume:
                claim_folder(self._out, force=self.force, unfinished=self._unfinished_logs)
            shards = executor.run(partial(write_logs, self), parts, lost=partial(_lost_logs, self), writes=True)
            with progress(total=len(sources), desc="convert", unit="episode") as bar, closing(shards) as results:
                for of_part in results:
                    rows += of_part
                    bar.update(len(of_part))
        return rows

    def _unfinished_logs(self) -> str:
        found = sum(path.suffix == ".mcap" for path in self._out.rglob("*"))
        return counted(found, "finished log") if found else ""

    def target(self, source: StoredEpisode) -> AnyPath:
        """Return the path of a log in the output folder, which mirrors its path in the input.

        Episode 3 of a dataset becomes ``DATASET/000003.mcap``.
        """
        if not self._source.is_dir():
            return self._out / f"{source.path.name.removesuffix('.mcap').replace('#', '_')}.mcap"
        at = self._out / source.path.relative_to(self._source)  # type: ignore[arg-type] - both lie in the same place
        return at if source.index is None else at / f"{source.index:06d}.mcap"

    def log(self, source: StoredEpisode, target: AnyPath) -> dict[str, Any]:
        """Write an episode as a log, and return a row with the result."""
        from h3data.recording import write_mcap

        row: dict[str, Any] = {"source": source.name, "recording": str(target)}
        try:
            if self.resume and target.is_file():  # only complete files have this name
                if source.read().episode.uid != _read_log(target).episode.uid:
                    raise InputError(
                        f"This is another episode. --resume needs the same input: {target}", code="H3-OPTION-028"
                    )
                return {**row, "status": "kept"}
            recording = source.read()
            claim_file(target, force=self.force)
            write_mcap(recording, target, overwrite=self.force or self.resume, share_in=self._shared_in(target))
            if self.check:
                _require_equal(recording, _read_log(target), target)
        except H3DataError as error:
            return {**row, "status": "failed", "reason": str(error), "code": error.code}
        return {**row, "status": "converted", "steps": len(recording)}

    def _shared_in(self, target: AnyPath) -> Path | None:
        """Return the folder whose recordings share their scenes, if they do."""
        folder = target.parent if target == self._out else self._out
        if self.share_scenes and not isinstance(folder, Path):
            raise InputError(f"--share-scenes needs a local output folder, got: {self._out}", code="H3-OPTION-025")
        return folder if self.share_scenes and isinstance(folder, Path) else None

    # --- to a dataset ---------------------------------------------------------------------------------------------
    def _dataset(self, sources: list[StoredEpisode]) -> list[dict[str, Any]]:
        from h3data.recording import Dataset, DatasetWriter

        rate = _steps_per_second(sources) if self.nominal_fps is None else self.nominal_fps
        if self.force:
            remove_dataset(self._out)
        if not self.resume:
            claim_folder(self._out, force=False, unfinished=lambda: unfinished_dataset(self._out))
        begun = self.resume and (self._out / "h3" / "schema.json").is_file()
        like, nominal = () if begun else _readable(sources), self.nominal_fps is not None
        cameras = common_cameras(sources)
        rows = []
        with DatasetWriter(self._out, resume=self.resume, fps=rate, nominal_fps=nominal, like=like) as writer:
            done = {e["uid"]: k for k, e in enumerate(Dataset(self._out).rows)} if len(writer) else {}
            for source in progress(sources, desc="convert", unit="episode"):
                row = self._add(source, writer, done, cameras)
                rows.append({"source": source.name, **row})
        if self.check:
            self._compare(sources, rows)
        return rows

    def _compare(self, sources: list[StoredEpisode], rows: list[dict[str, Any]]) -> None:
        """Read every episode of the dataset back; one that differs from its source has failed."""
        from h3data.recording import Dataset

        dataset = Dataset(self._out)
        for source, row in zip(sources, progress(rows, desc="compare", unit="episode"), strict=True):
            if row["status"] == "failed":
                continue
            index = int(row["recording"].rpartition("#")[2])
            try:
                _require_equal(source.read(), dataset.recording(index), self._out)
            except H3DataError as error:
                row |= {"status": "failed", "reason": str(error), "code": error.code}

    def _add(
        self, source: StoredEpisode, writer: DatasetWriter, done: dict[str, int], cameras: Sequence[str]
    ) -> dict[str, Any]:
        try:
            recording = source.read()
            index = done.get(recording.episode.uid)
            if index is not None:
                return {"status": "kept", "recording": f"{self._out}#{index}"}
            with uninterrupted():
                index = writer.add(
                    recording, videos=[video for video in source.read_videos() if video.feature.camera in cameras]
                )
        except H3DataError as error:
            return {"status": "failed", "reason": str(error), "code": error.code}
        return {"status": "converted", "recording": f"{self._out}#{index}", "steps": len(recording)}

    # --- result ---------------------------------------------------------------------------------------------------
    def _report(self, rows: list[dict[str, Any]], to: str) -> Outcome:
        if len(rows) == 1 and rows[0]["status"] == "failed":
            raise InputError(rows[0]["reason"], code=rows[0]["code"])
        count = {status: sum(r["status"] == status for r in rows) for status in ("converted", "kept", "failed")}
        lines = [f"failed {row['source']}: {row['reason']}" for row in rows if row["status"] == "failed"]
        checked = ", compared bit for bit" if self.check else ""
        lines.append(
            f"{self._out}: {count['converted']} episodes converted{checked}, {count['kept']} kept, {count['failed']} failed"
        )
        data = {"out": str(self._out), "to": to, "checked": self.check, **count, "episodes": rows}
        return Outcome(text="\n".join(lines), data=data, exit_code=1 if count["failed"] else 0)


def write_logs(command: Convert, part: EpisodePart) -> list[dict[str, Any]]:
    """Write the episodes of one part of the job as logs.

    Logs that an earlier attempt at the same part has finished are not written again.
    """
    command = command if command.force else replace(command, resume=True)
    return [command.log(source, command.target(source)) for source in part.sources()]


def _lost_logs(command: Convert, part: EpisodePart, error: H3DataError) -> list[dict[str, Any]]:
    return [
        {
            "source": source.name,
            "recording": str(command.target(source)),
            "status": "failed",
            "reason": str(error),
            "code": error.code,
        }
        for source in part.sources()
    ]


def _read_log(path: AnyPath) -> Recording:
    from h3data.recording import read_mcap

    return read_mcap(path)


def _require_equal(recording: Recording, stored: Recording, path: AnyPath) -> None:
    from h3data.recording import recordings_equal

    differences = recordings_equal(recording, stored)
    if differences:
        raise H3DataError(
            f"The output differs from the input: {'; '.join(differences[:4])}: {path}", code="H3-OPTION-021"
        )


def _readable(sources: list[StoredEpisode]) -> Iterator[Recording]:
    """Yield every readable episode, to fix the columns of a dataset; `Convert._add` reports the others."""
    for source in progress(sources, desc="read", unit="episode"):
        with suppress(H3DataError):
            yield source.read()


def _steps_per_second(sources: list[StoredEpisode]) -> int:
    """Return the rate of the first readable episode; raise an `InputError` if there is none."""
    errors = []
    for source in sources:
        try:
            return max(1, round(1e9 / max(source.read().episode.dt_ns, 1)))
        except H3DataError as error:
            errors.append(error)
    several = f"None of {len(sources)} episodes can be read. The first: " if len(sources) > 1 else ""
    raise InputError(f"{several}{errors[0]}", code="H3-OPTION-020")
