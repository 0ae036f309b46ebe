"""Files that describe episodes to be simulated.

The group ``h3data.episode_files`` provides their readers and writers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.plugins import Registry
from h3data.recording.task_episodes.rearrange_episode import EpisodeSet, RearrangeEpisode
from h3data.recording.task_episodes.stored_rearrangements import EpisodeObject
from h3data.scene.records import Scene
from h3data.scene.sources import SceneSource


@dataclass(frozen=True, kw_only=True)
class EpisodeFiles:
    """Functions for one kind of episode files, and for the objects that their episodes add to scenes."""

    read: Callable[[Path], EpisodeSet]
    """Function that reads the episodes of a file."""
    write: Callable[[EpisodeSet, Path], None]
    """Function that writes episodes to a file."""
    encode: Callable[[RearrangeEpisode], bytes]
    """Function that returns an episode in the form of the file."""
    scene_of: Callable[..., SceneSource]
    """Function that returns the source of an episode's scene. It is called as
    ``(episode, stored, folder, *, assets, allow_missing)`` with an episode from a file in ``folder`` and its
    `StoredEpisode`, or None."""
    add_objects: Callable[
        [Scene, Sequence[EpisodeObject], Sequence[str], Sequence[str]], tuple[Scene, Mapping[str, Array]]
    ]
    """Function that adds objects to a scene. It is called with a scene, an episode's objects, the folders of their
    templates and asset folders; it returns the scene with the objects, and the center of mass [3] [m] of each by name,
    in the axes of its asset. Boxes replace missing templates."""
    stand_ins: Callable[[SceneSource, Sequence[EpisodeObject], Sequence[str]], Sequence[str]]
    """Function that returns messages on objects that are replaced by boxes. It is called with a scene's source, an
    episode's objects and the folders of their templates."""


def _check(entry: Any) -> None:
    if not isinstance(entry, EpisodeFiles):
        raise InputError(
            f"Expected an h3data.recording.task_episodes.episode_files.EpisodeFiles, got {entry!r:.60}.",
            code="H3-RECORDING-128",
        )


@cache
def episode_files() -> EpisodeFiles:
    """Return the kind of episode files that h3data reads and writes: Habitat's files with h3data's records in them.

    Raises:
        InputError: the package that provides it is not installed.
    """
    kinds: Registry[EpisodeFiles] = Registry("h3data.episode_files", {}, what="kind of episode files", check=_check)
    return kinds.get("habitat")
