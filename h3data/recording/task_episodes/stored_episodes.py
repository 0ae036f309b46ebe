"""Complete episodes in Habitat's files.

Values that Habitat would sample are in ``info["h3data"]``, which it ignores.
"""

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
"""Start ``(x, z, heading)`` of an agent: its position on the floor [m], and its heading [rad] as in
`h3data.geometry`."""
Record = TypeVar("Record", bound=msgspec.Struct)


class StoredEpisode(Protocol):
    """Base of the episode records of all tasks, with their common fields."""

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
        """Source of the scene: a generator and its seed, or a file; empty if the episode's file names the scene."""
        ...


def start_fields(start: Start, floor_y: float) -> dict[str, Any]:
    """Return the start of an agent in Habitat's fields.

    Habitat's agents look along -Z in their own frame, h3data's along +X.
    """
    x, z, heading = start
    rotation = quat_from_heading(heading - math.pi / 2)
    return {"start_position": (x, floor_y, z), "start_rotation": tuple(float(part) for part in rotation)}


def info_block(task: str, record: StoredEpisode) -> dict[str, Any]:
    """Return the ``info`` of a Habitat episode that contains a record of a task."""
    return {KEY: {"task": task, "version": VERSION, **plain(msgspec.to_builtins(record))}}


def task_of(episode: RearrangeEpisode) -> str | None:
    """Return the task of the record in an episode, or None if it has no record."""
    block = episode.info.get(KEY)
    task = block.get("task") if isinstance(block, dict) else None
    return task if isinstance(task, str) else None


def read_info_block(episode: RearrangeEpisode, task: str, kind: type[Record]) -> Record | None:
    """Return the record of a task in an episode, or None if it has no record of this task.

    Raises:
        FormatError: the record is damaged or from a newer version.
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
    """Convert a value to the form in which it is read back from JSON, with lists for tuples.

    Raises:
        InputError: the value cannot be stored in JSON.
    """
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as fault:
        raise InputError(
            f"Expected rules and a scene source that JSON can hold: {fault}", code="H3-HABITAT-047"
        ) from None
