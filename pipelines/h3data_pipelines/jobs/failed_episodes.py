"""Placeholders for episodes that raised an error, so that a job continues and its dataset states the reason."""

from __future__ import annotations

import json
import traceback
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from h3data.errors import H3DataError, JobStopError, with_code
from h3data.recording import AssetRef, Body, Episode, Recording
from h3data.terminal import counted

if TYPE_CHECKING:
    from h3data_pipelines.jobs.episodes import Job

MOST_LISTED = 20


def reason_of(fault: Exception) -> str:
    """Return one line about an error with its code, and for unexpected errors with the code location."""
    if isinstance(fault, H3DataError):
        return " ".join(with_code(fault).split())
    frame = traceback.extract_tb(fault.__traceback__)[-1]
    return f"{type(fault).__name__}: {fault} ({Path(frame.filename).name}, line {frame.lineno})"


def failed_recording(job: Job, fault: Exception) -> Recording:
    """Return the placeholder of a failed job, without agents and rows, and with the error in ``info["failed"]``."""
    name = f"h3data:failed:{json.dumps(job.to_json())}"
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid5(uuid.NAMESPACE_URL, name)),
            episode_id=f"{job.index:06d}",
            task=job.found_task.name,
            scene=job.scene,
            seed=job.seed,
            info={"failed": reason_of(fault)},
        ),
        columns={"time_ns": np.zeros(0, np.int64)},
    )


def stopped_job(stop: JobStopError, left: Sequence[int]) -> JobStopError:
    """Return the error of a job that cannot continue, with the numbers of the remaining episodes."""
    more = f" and {len(left) - MOST_LISTED} more" if len(left) > MOST_LISTED else ""
    listed = ", ".join(map(str, left[:MOST_LISTED])) + more
    return JobStopError(f"{stop} Not played: {counted(len(left), 'episode')} ({listed}).", code=stop.code)


def is_failed(recording: Recording) -> bool:
    """Return whether a recording is the placeholder of an episode that raised an error."""
    return "failed" in recording.episode.info


def beside(failed: Recording, played: Recording) -> Recording:
    """Return a failed episode without rows, with the agents, roles and columns of ``played``.

    Both can then be in one dataset.
    """
    columns = {name: array[:0] for name, array in played.columns.items()}
    nowhere = np.full(7, np.nan, np.float32)
    moving = columns["object_pose"].shape[1] if "object_pose" in columns else 0
    bodies = [Body(name=f"object_{k}", asset="unknown", pose=nowhere, moving=k) for k in range(moving)]
    roles = {
        name: value
        for name, value in played.episode.info.items()
        if name in ("policy", "partner", "max_steps", "profile")
    }
    return replace(
        failed,
        episode=replace(failed.episode, info={**roles, **failed.episode.info}),
        agents=tuple(replace(agent, model="") for agent in played.agents),
        assets=(AssetRef(name="unknown", uri="primitive:none"),) if bodies else (),
        bodies=tuple(bodies),
        columns=columns,
    )
