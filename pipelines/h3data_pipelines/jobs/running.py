"""Shards that play episodes and optionally render them; errors are listed and do not stop the job."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.commands.executors import Executor
from h3data.errors import InputError, JobStopError
from h3data.recording import Recording
from h3data.render.light.sources import LightMode
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import failed_recording, is_failed

if TYPE_CHECKING:
    from h3data.recording.parquet.videos import EpisodeVideo


def simulate_job(job: Job, *, max_steps: int | None = None) -> Recording:
    """Return the recording of a job's episode, or its `failed_recording` placeholder, in any process.

    ``max_steps`` ends it after its first steps.

    Raises:
        JobStopError: the whole job cannot continue.
    """
    try:
        recording = job.record(max_steps=max_steps)
    except (MemoryError, JobStopError):
        raise
    except Exception as fault:
        recording = failed_recording(job, fault)
    return _with_job(recording, job)


def _with_job(recording: Recording, job: Job) -> Recording:
    """Return the recording with what it was made of."""
    origin = {} if job.origin is None else {"origin": job.origin}
    return with_info(recording, job=job.to_json(), **origin)


def with_info(recording: Recording, **entries: Any) -> Recording:
    """Return a recording with additional entries in its info."""
    return replace(recording, episode=replace(recording.episode, info={**recording.episode.info, **entries}))


@dataclass(frozen=True)
class VideoJob:
    """Videos to render for every episode."""

    cameras: tuple[str, ...]
    threads: int
    """Number of render threads in each process."""
    people: PeopleStyle = "skin"
    light: LightMode = "baked"
    backend: Literal["auto", "cpu", "gpu"] = "cpu"


@dataclass(frozen=True)
class RenderedVideo:
    """Result of a shard, which is one episode with its videos."""

    recording: Recording
    videos: tuple[tuple[EpisodeVideo, bytes], ...] = ()
    """Content and file of each video; the paths are those of the machine that rendered them."""

    @contextmanager
    def video_files(self) -> Iterator[list[EpisodeVideo]]:
        """Provide the videos as files of this machine within a block."""
        if not self.videos:
            yield []
            return
        with TemporaryDirectory(prefix="h3data-", ignore_cleanup_errors=True) as folder:
            files = [replace(video, path=Path(folder, video.path.name)) for video, _ in self.videos]
            for file, (_, data) in zip(files, self.videos, strict=True):
                Path(str(file.path)).write_bytes(data)
            yield files


def film_job(job: Job, filming: VideoJob) -> RenderedVideo:
    """Return the recording of a job's episode (see `simulate_job`) and its videos; a failed episode has no videos.

    Raises:
        InputError: the episode has no such camera.
    """
    recording = simulate_job(job)
    if not filming.cameras or is_failed(recording):
        return RenderedVideo(recording)
    from h3data.replay.camera_videos import render_videos
    from h3data.replay.stage import chosen_backend

    # that of this machine: a resumed run goes on with it
    drawn_by = chosen_backend(filming.backend)
    with TemporaryDirectory(prefix="h3data-", ignore_cleanup_errors=True) as folder:
        try:
            videos = render_videos(
                recording,
                filming.cameras,
                Path(folder),
                threads=filming.threads,
                people=filming.people,
                light=filming.light,
                backend=drawn_by,
            )
        except InputError as error:
            raise InputError(f"Episode {job.index}: {error}", code=error.code) from None
        made_by = {} if drawn_by == "cpu" else {"backend": drawn_by}
        recording = with_info(recording, light=filming.light, **made_by)
        return RenderedVideo(recording, tuple((video, Path(str(video.path)).read_bytes()) for video in videos))


def film_jobs(jobs: Sequence[Job], *, filming: VideoJob, executor: Executor) -> Generator[RenderedVideo]:
    """Yield recordings and their videos in the order of ``jobs``; an episode whose workers all die counts as failed."""
    yield from executor.run(
        partial(film_job, filming=filming),
        jobs,
        lost=lambda job, fault: RenderedVideo(_with_job(failed_recording(job, fault), job)),
    )
