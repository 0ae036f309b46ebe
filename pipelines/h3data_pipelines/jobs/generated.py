"""Totals of the episodes of a generated dataset, and a check whether other options would give the same episodes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.storage import AnyPath, RemotePath
from h3data.replay.cameras import split_size
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import is_failed

if TYPE_CHECKING:
    from h3data.metrics import MetricsTable
    from h3data.recording import Dataset, DatasetWriter


@dataclass(frozen=True)
class Generated:
    """Result of generating a dataset."""

    dataset: Dataset
    new: int
    """Number of episodes that this run played; the others existed before it resumed."""
    failed: tuple[str, ...]
    """Episodes that could not be played, with number, seed and error."""
    metrics: MetricsTable
    left_out: tuple[str, ...] = ()
    """Reasons why episodes of an episode file could not be played."""


class WrittenDataset:
    """Episodes of a dataset and their totals, which are read once; missing logs are written on request."""

    def __init__(self, dataset: Dataset, mcap: AnyPath | None, *, share_in: AnyPath | None = None) -> None:
        if isinstance(share_in, RemotePath):
            raise InputError(f"--share-scenes needs a local output folder, got: {share_in}", code="H3-JOB-034")
        self.dataset, self.mcap, self.share_in = dataset, mcap, share_in
        self.hashes: list[str] = []
        self.failed: list[str] = []
        """Episodes that raised an error, with number, seed and error."""
        self.steps = 0

    def __len__(self) -> int:
        return len(self.dataset)

    def __iter__(self) -> Iterator[Recording]:
        from h3data.recording import write_mcap

        for index in range(len(self.dataset)):
            recording = self.dataset.recording(index)
            if self.mcap is not None:
                log = self.mcap / f"{recording.episode.episode_id}.mcap"
                if not log.exists():
                    # over what an interrupted run left of it
                    write_mcap(recording, log, overwrite=True, share_in=self.share_in)
            episode = recording.episode
            if is_failed(recording):
                self.failed.append(f"{episode.episode_id} (seed {episode.seed}): {episode.info['failed']}")
            self.hashes.append(str(recording.columns["state_hash"][-1]) if len(recording) else "")
            self.steps += len(recording)
            yield recording


def first_played(writer: DatasetWriter) -> Recording | None:
    """Return an episode that did not fail, of a dataset that is continued."""
    from h3data.recording import Dataset

    if not len(writer):
        return None
    dataset = Dataset(writer.root)
    return next((r for r in map(dataset.recording, range(len(dataset))) if not is_failed(r)), None)


def whose(job: Job) -> str:
    """Return the name of the set or file from which the episodes come."""
    origin = job.origin
    if origin is None:
        return ""
    if "file" in origin:
        return f" of {origin['file']}"
    label = "/".join(filter(None, (origin["set"], origin["split"])))
    return f" in the scenes of {label}, drawn with seed {origin['seed']}" if origin["seed"] else f" of {label}"


def require_same_options(folder: AnyPath, jobs: Sequence[Job], *, cameras: Sequence[str] = ()) -> None:
    """Raise an error if ``jobs`` would make different episodes or videos than those of a dataset."""
    from h3data.recording import Dataset
    from h3data.recording.parquet.files import shard_files

    if not shard_files(folder, "meta/episodes"):  # new, or killed before the first commit
        return
    dataset = Dataset(folder)
    named = [split_size(name)[0] for name in cameras]
    known = {name.replace("/", ".") for name in named if not name.lower().endswith((".toml", ".json"))}
    if len(dataset) and (len(set(cameras)) != len(dataset.cameras) or not known <= {*dataset.cameras}):
        raise InputError(
            f"Cannot resume with other options: the dataset has videos of {', '.join(dataset.cameras) or 'no camera'}, "
            f"--camera says {', '.join(cameras) or 'none'}. Use the cameras it was started with, or another -o: {folder}",
            code="H3-JOB-033",
        )
    for job, row in zip(jobs, dataset.episodes.to_pylist(), strict=False):
        info, wanted = json.loads(row["info"]), {**job.to_json(), "origin": job.origin}
        was = {**info.get("job", {}), "origin": info.get("origin")}
        differs = _differences(was, wanted)
        if differs:
            raise InputError(
                f"Cannot resume with other options: episode {job.index} of the dataset was made differently "
                f"({'; '.join(differs)}). Use the options it was started with, or another -o: {folder}",
                code="H3-JOB-035",
            )


def _differences(was: Mapping[str, Any], wanted: Mapping[str, Any], group: str = "") -> list[str]:
    """Return the options that have changed, each as ``spec.max_steps was 30, is 60``."""
    found = []
    for name in dict.fromkeys((*wanted, *was)):
        before, value = was.get(name), wanted.get(name)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            found += _differences(before, value, f"{group}{name}.")
        elif before != value:
            found.append(f"{group}{name} was {before}, is {value}")
    return found
