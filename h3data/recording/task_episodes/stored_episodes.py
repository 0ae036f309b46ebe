"""Complete episodes in Habitat's files: what Habitat samples is in ``info["h3data"]``, which it does not read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

import msgspec

from h3data.errors import FormatError, InputError
from h3data.geometry import quat_from_heading
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode

KEY = "h3data"
VERSION = 1
"""Version of the record. A reader refuses a higher one; added fields do not raise it."""

Start = tuple[float, float, float]
"""Start ``(x, z, heading)``: the root on the floor [m], heading [rad] as in `h3data.geometry`."""
Record = TypeVar("Record", bound=msgspec.Struct)


class StoredEpisode(Protocol):
    """Fields that the episode records of all tasks have."""

    @property
    def seed(self) -> int:
        """Seed of all random choices that are not in the record."""
        ...

    @property
    def scene_sha256(self) -> str:
        """Digest of the scene (`h3data.scene.scene_digest`), which identifies the home; empty if unknown."""
        ...

    @property
    def scene_source(self) -> Mapping[str, Any]:
        """Source of the scene: a generator and its seed, or a file; empty if it is the scene that the episode's file names."""
        ...


def start_fields(start: Start, floor_y: float) -> dict[str, Any]:
    """Return the start of an agent in Habitat's own fields. Its agents look along -Z in their own frame, ours along +X."""
    x, z, heading = start
    rotation = quat_from_heading(heading - math.pi / 2)
    return {"start_position": (x, floor_y, z), "start_rotation": tuple(float(part) for part in rotation)}


def info_block(task: str, record: StoredEpisode) -> dict[str, Any]:
    """Return the ``info`` of a Habitat episode that carries a record of a task."""
    return {KEY: {"task": task, "version": VERSION, **plain(msgspec.to_builtins(record))}}


def task_of(episode: RearrangeEpisode) -> str | None:
    """Return the task of the record that an episode carries; None if it carries none."""
    block = episode.info.get(KEY)
    task = block.get("task") if isinstance(block, dict) else None
    return task if isinstance(task, str) else None


def read_info_block(episode: RearrangeEpisode, task: str, kind: type[Record]) -> Record | None:
    """Return the record of a task that an episode carries; None if it carries none of this task.

    Raises:
        FormatError: it is damaged or from a newer version.
    """
    if task_of(episode) != task:
        return None
    block, where = episode.info[KEY], f"episode {episode.episode_id!r}: info.{KEY}"
    version = block.get("version")
    # not isinstance, for which True is a number
    if type(version) is not int or version > VERSION:
        raise FormatError(
            f"{where}: Expected version {VERSION}, got {version!r}. Hint: a newer h3data reads it.",
            code="H3-HABITAT-045",
        )
    try:
        return msgspec.convert(block, kind)
    except msgspec.ValidationError as fault:
        raise FormatError(f"{where}: {str(fault).replace('`', '')}", code="H3-HABITAT-046") from None


def plain(value: Any) -> Any:
    """Return the value in the form in which a file returns it: lists for tuples.

    Raises:
        InputError: JSON cannot hold it.
    """
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as fault:
        raise InputError(
            f"Expected rules and a scene source that JSON can hold: {fault}", code="H3-HABITAT-047"
        ) from None
