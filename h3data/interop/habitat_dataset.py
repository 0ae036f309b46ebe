"""Habitat's scene datasets: which templates a ``*.scene_dataset_config.json`` offers, and what their attributes are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from h3data.errors import FormatError, SceneError
from h3data.interop.sniff import read_json

Section = Literal["stages", "objects", "articulated_objects", "scene_instances"]

_CONFIG_ENDINGS: dict[Section, str] = {
    "stages": ".stage_config.json",
    "objects": ".object_config.json",
    "articulated_objects": ".ao_config.json",
    "scene_instances": ".scene_instance.json",
}
DATASET_ENDING = ".scene_dataset_config.json"
_NAME_DIRECTIVES = ("%%CONFIG_NAME_AS_ASSET_FILENAME%%", "%%USE_FILENAME%%")


@dataclass(frozen=True, eq=False)
class Template:
    """A kind of stage, object or scene that can be instanced. Its file is read when it is used."""

    handle: str
    """The short name: the file's name without its ending, or the ``template_handle`` of the dataset."""
    path: Path
    """Config or asset file; for templates that exist only in the dataset config, that config."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    overrides: Mapping[str, Any] = field(default_factory=dict)
    inline: bool = False
    """Its attributes stand in the dataset config itself."""

    @property
    def is_config(self) -> bool:
        return self.path.name.endswith(".json") and not self.inline

    def attributes(self) -> dict[str, Any]:
        """Defaults of the dataset, then the file, then the dataset's overrides (spec/habitat.md 6.1)."""
        own = read_object(self.path) if self.is_config else {} if self.inline else {"render_asset": self.path.name}
        merged = {**self.defaults, **own, **self.overrides}
        stem = _short(self.path.name) if not self.inline else self.handle
        for key, value in merged.items():
            if isinstance(value, str):
                for directive in _NAME_DIRECTIVES:
                    value = value.replace(directive, stem)
                merged[key] = value
        return merged


@dataclass(frozen=True, eq=False)
class SceneDataset:
    """What a dataset config lists, by section."""

    path: Path
    sections: Mapping[Section, tuple[Template, ...]]

    def find(self, section: Section, name: str) -> tuple[Template | None, int]:
        """The template that a scene means by ``name``, and how many others would have fitted as well.

        Handles are matched as Habitat does, by sub-string (spec/habitat.md 6.1), best first: the same handle, the end
        of the file's path, then a part of it. Among equals the shortest, then the first in alphabetical order is
        taken.
        """
        wanted = _short(name.replace("\\", "/"))
        exact = self._by_handle.get((section, wanted), ())
        if exact:
            return exact[0], len(exact) - 1
        best: list[tuple[int, int, str, Template]] = []
        for template in self.sections.get(section, ()):
            full = _without_ending(template.path.as_posix()) if not template.inline else template.handle
            if wanted == full:
                rank = 0
            elif full.endswith("/" + wanted) and not template.overrides:
                rank = 1
            elif wanted in template.handle or wanted in full[len(self.path.parent.as_posix()) :]:
                rank = 2
            else:
                continue
            best.append((rank, len(template.handle), template.handle, template))
        if not best:
            return None, 0
        best.sort(key=lambda entry: entry[:3])
        return best[0][3], sum(entry[0] == best[0][0] for entry in best) - 1

    @cached_property
    def _by_handle(self) -> Mapping[tuple[Section, str], list[Template]]:
        index: dict[tuple[Section, str], list[Template]] = {}
        for section, templates in self.sections.items():
            for template in templates:
                index.setdefault((section, template.handle), []).append(template)
        return index

    def names(self, section: Section) -> list[str]:
        """Handles in a section, sorted."""
        return sorted(t.handle for t in self.sections.get(section, ()))


def load_scene_dataset(path: Path) -> SceneDataset:
    """The templates of a ``*.scene_dataset_config.json``; only names are listed, no template is opened."""
    content = read_object(path)
    sections: dict[Section, tuple[Template, ...]] = {}
    for section, ending in _CONFIG_ENDINGS.items():
        entry = content.get(section, {})
        if not isinstance(entry, dict):
            raise FormatError(f"Expected an object under {section!r}, got {type(entry).__name__}: {path}")
        sections[section] = tuple(_templates(path, entry, ending))
    if not any(sections.values()):
        raise FormatError(f"This dataset configuration lists no stages, objects or scenes that exist: {path}")
    return SceneDataset(path=path, sections=sections)


def read_object(path: Path) -> dict[str, Any]:
    """The content of a JSON file that must hold an object."""
    _, content = read_json(path)
    if not isinstance(content, dict):
        raise FormatError(f"Expected a JSON object, got {type(content).__name__}: {path}")
    return content


def dataset_above(path: Path) -> Path:
    """The dataset config that a scene instance belongs to: the nearest one in the folders above that lists it."""
    tried: list[Path] = []
    for folder in path.resolve().parents:
        configs = sorted(folder.glob("*" + DATASET_ENDING))
        for config in configs:
            listed = load_scene_dataset(config).sections["scene_instances"]
            if any(t.path.resolve() == path.resolve() for t in listed):
                return config
        tried += configs
        if len(tried) > 20:
            break
    found = f" These do not list it: {', '.join(str(t) for t in tried[:3])}." if tried else ""
    raise SceneError(
        f"No *{DATASET_ENDING} above this scene lists it, so its templates cannot be found.{found} "
        f"Hint: pass the dataset config and the scene's name instead. {path}"
    )


def _templates(config: Path, entry: Mapping[str, Any], ending: str) -> list[Template]:
    root = config.parent
    defaults = _mapping(entry.get("default_attributes"))
    found: dict[Path, Template] = {}
    for extension, patterns in _mapping(entry.get("paths")).items():
        wanted = ending if extension == ".json" else extension
        for pattern in patterns if isinstance(patterns, list) else [patterns]:
            for file in _matching(root, str(pattern), wanted):
                found.setdefault(file, Template(handle=_short(file.name), path=file, defaults=defaults))
    configured = {t.handle for t in found.values() if t.is_config}
    # a mesh that also has a config is offered once, as the config
    result = [t for t in found.values() if t.is_config or t.handle not in configured]
    for item in objects(entry, "configs", where=config):
        overrides = _mapping(item.get("attributes"))
        original, handle = (text(item, key, where=config) for key in ("original_file", "template_handle"))
        if original is None:
            if handle is not None:
                result.append(Template(handle=handle, path=config, defaults=defaults, overrides=overrides, inline=True))
            continue
        file = root / original
        if handle is None:
            result = [replace(t, overrides=overrides) if t.path == file else t for t in result]
        else:
            result.append(Template(handle=handle, path=file, defaults=defaults, overrides=overrides))
    return result


def _matching(root: Path, pattern: str, ending: str) -> list[Path]:
    """Files that end in ``ending``, for a pattern that names files or folders (folders are not searched deeper)."""
    pattern = pattern.replace("\\", "/").strip("/")
    try:
        places = sorted(root.glob(pattern)) if pattern not in ("", ".") else [root]
    except (ValueError, NotImplementedError, OSError) as fault:
        raise FormatError(f"Not a path pattern of a dataset: {pattern[:200]!r} ({fault}): {root}") from None
    files: list[Path] = []
    for place in places:
        if place.is_dir():
            files += sorted(f for f in place.iterdir() if f.name.endswith(ending))
        elif place.name.endswith(ending):
            files.append(place)
    return files


def _short(name: str) -> str:
    return Path(_without_ending(name)).name if "/" not in name else _without_ending(name)


def _without_ending(name: str) -> str:
    for ending in (*_CONFIG_ENDINGS.values(), DATASET_ENDING, ".glb", ".gltf", ".urdf", ".ply", ".obj"):
        if name.endswith(ending):
            return name.removesuffix(ending)
    return name


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def objects(attributes: Mapping[str, Any], key: str, *, where: Path) -> list[dict[str, Any]]:
    """The list of JSON objects under ``key``; empty if there is none."""
    value = attributes.get(key) or []
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise FormatError(f"Expected a list of objects under {key!r}, got {str(value)[:60]}: {where}")
    return value


def text(attributes: Mapping[str, Any], key: str, *, where: Path) -> str | None:
    """The text under ``key``, if there is any."""
    value = attributes.get(key)
    if value is not None and not isinstance(value, str):
        raise FormatError(f"Expected a text under {key!r}, got {str(value)[:60]}: {where}")
    return value


def number(attributes: Mapping[str, Any], key: str, default: float, *, where: Path) -> float:
    """The number under ``key``."""
    value = attributes.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FormatError(f"Expected a number under {key!r}, got {str(value)[:60]}: {where}")
    return float(value)


def numbers(attributes: Mapping[str, Any], key: str, default: Sequence[float], *, where: Path) -> tuple[float, ...]:
    """The numbers under ``key``, as many as ``default`` has."""
    value = attributes.get(key)
    if value is None:
        return tuple(default)
    fine = isinstance(value, list) and len(value) == len(default) and all(isinstance(v, int | float) for v in value)
    if not fine:
        raise FormatError(f"Expected {len(default)} numbers under {key!r}, got {str(value)[:60]}: {where}")
    return tuple(float(v) for v in value)
