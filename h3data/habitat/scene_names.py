"""The scene that a few words mean: a built-in home, one of a set, a file of ours or of Habitat."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from h3data.errors import FormatError, InputError, did_you_mean
from h3data.habitat.scenes.scene_dataset import DATASET_ENDING, load_scene_dataset
from h3data.habitat.scenes.scene_instance import dataset_and_scene, load_habitat_scene
from h3data.mesh.glb import unpack_glb
from h3data.scene import FreeSpace, HomeSpec, build_home, load_scene
from h3data.scene.homes import HOME_NAMES
from h3data.scene.scene_sets import SceneFile, SceneSource, builtin_sets, find_scene_set

if TYPE_CHECKING:
    from h3data.scene import Scene


@dataclass(frozen=True, kw_only=True)
class NamedScene:
    """A scene that can be loaded, and the words by which the command line knows it."""

    name: str
    """``small:3``, ``h3-homes/test#3`` or a path."""
    source: SceneSource
    id: str = ""
    """Its id, if it is of a set."""


def named_scenes(
    text: str,
    *,
    homes: int = 4,
    assets: Sequence[str | Path] = (),
    strict: bool = False,
    allow_missing: bool = False,
) -> tuple[NamedScene, ...]:
    """The scenes that ``text`` means; the other options are for scenes of Habitat (`load_habitat_scene`).

    ``small`` (a preset: its first ``homes`` homes), ``small:3``, ``small2:3`` (second generation), ``small-open:3`` (furniture
    opens), ``small2-storeys:3`` (two storeys), ``small2-doors:3`` (doors between rooms), ``h3-homes/test`` or ``my.toml`` (all
    of a set),
    ``h3-homes/test#3`` or ``h3-homes/test#test_03`` (one of a set), or the path of a scene: GLB or one of Habitat's.
    A ``.scene_dataset_config.json`` is all its scenes, followed by ``#name`` one of them.

    Raises:
        InputError: none of these; the message lists what there is.
        FormatError: a set with faults.
    """
    found = _named(text, homes)
    folders = tuple(str(folder) for folder in assets)
    options = {"assets": folders, "strict": strict, "allow_missing": allow_missing}
    return tuple(
        replace(n, source=replace(n.source, **options)) if isinstance(n.source, SceneFile) else n for n in found
    )


def listed_scenes(text: str) -> tuple[NamedScene, ...]:
    """The scenes of several names separated by commas, as in ``h3-homes/train,h3-homes-v2/train``, in that order.

    Raises:
        InputError, FormatError: as `named_scenes`; or two names mean the same scene.
    """
    names = [text] if Path(text).exists() else [name.strip() for name in text.split(",")]
    found = tuple(named for name in names for named in named_scenes(name))
    seen: set[SceneSource] = set()
    for named in found:
        if named.source in seen:
            raise InputError(f"Expected each scene once, got {named.name} again. Scenes: {text}")
        seen.add(named.source)
    return found


def is_builtin_name(text: str) -> bool:
    """Whether the words name built-in homes (``small``, ``small:3``) or a set of scenes, one of which may follow ``#``."""
    preset, _, seed = text.partition(":")
    if preset in HOME_NAMES and (not seed or re.fullmatch(r"[0-9]{1,18}", seed)):
        return not Path(text).exists()
    label = text.partition("#")[0]
    return any(label in (name, *(f"{name}/{split}" for split in of)) for name, of in builtin_sets().items())


def _named(text: str, homes: int) -> tuple[NamedScene, ...]:
    if text in HOME_NAMES:
        return tuple(_home(text, seed) for seed in range(homes))
    preset, _, seed = text.partition(":")
    if preset in HOME_NAMES and re.fullmatch(r"[0-9]{1,18}", seed):
        return (_home(preset, int(seed)),)
    config, scene = dataset_and_scene(text)
    if config is not None:
        return (NamedScene(name=text, source=SceneFile(path=str(config), scene=scene or "")),)
    if Path(text).is_file() and text.endswith(DATASET_ENDING):
        scenes = load_scene_dataset(Path(text)).scenes
        if len(scenes) == 1:
            return (NamedScene(name=text, source=SceneFile(path=text, scene=scenes[0])),)
        return tuple(NamedScene(name=f"{text}#{s}", source=SceneFile(path=text, scene=s)) for s in scenes)
    if Path(text).is_file() and not text.endswith(".toml"):
        return (NamedScene(name=str(Path(text)), source=SceneFile(path=str(Path(text)))),)
    label, _, which = text.partition("#")
    found = find_scene_set(label)
    splits = [f"{name}/{split}" for name, of in builtin_sets().items() for split in of]
    near = did_you_mean(preset if seed else text, (*HOME_NAMES, *splits))
    near = near.replace("'?", f":{seed}'?") if seed else near
    if found is None and ("/" in label or label.endswith((".glb", ".json", ".urdf"))) and not Path(label).exists():
        raise InputError(
            f"There is no such scene or set of scenes.{near} Hint: `h3data scenes list` shows the sets. Path: {text}"
        )
    if found is None:
        raise InputError(
            f"Unknown scenes {text!r}.{near} Hint: `h3data scenes list` shows homes and sets."
            if near
            else f"Unknown scenes {text!r}. Expected homes (small), one of them (small:3), a set (h3-homes/test), one of its "
            "scenes (h3-homes/test#3), or the path of a scene or set. Hint: `h3data scenes list` shows all names."
        )
    every = [NamedScene(name=f"{label}#{k}", source=entry.source, id=entry.id) for k, entry in enumerate(found.scenes)]
    return (every[found.scenes.index(found.entry(which))],) if "#" in text else tuple(every)


def _home(name: str, seed: int) -> NamedScene:
    return NamedScene(name=f"{name}:{seed}", source=HomeSpec(seed=seed, **HOME_NAMES[name]))


@lru_cache(maxsize=64)  # 2 MB each; episodes go round the homes, so fewer would all be made anew each time
def open_scene(source: SceneSource) -> Scene:
    """The scene itself; equal sources give the same object while it is in use.

    Raises:
        SceneError, FormatError: it cannot be made or read.
    """
    return build_home(source) if isinstance(source, HomeSpec) else read_scene_file(source)


def read_scene_file(source: SceneFile) -> Scene:
    """The scene in a file as it is now; fails as `open_scene` does."""
    if _is_ours(Path(source.path)) and not source.scene:
        return load_scene(source.path)
    return load_habitat_scene(
        source.path,
        source.scene or None,
        allow_missing=source.allow_missing,
        strict=source.strict,
        assets=source.assets,
    )


@lru_cache(maxsize=64)
def open_free_space(source: SceneSource, radius_m: float, height_m: float) -> FreeSpace:
    """The free floor of `open_scene`'s scene for an agent of that size [m]."""
    return FreeSpace.from_scene(open_scene(source), radius_m=radius_m, height_m=height_m)


def _is_ours(path: Path) -> bool:
    """Whether `h3data.scene.save_scene` wrote it: else a GLB is a stage mesh, and Z-up."""
    if path.suffix.lower() != ".glb" or not path.is_file():
        return False
    try:
        extras = unpack_glb(path.read_bytes(), str(path), what="a scene as GLB")[0].get("extras")
    except FormatError:
        return False
    return isinstance(extras, dict) and isinstance(extras.get("h3data"), dict) and "format" in extras["h3data"]
