"""Lookup of scenes by name: a generated home, a scene of a set, or a file."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError, did_you_mean
from h3data.scene.scene_sets import builtin_sets, find_scene_set
from h3data.scene.sources import (
    SceneFile,
    SceneSource,
    missing_packages,
    reader_of,
    scene_generators,
    scene_of,
    scene_readers,
)

if TYPE_CHECKING:
    from h3data.scene.freespace.free_space import FreeSpace
    from h3data.scene.records import Scene


@dataclass(frozen=True, kw_only=True)
class NamedScene:
    """A scene that can be loaded, and its name on the command line."""

    name: str
    """Name of the scene, such as ``small:3`` or ``h3-homes/test#3``, or a path."""
    source: SceneSource
    id: str = ""
    """Id of the scene, if it is part of a set."""


def named_scenes(
    text: str,
    *,
    homes: int = 4,
    assets: Sequence[str | Path] = (),
    strict: bool = False,
    allow_missing: bool = False,
) -> tuple[NamedScene, ...]:
    """Return the scenes with a name; the other options are those of `SceneFile`.

    ``small`` (a preset: its first ``homes`` homes), ``small:3``, ``small2:3`` (second generation), ``small-open:3``
    (furniture opens), ``small2-storeys:3`` (two storeys), ``small2-doors:3`` (doors between rooms), ``h3-homes/test``
    or ``my.toml`` (all of a set), ``h3-homes/test#3`` or ``h3-homes/test#test_03`` (one of a set), or the path of a
    scene: GLB, or a file that an installed package reads. A ``.scene_dataset_config.json`` of Habitat is all its
    scenes, followed by ``#name`` one of them.

    Raises:
        InputError: there is no such scene; the message lists those that exist.
        FormatError: the file of a scene set has errors.
    """
    found = _named(text, homes)
    folders = tuple(str(folder) for folder in assets)
    options = {"assets": folders, "strict": strict, "allow_missing": allow_missing}
    return tuple(
        replace(n, source=replace(n.source, **options)) if isinstance(n.source, SceneFile) else n for n in found
    )


def is_builtin_name(text: str) -> bool:
    """Return whether a text names generated homes (``small:3``) or a set of scenes, one of which may follow ``#``."""
    if _generated(text, 1):
        # a file of this name comes first, as for everything that takes a path or a name
        return not Path(text).exists()
    label = text.partition("#")[0]
    return any(label in (name, *(f"{name}/{split}" for split in of)) for name, of in builtin_sets().items())


def preset_names() -> list[str]:
    """Return the names of presets of generated scenes, such as ``small``, each with one scene per seed."""
    return [name for generator in scene_generators().values() for name in generator.names]


def is_collection(path: str) -> bool:
    """Return whether a path has the suffix of files that hold several scenes."""
    return any(reader.collection and path.endswith(reader.collection) for reader in scene_readers())


def collection_and_scene(path: str | os.PathLike[str]) -> tuple[Path | None, str | None]:
    """Split ``x.scene_dataset_config.json#scene`` into file and scene; return (None, None) for other paths."""
    for reader in scene_readers():
        before, mark, scene = os.fspath(path).rpartition(f"{reader.collection}#")
        if reader.collection and mark:
            return Path(before + reader.collection), scene
    return None, None


def open_scene_path(path: str) -> Any:
    """Return the scene in a file, or the collection if it holds several.

    The result is None if the path does not have the suffix of a scene file.

    Raises:
        SceneError, FormatError: the file cannot be read.
    """
    file, scene = collection_and_scene(path)
    if file is not None:
        return SceneFile(path=str(file), scene=scene or "").open()
    reader = reader_of(path)
    if reader is not None and reader.open_collection is not None and path.endswith(reader.collection):
        return reader.open_collection(Path(path))
    return SceneFile(path=path).open() if reader is not None or path.lower().endswith(".glb") else None


def _generated(text: str, count: int) -> tuple[NamedScene, ...]:
    """Return the scenes of a name (``count``) or of a name and a seed (one); none if no generator knows the name."""
    name, colon, seed = text.partition(":")
    for generator in scene_generators().values():
        if name in generator.names and (not colon or re.fullmatch(r"[0-9]{1,18}", seed)):
            seeds = [int(seed)] if colon else range(count)
            return tuple(NamedScene(name=f"{name}:{k}", source=generator.named(name, k)) for k in seeds)
    return ()


def _named(text: str, homes: int) -> tuple[NamedScene, ...]:
    if found := _generated(text, homes):
        return found
    file, scene = collection_and_scene(text)
    if file is not None:
        return (NamedScene(name=text, source=SceneFile(path=str(file), scene=scene or "")),)
    if Path(text).is_file() and is_collection(text):
        reader = reader_of(text)
        scenes = reader.scenes_in(Path(text)) if reader is not None else ()
        if len(scenes) == 1:
            return (NamedScene(name=text, source=SceneFile(path=text, scene=scenes[0])),)
        return tuple(NamedScene(name=f"{text}#{s}", source=SceneFile(path=text, scene=s)) for s in scenes)
    # a .toml is a set of scenes, which is read below
    if Path(text).is_file() and not text.endswith(".toml"):
        return (NamedScene(name=str(Path(text)), source=SceneFile(path=str(Path(text)))),)
    label, _, which = text.partition("#")
    preset, _, seed = text.partition(":")
    if seed and preset in preset_names():
        raise InputError(
            f"Unknown scenes {text!r}. Expected a whole number from 0 behind the colon, at most 18 digits, as in {preset}:3.",
            code="H3-SCENE-068",
        )
    found = find_scene_set(label)
    splits = [f"{name}/{split}" for name, of in builtin_sets().items() for split in of]
    near = did_you_mean(preset if seed else text, (*preset_names(), *splits))
    # a proposal for ``smal:3`` is ``small:3``, with the seed that was asked for
    near = near.replace("'?", f":{seed}'?") if seed else near
    if found is None and ("/" in label or label.endswith((".glb", ".json", ".urdf"))) and not Path(label).exists():
        raise InputError(
            f"There is no such scene or set of scenes.{near} Hint: `h3data scenes list` shows the sets. Path: {text}",
            code="H3-HABITAT-107",
        )
    if found is None:
        raise InputError(
            f"Unknown scenes {text!r}.{near} Hint: `h3data scenes list` shows homes and sets.{missing_packages()}"
            if near
            else f"Unknown scenes {text!r}. Expected homes (small), one of them (small:3), a set (h3-homes/test), one of its "
            "scenes (h3-homes/test#3), or the path of a scene or set. Hint: `h3data scenes list` shows all names."
            f"{missing_packages()}",
            code="H3-HABITAT-108",
        )
    every = [NamedScene(name=f"{label}#{k}", source=entry.source, id=entry.id) for k, entry in enumerate(found.scenes)]
    return (every[found.scenes.index(found.entry(which))],) if "#" in text else tuple(every)


@lru_cache(maxsize=64)  # 2 MB each; episodes go round the homes, so fewer would all be made anew each time
def open_scene(source: SceneSource) -> Scene:
    """Load the scene of a source; equal sources give the same object while it is in use.

    Raises:
        SceneError, FormatError: the scene cannot be generated or read.
    """
    return scene_of(source)


@lru_cache(maxsize=64)
def open_free_space(source: SceneSource, radius_m: float, height_m: float) -> FreeSpace:
    """Return the free floor of a scene for an agent with a radius and height [m]."""
    from h3data.scene.freespace.free_space import FreeSpace

    return FreeSpace.from_scene(open_scene(source), radius_m=radius_m, height_m=height_m)
