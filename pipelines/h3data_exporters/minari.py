"""Export of recordings as a Minari dataset for offline reinforcement learning (needs the extra ``h3data[minari]``)."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import InputError, MissingExtraError
from h3data.formats import Exported, ExportRequest
from h3data.recording.records import Recording
from h3data.terminal import counted
from h3data_exporters.transitions import check_alike, observations_of, transitions_of

RULED_ENDS = ("success", "collision", "terminated")
"""Values of ``info["ended"]`` for an episode that its rules ended, which are Minari's terminations; others are
truncations."""


def write_minari(recordings: Iterable[Recording], folder: str | Path, *, agent: str | None = None) -> int:
    """Write the transitions of one agent (`transitions_of`) of each recording as an episode; return their number.

    The name of the folder is the dataset's id, such as ``walks-v0``. An episode of T rows has T observations
    (`observations_of`, a dictionary of float32 arrays), T - 1 actions and rewards, and ``uid``, ``episode_id``,
    ``task``, ``scene`` and ``instruction`` as metadata. An existing dataset in the folder is replaced.

    Raises:
        MissingExtraError: Minari is not installed.
        InputError: the folder's name is not a valid id, there is no recording, one has no actions, or they differ in
            their keys.
    """
    try:
        import minari  # pyright: ignore[reportMissingImports]
        import minari.dataset.minari_storage  # pyright: ignore[reportMissingImports]
        from gymnasium import spaces
    except ImportError:
        raise MissingExtraError(
            'Minari datasets need minari. Hint: pip install "h3data[minari]"', code="H3-EXPORT-040"
        ) from None
    folder = Path(folder)
    if not re.fullmatch(r"[-\w]+-v\d+", folder.name):
        raise InputError(
            "Expected a folder whose name Minari takes as an id: letters, digits, - and _, then -v and a version, such as "
            f"walks-v0. Got: {folder}",
            code="H3-EXPORT-039",
        )
    # recordings may be a generator: the first one is looked at and put back before the others
    rest = iter(recordings)
    if (first := next(rest, None)) is None:
        raise InputError("There is no recording to write.", code="H3-EXPORT-027")
    found = transitions_of(first, agent=agent)

    def box(width: int) -> Any:
        return spaces.Box(-np.inf, np.inf, (width,), np.float32)

    whole, part = folder / "data", folder / "data.part"
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    part.mkdir(parents=True)
    try:
        storage = minari.dataset.minari_storage.MinariStorage.new(
            # Minari puts the folder before the names of its files twice
            part.absolute(),
            observation_space=spaces.Dict(
                {name: box(values.shape[1]) for name, values in observations_of(first, found).items()}
            ),
            action_space=box(found.action.shape[1]),
            data_format="arrow",
        )
        about: list[dict[str, Any]] = []
        storage.update_episodes(_buffers(chain([first], rest), agent, about, minari.data_collector.EpisodeBuffer))
        storage.update_episode_metadata(about)
        storage.update_metadata(
            {
                "dataset_id": folder.name,
                "minari_version": minari.__version__,
                "description": f"Episodes of {first.episode.task}, recorded by {first.episode.created_by}.",
                "action_names": list(found.action_names),
                "state_names": list(found.state_names),
                "control_hz": round(1e9 / first.episode.dt_ns, 6),
            }
        )
        # only now the old one goes, so that a failed export leaves it
        shutil.rmtree(whole, ignore_errors=True)
        part.replace(whole)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return len(about)


def export_minari(recordings: Iterable[Recording], request: ExportRequest) -> Exported:
    """Export recordings for ``h3data export --to minari``."""
    count = write_minari(recordings, request.out, agent=request.agent)
    return Exported(
        text=f"{request.out}: {counted(count, 'episode')} as a Minari dataset with the id {request.out.name}",
        data={"episodes": count, "id": request.out.name},
    )


def _buffers(
    recordings: Iterable[Recording], agent: str | None, about: list[dict[str, Any]], buffer: Any
) -> Iterator[Any]:
    """Yield episodes as Minari stores them, and add what is said about each to ``about``."""
    shapes: dict[str, Any] = {}
    for recording in recordings:
        found = transitions_of(recording, agent=agent)
        observed = observations_of(recording, found)
        check_alike(shapes, {"actions": found.action, **observed}, recording)
        # only the last step ends the episode
        episode, last = recording.episode, np.arange(len(found)) == len(found) - 1
        ruled = episode.info.get("ended") in RULED_ENDS
        about.append(
            {
                "uid": episode.uid,
                "episode_id": episode.episode_id,
                "task": episode.task,
                "scene": episode.scene,
                "instruction": str(episode.info.get("instruction", "")),
            }
        )
        yield buffer(
            seed=episode.seed,
            observations=observed,
            actions=found.action,
            rewards=found.reward,
            terminations=last & ruled,
            truncations=last & (not ruled),
        )
