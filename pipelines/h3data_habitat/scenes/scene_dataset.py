"""Scene datasets of Habitat: templates in a ``*.scene_dataset_config.json``, and their attributes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from h3data.errors import FormatError, SceneError
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import mapping, objects, read_object, text

Section = Literal[
    "stages",
    "objects",
    "articulated_objects",
    "light_setups",
    "scene_instances",
    "semantic_scene_descriptor_instances",
]

_CONFIG_ENDINGS: dict[Section, str] = {
    "stages": ".stage_config.json",
    "objects": ".object_config.json",
    "articulated_objects": ".ao_config.json",
    "light_setups": ".lighting_config.json",
    "scene_instances": ".scene_instance.json",
    "semantic_scene_descriptor_instances": ".semantic_config.json",
}
DATASET_ENDING = ".scene_dataset_config.json"
_NAME_DIRECTIVES = ("%%CONFIG_NAME_AS_ASSET_FILENAME%%", "%%USE_FILENAME%%")


@dataclass(frozen=True, eq=False)
class Template:
    """Template of a stage, object or scene that can be instantiated, whose file is read at its first use."""

    handle: str
    """Short name: the file's name without its ending, or the ``template_handle`` of the dataset."""
    path: Path
    """Config or asset file; for templates that exist only in the dataset config, that config."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    overrides: Mapping[str, Any] = field(default_factory=dict)
    inline: bool = False
    """True if the attributes are in the dataset config itself."""

    @property
    def is_config(self) -> bool:
        """Return whether the template is a JSON file of its own."""
        return self.path.name.endswith(".json") and not self.inline

    def attributes(self) -> dict[str, Any]:
        """Return the attributes: defaults of the dataset, then the file, then the dataset's overrides (spec/habitat.md 6.1)."""
        own: dict[str, Any] = {}
        if self.is_config:
            own = read_object(self.path)
        elif not self.inline:
            own = {"urdf_filepath" if self.path.suffix.lower() == ".urdf" else "render_asset": self.path.name}
        # later ones win (spec/habitat.md 6.1)
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
    """Content of a dataset config, by section."""

    path: Path
    sections: Mapping[Section, tuple[Template, ...]]
    navmeshes: Mapping[str, str] = field(default_factory=dict)
    """Navmesh files (relative to the config) by the name that scenes use."""
    descriptors: Mapping[str, str] = field(default_factory=dict)
    """Files of semantic descriptors by name, in the same form as templates."""
    keys: KeyNotes = field(default_factory=KeyNotes)
    empty_paths: tuple[str, ...] = ()
    """Search paths that contain no files."""

    @property
    def scenes(self) -> list[str]:
        """Names of the dataset's scenes, sorted: ``path#name`` opens one."""
        return self.names("scene_instances")

    def __repr__(self) -> str:
        shown = ", ".join(self.scenes[:12]) + (", ..." if len(self.scenes) > 12 else "")
        return f"SceneDataset({self.path.name!r}, {len(self.scenes)} scenes: {shown or 'none'})"

    def find(self, section: Section, name: str) -> tuple[Template | None, int]:
        """Return the template that a scene calls ``name``, and the number of other templates that would fit.

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
            # an override with a handle of its own shares the file, whose name means the plain template
            elif full.endswith("/" + wanted) and not template.overrides:
                rank = 1
            elif wanted in template.handle or wanted in full[len(self.path.parent.as_posix()) :]:
                rank = 2
            else:
                continue
            best.append((rank, len(template.handle), template.handle, template))
        if not best:
            return None, 0
        # without the template itself, which has no order
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
        """Return the handles in a section, sorted."""
        return sorted(t.handle for t in self.sections.get(section, ()))


def load_scene_dataset(path: Path) -> SceneDataset:
    """Return the templates of a ``*.scene_dataset_config.json``; only names are listed, no template is opened."""
    content = read_object(path)
    keys = KeyNotes()
    keys.note("scene_dataset_config", content)
    sections: dict[Section, tuple[Template, ...]] = {}
    empty: list[str] = []
    for section, ending in _CONFIG_ENDINGS.items():
        entry = mapping(content, section, where=path)
        if section != "semantic_scene_descriptor_instances":  # there names of files may stand beside the keys
            keys.note("dataset_section", entry)
        for item in objects(entry, "configs", where=path):
            keys.note("dataset_override", item)
        sections[section] = tuple(_templates(path, entry, ending, empty))
    if not any(sections.values()):
        raise FormatError(
            f"This dataset configuration lists no stages, objects or scenes that exist: {path}", code="H3-HABITAT-122"
        )
    navmeshes = mapping(content, "navmesh_instances", where=path)
    descriptors = mapping(content, "semantic_scene_descriptor_instances", where=path)
    return SceneDataset(
        path=path,
        sections=sections,
        navmeshes={k: v for k, v in navmeshes.items() if isinstance(v, str)},
        descriptors={k: v for k, v in descriptors.items() if isinstance(v, str)},
        keys=keys,
        empty_paths=tuple(empty),
    )


def dataset_above(path: Path) -> SceneDataset:
    """Return the dataset that a scene instance belongs to: the nearest one in the folders above whose config lists it."""
    tried: list[Path] = []
    for folder in path.resolve().parents:
        configs = sorted(folder.glob("*" + DATASET_ENDING))
        for config in configs:
            dataset = load_scene_dataset(config)
            if any(t.path.resolve() == path.resolve() for t in dataset.sections["scene_instances"]):
                return dataset
        tried += configs
        # a home folder above may hold any number of datasets
        if len(tried) > 20:
            break
    found = f" These do not list it: {', '.join(str(t) for t in tried[:3])}." if tried else ""
    raise SceneError(
        f"No *{DATASET_ENDING} above this scene lists it, so its templates cannot be found.{found} "
        f"Hint: pass the dataset config and the scene's name instead. {path}",
        code="H3-HABITAT-121",
    )


def _templates(config: Path, entry: Mapping[str, Any], ending: str, empty: list[str]) -> list[Template]:
    """Return the templates that a section lists; add to ``empty`` the search paths below which nothing is."""
    root = config.parent
    defaults = mapping(entry, "default_attributes", where=config)
    found: dict[Path, Template] = {}
    for extension, patterns in mapping(entry, "paths", where=config).items():
        wanted = ending if extension == ".json" else extension
        for pattern in patterns if isinstance(patterns, list) else [patterns]:
            files = _matching(root, str(pattern), wanted)
            if not files:
                empty.append(str(pattern))
            for file in files:
                # several patterns may name one file
                found.setdefault(file, Template(handle=_short(file.name), path=file, defaults=defaults))
    configured = {t.handle for t in found.values() if t.is_config}
    # a mesh that also has a config is offered once, as the config
    result = [t for t in found.values() if t.is_config or t.handle not in configured]
    for item in objects(entry, "configs", where=config):
        overrides = mapping(item, "attributes", where=config)
        original, handle = (text(item, key, where=config) for key in ("original_file", "template_handle"))
        if original is None:
            if handle is not None:
                result.append(Template(handle=handle, path=config, defaults=defaults, overrides=overrides, inline=True))
            continue
        file = root / original
        # without a name of its own an override changes the template of its file
        if handle is None:
            result = [replace(t, overrides=overrides) if t.path == file else t for t in result]
        else:
            result.append(Template(handle=handle, path=file, defaults=defaults, overrides=overrides))
    return result


def _matching(root: Path, pattern: str, ending: str) -> list[Path]:
    """Return files that end in ``ending``, for a pattern that names files or folders (folders are not searched deeper)."""
    pattern = pattern.replace("\\", "/").strip("/")
    try:
        places = sorted(root.glob(pattern)) if pattern not in ("", ".") else [root]
    except (ValueError, NotImplementedError, OSError) as fault:
        raise FormatError(
            f"Not a path pattern of a dataset: {pattern[:200]!r} ({fault}): {root}", code="H3-HABITAT-123"
        ) from None
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
