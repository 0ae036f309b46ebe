"""Export of recordings as demonstrations in a robomimic HDF5 file (needs the extra ``h3data[robomimic]``)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import InputError, MissingExtraError
from h3data.files import part_file, size_text
from h3data.formats import Exported, ExportRequest
from h3data.recording.records import Recording
from h3data.terminal import counted
from h3data_exporters.transitions import Transitions, check_alike, observations_of, transitions_of


def write_robomimic(recordings: Iterable[Recording], path: str | Path, *, agent: str | None = None) -> int:
    """Write the transitions of one agent of each recording as ``data/demo_<n>``, and return their number.

    A demo holds ``actions`` [N, A], ``rewards``, ``dones`` (1 at the last step), ``states`` and the groups ``obs`` and
    ``next_obs`` with the same keys: the agent's own state (``base_pose``, ``joint_pos``, ...), ``object_pose`` (zeros
    for absent bodies), and the pose ``agent_<i>.base_pose`` of every other agent. Transitions are those of
    `transitions_of`. Actions keep their units. Robomimic needs -1..1 for training, so normalise there
    (``action_config``).

    Raises:
        MissingExtraError: h5py is not installed.
        InputError: there is no recording, one has no actions, or they differ in their keys.
    """
    try:
        import h5py
    except ImportError:
        raise MissingExtraError(
            'Robomimic files need h5py. Hint: pip install "h3data[robomimic]"', code="H3-EXPORT-033"
        ) from None
    path = Path(path)
    if path.suffix not in (".hdf5", ".h5"):
        raise InputError(f"Expected a file that ends in .hdf5, got: {path}", code="H3-EXPORT-031")
    count = total = 0
    shapes: dict[str, Any] = {}
    # appears whole: a reader must not meet half of the demonstrations
    with part_file(path) as part, h5py.File(part, "w") as file:
        data = file.create_group("data")
        for recording in recordings:
            found = transitions_of(recording, agent=agent)
            observed = observations_of(recording, found)
            check_alike(shapes, {"actions": found.action, **observed}, recording)
            _add_demo(data.create_group(f"demo_{count}"), recording, found, observed)
            if not count:
                data.attrs["env_args"] = json.dumps(_env_args(recording, found))
            count, total = count + 1, total + len(found)
        if not count:
            raise InputError("There is no recording to write.", code="H3-EXPORT-027")
        data.attrs["total"] = total
        names = np.array([f"demo_{k}" for k in range(count)], dtype="S")
        # robomimic takes the demonstrations of a run from such a list
        file.create_group("mask").create_dataset("train", data=names)
    return count


def export_robomimic(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export recordings for ``h3data export --to robomimic``."""
    count = write_robomimic(recordings, request.out, agent=request.agent)
    size = request.out.stat().st_size
    text = f"{request.out}: {counted(count, 'demonstration')}, {size_text(size)}"
    return Exported(text=text, data={"demonstrations": count, "bytes": size})


def _add_demo(group: Any, recording: Recording, found: Transitions, observed: dict[str, np.ndarray]) -> None:
    steps = len(found)
    done = np.zeros(steps, np.int64)
    done[-1] = 1
    group.attrs["num_samples"] = steps
    group.attrs["uid"] = recording.episode.uid
    group.attrs["episode_id"] = recording.episode.episode_id
    # gzip, which every build of HDF5 reads; shuffled, as bytes of similar floats are alike
    options = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    group.create_dataset("actions", data=found.action, **options)
    group.create_dataset("rewards", data=found.reward)
    group.create_dataset("dones", data=done)
    group.create_dataset("states", data=found.flat_state[:-1], **options)
    # row t and the one after it: an episode of T rows has T - 1 transitions
    for name, rows in (("obs", slice(None, -1)), ("next_obs", slice(1, None))):
        inner = group.create_group(name)
        for key, values in observed.items():
            inner.create_dataset(key, data=values[rows], **options)


def _env_args(recording: Recording, found: Transitions) -> dict[str, Any]:
    episode = recording.episode
    return {
        "env_name": episode.task,
        "type": 1,
        "env_version": episode.schema_version,
        "env_kwargs": {
            "control_hz": round(1e9 / episode.dt_ns, 6),
            "scene": episode.scene,
            "action_names": list(found.action_names),
            "state_names": list(found.state_names),
            "moving_bodies": [b.name for b in recording.moving_bodies],
            "agents": [a.name for a in recording.agents],
        },
    }
