"""Recordings as a LeRobot v3.0 dataset for training: our dataset with the columns that its policies look for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from h3data.errors import InputError
from h3data.exporters.transitions import transitions_of
from h3data.formats import Exported, ExportRequest
from h3data.recording.parquet.writer import DatasetWriter
from h3data.recording.records import Recording


def write_lerobot(
    recordings: Iterable[Recording], root: str | Path, *, agent: str | None = None, overwrite: bool = False
) -> int:
    """Write a dataset of transitions (`transitions_of`) into a folder; returns the number of episodes.

    Beside the columns of the recording, which stay as they are (docs/format.md) but for ``sim.*`` and ``state_hash`` (the
    simulator's own, and LeRobot's loader fails on unsigned 64-bit numbers), each frame has ``observation.state``
    (the agent's base pose, joints, ...), ``action`` (what it did in that state), ``next.reward``, ``next.done`` and
    ``next.success``. Rows without an action after them, the last of each episode, are left out. Without videos.
    ``recordings`` are gone through twice, first for the widest columns: give a list, not a generator.

    Raises:
        InputError: there is no recording, one has no actions, or it does not fit the dataset.
    """
    first = next(iter(recordings), None)
    if first is None:
        raise InputError("There is no recording to write.")
    fps = round(1e9 / _with_transitions(first, agent).episode.dt_ns)  # refused before a folder is made
    widest = (_with_transitions(recording, agent) for recording in recordings)
    with DatasetWriter(root, fps=fps, overwrite=overwrite, like=widest) as out:
        for recording in recordings:
            out.add(_with_transitions(recording, agent))
        return len(out)


def export_lerobot(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Exports recordings for ``h3data export --to lerobot``."""
    count = write_lerobot(recordings, request.out, agent=request.agent, overwrite=request.force)
    text = f"{request.out}: {count} episode{'s' * (count != 1)} as a LeRobot v3.0 dataset"
    return Exported(text=text, data={"episodes": count})


def _with_transitions(recording: Recording, agent: str | None) -> Recording:
    found = transitions_of(recording, agent=agent)
    steps = len(found)
    done = np.zeros(steps, np.bool_)
    done[-1] = True
    extra = {
        "observation.state": found.flat_state[:-1],
        "action": found.action,
        "next.reward": found.reward,
        "next.done": done,
        "next.success": found.reward > 0,
    }
    names = {"observation.state": list(found.state_names), "action": list(found.action_names)}
    columns = {
        name: values[:-1]
        for name, values in recording.columns.items()
        if values.dtype != np.uint64 and not name.startswith("sim.")
    }
    info = {**recording.episode.info, "lerobot": {"agent": recording.agents[found.agent].name, "names": names}}
    return replace(recording, episode=replace(recording.episode, info=info), columns={**columns, **extra})
