"""Costs of a job on this machine in CPU time, for the forecasts of `h3data plan`."""

from __future__ import annotations

import pickle
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from h3data.errors import InputError

FRAMES = {"robot_arm": "224x171", "human_head": "640x480", "top_down": "576x830"}
"""Cameras whose frames are measured, and their size in a small home [px]."""
_START = "import numba, scipy, pyarrow; from h3data_pipelines.jobs.running import film_job"


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Costs of the parts of a job, in CPU seconds on one core."""

    task: str
    start_s: float
    """Time that a worker needs to start, for Python and its imports, without compilation of kernels [s]."""
    scene_s: float
    """Time to prepare a home that is new to a worker: generation, free space and collision shapes [s]."""
    episode_s: float
    """Time of an episode that does not depend on its length, for starts, paths and records [s]."""
    step_s: float
    """Time of a step of the simulation [s]."""
    steps: float
    """Mean number of steps of an episode."""
    frame_s: dict[str, float]
    """Time to render and encode a frame of each camera in `FRAMES` [s]."""
    metrics_s: float
    """Time to compute the metrics of an episode from a dataset [s]."""
    driver_s: float
    """Time of an episode in the single process that writes: receiving, storing, uncompressed sizes and hashes [s]."""
    episode_bytes: float
    """Size of an episode in a dataset [bytes]."""

    def to_json(self) -> dict[str, Any]:
        """Return all costs by name, for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Any) -> Costs:
        """Read costs from the JSON that ``h3data plan --measure --json`` prints.

        Raises:
            InputError: the values are not costs.
        """
        try:
            return cls(**values["costs"])
        except (TypeError, KeyError):
            raise InputError(
                "Expected costs as `h3data plan TASK --measure --json` prints them.", code="H3-MACHINE-012"
            ) from None


def measure_costs(task: str, *, episodes: int = 4, max_steps: int = 600) -> Costs:
    """Measure a job of ``task`` in homes of the preset small, which takes half a minute.

    CPU time is not wall-clock time: it hardly depends on other processes of this machine.
    """
    from h3data.metrics import measure_files
    from h3data.recording import DatasetWriter
    from h3data_pipelines.jobs.episodes import Choices, make_jobs
    from h3data_pipelines.jobs.running import RenderedVideo, VideoJob, film_job

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", _START], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    start_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    jobs = make_jobs(Choices(task=task, max_steps=max_steps), "small", episodes=episodes + 2, homes=2, seed=0)
    plain = VideoJob((), threads=1)
    film_job(jobs[0], plain)  # the first home, and all kernels of an episode: compiling them is no cost of a job
    second = _cpu(lambda: film_job(_short(jobs[1]), plain))
    again = _cpu(lambda: film_job(_short(jobs[1]), plain))
    filmed: list[RenderedVideo] = []
    took_s = _cpu(lambda: filmed.extend(film_job(job, plain) for job in jobs[2:]))
    lengths = [len(each.recording) for each in filmed]
    step_s = max(took_s - again * len(filmed), 0.0) / max(sum(lengths), 1)

    frame_s = {}
    for camera in FRAMES:
        film_job(_short(jobs[2], 2), VideoJob((camera,), threads=1))  # kernels and textures
        few, many = (
            _cpu(lambda n=n, camera=camera: film_job(_short(jobs[2], n), VideoJob((camera,), threads=1)))
            for n in (2, 42)
        )
        frame_s[camera] = max(many - few - 40 * step_s, 0.0) / 40

    with TemporaryDirectory(prefix="h3data-") as folder:
        sent = [pickle.dumps(each, protocol=5) for each in filmed]

        def write(name: str, times: int) -> None:
            with DatasetWriter(Path(folder, name)) as writer:
                for k in range(times * len(sent)):
                    recording = pickle.loads(sent[k % len(sent)]).recording
                    writer.add(replace(recording, episode=replace(recording.episode, uid=f"{k}", episode_id=f"{k}")))

        write("first", 1)
        few, many = (_cpu(lambda n=n: write(f"of_{n}", n)) for n in (1, 5))
        write_s = (many - few) / (4 * len(sent))
        of_many = Path(folder, "of_5")
        size = sum(path.stat().st_size for path in of_many.rglob("*.parquet")) / (5 * len(sent))
        measure_files([of_many], workers=1)
        metrics_s = _cpu(lambda: measure_files([of_many], workers=1)) / (5 * len(sent))
    return Costs(
        task=task,
        start_s=start_s,
        scene_s=max(second - again, 0.0),
        episode_s=again,
        step_s=step_s,
        steps=sum(lengths) / len(lengths),
        frame_s=frame_s,
        metrics_s=metrics_s,
        driver_s=write_s,
        episode_bytes=size,
    )


def _short(job: Any, steps: int = 1) -> Any:
    return replace(job, spec=replace(job.spec, max_steps=steps))


def _cpu(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began
