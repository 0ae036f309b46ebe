"""Scene sets: the homes of a split and the number of episodes in each.

 One TOML file is one split.

The file refers to scenes and never contains them: homes as specs, other scenes as paths (h3data docs scene-sets).
Episodes are not stored either: episode ``i`` of a scene is sampled from `SceneSet.episode_seed`
(`h3data_pipelines.assets.set_episodes`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec

from h3data.builtin import builtin_root
from h3data.errors import FormatError, InputError, did_you_mean
from h3data.plugins import names_from_data
from h3data.scene.sources import SCENES, SceneFile, SceneGenerator, SceneSource

FORMAT, SUFFIX = 1, ".toml"


@dataclass(frozen=True, kw_only=True)
class SceneEntry:
    """Entry of a scene set: a scene with the number of its episodes."""

    id: str
    """Name of the scene, unique in its set and unchanged when scenes are added."""
    source: SceneSource


class SocialNavRules(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[social_nav]`` of a scene set: the settings that all social-navigation episodes of a set share."""

    episodes_per_scene: int = 10
    spawn_distance_m: float = 5.0
    """Minimum distance between the starts in the floor plane [m]; the paper uses 3 for training, 5 for evaluation."""


@dataclass(frozen=True, kw_only=True)
class SceneSet:
    """The scenes of one split, in the order of the file."""

    name: str
    split: str
    scenes: tuple[SceneEntry, ...]
    social_nav: SocialNavRules
    about: str
    sha256: str
    """SHA-256 of the file, because an interrupted dataset can only be continued with the same set."""
    skipped: Mapping[str, Mapping[str, tuple[int, ...]]] = field(default_factory=dict)
    """Numbers of episodes that a task leaves out because they cannot be sampled or completed, by task and id of the
    scene."""

    @property
    def label(self) -> str:
        """Name and split, such as ``h3-homes/test``."""
        return f"{self.name}/{self.split}" if self.split else self.name

    @property
    def episodes(self) -> int:
        """Number of episodes in all scenes together."""
        return len(self.scenes) * self.social_nav.episodes_per_scene

    def place(self, episode: int, task: str = "") -> tuple[SceneEntry, int]:
        """Return the scene of an episode of the set, and its index within that scene, without those that the set skips.

        Consecutive episodes take consecutive scenes, so that the first few episodes already cover many of them.
        """
        # all scenes once before any of them twice
        entry, index = self.scenes[episode % len(self.scenes)], episode // len(self.scenes)
        for other in sorted(self.skipped.get(task, {}).get(entry.id, ())):
            index += other <= index
        return entry, index

    def episode_seed(self, scene_id: str, index: int, *, seed: int = 0) -> int:
        """Return the seed (63 bits) of episode ``index`` in a scene.

         It does not depend on the other scenes, so scenes may be added to a set.

        ``seed`` 0 gives the set's own episodes; any other value gives different episodes in the same scenes.
        """
        # text and SHA-256, not Python's ``hash``, which differs from process to process
        text = f"h3data.episode/1/{self.name}/{self.split}/{scene_id}/{seed}/{index}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1

    def entry(self, which: str) -> SceneEntry:
        """Return the scene with a number (``3``) or an id (``test_03``)."""
        # a number first: ids have letters as a rule, and one that is a number beyond the last scene can still be found
        if which.isdecimal() and int(which) < len(self.scenes):
            return self.scenes[int(which)]
        for entry in self.scenes:
            if entry.id == which:
                return entry
        raise InputError(
            f"There is no scene {which!r} in {self.label}. It has {len(self.scenes)}: 0 to {len(self.scenes) - 1}, "
            f"or by id: {', '.join([e.id for e in self.scenes[:6]] + (['...'] if len(self.scenes) > 6 else []))}.",
            code="H3-SCENE-056",
        )


# --- lookup by name ---------------------------------------------------------------------------------------------------
def builtin_sets() -> Mapping[str, tuple[str, ...]]:
    """Return splits of the sets that ship with h3data by set name, in the order train, val, test, others.

    A set is a folder with a card (README.md).
    """
    order = {"train": 0, "val": 1, "test": 2}
    files = [file for card in builtin_root().glob("*/README.md") for file in card.parent.glob(f"*{SUFFIX}")]
    splits: dict[str, list[str]] = {}
    # folders are listed in another order on every file system
    for file in sorted(files, key=lambda f: (f.parent.name, order.get(f.stem, 3), f.stem)):
        splits.setdefault(file.parent.name, []).append(file.stem)
    return {name: tuple(stems) for name, stems in splits.items()}


def find_scene_set(text: str) -> SceneSet | None:
    """Return the built-in set with a label such as ``h3-homes/test``, or the set in a TOML file; None if ``text`` is neither.

    Raises:
        InputError: there is no such split or file.
        FormatError: the file is invalid.
    """
    if text.endswith(SUFFIX):
        return read_scene_set(Path(text))
    name, _, split = text.partition("/")
    splits = builtin_sets().get(name)
    if splits is None or Path(text).is_file():
        return None
    if split not in splits:
        labels = [f"{name}/{s}" for s in splits]
        raise InputError(
            f"Which split of {name}? Expected {' or '.join(labels)}, got {text!r}.{did_you_mean(text, labels)}",
            code="H3-SCENE-057",
        )
    return read_scene_set(builtin_root() / name / f"{split}{SUFFIX}")


# --- the file ---------------------------------------------------------------------------------------------------------
class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    id: str
    file: str
    scene: str = ""


class _SetFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    format: int
    name: str
    scenes: list[dict[str, Any]]
    split: str = ""
    about: str = ""
    social_nav: SocialNavRules = msgspec.field(default_factory=SocialNavRules)
    skipped: dict[str, dict[str, tuple[Annotated[int, msgspec.Meta(ge=0)], ...]]] = {}


def read_scene_set(path: str | Path) -> SceneSet:
    """Return the set in a TOML file. Scene paths are relative to its folder or absolute; the files must exist but are not read.

    Raises:
        InputError: the file cannot be read, or the package that makes its scenes is not installed.
        FormatError: the file is invalid; the message names the key of each fault.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"Cannot read the scene set ({error.strerror or error}): {path}", code="H3-SCENE-062"
        ) from None
    try:
        content = msgspec.toml.decode(data, type=_SetFile)
    except (msgspec.MsgspecError, UnicodeDecodeError) as fault:
        raise FormatError(f"{_readable(fault, _SetFile)} Scene set: {path}", code="H3-SCENE-063") from None
    for kind in {str(record.get("kind", "home")) for record in content.scenes if "file" not in record}:
        if kind in SCENES.missing():
            SCENES.get(kind)  # says which package is missing, once and not for each scene
    faults = list(_header_faults(content))
    scenes: list[SceneEntry] = []
    for k, record in enumerate(content.scenes):
        try:
            scenes.append(_entry(record, path.parent))
        except InputError as fault:
            faults.append(f"scenes[{k}]: {str(fault).rstrip('.')}.")
        except msgspec.ValidationError as fault:
            kind = _File if "file" in record else _generator(record).Table
            faults.append(f"scenes[{k}]: {_readable(fault, kind)}")
    # all faults before anything is refused: whoever writes a set by hand mends them in one go
    ids = [e.id for e in scenes]
    faults += [f"scenes: the id {i!r} occurs {ids.count(i)} times." for i in dict.fromkeys(ids) if ids.count(i) > 1]
    strange = {name for some in content.skipped.values() for name in some} - set(ids)
    faults += [f"skipped: there is no scene {name!r}." for name in sorted(strange)]
    if faults:
        more = f" ... and {len(faults) - 5} more faults." if len(faults) > 5 else ""
        raise FormatError(f"{' '.join(faults[:5])}{more} Scene set: {path}", code="H3-SCENE-058")
    return SceneSet(
        name=content.name,
        split=content.split,
        scenes=tuple(scenes),
        social_nav=content.social_nav,
        about=content.about,
        sha256=hashlib.sha256(data).hexdigest(),
        skipped={task: {k: tuple(set(v)) for k, v in some.items()} for task, some in content.skipped.items()},
    )


def _header_faults(content: _SetFile) -> Iterable[str]:
    rules = content.social_nav
    if content.format != FORMAT:
        yield f"format: expected {FORMAT}, got {content.format}."
    if not content.name or "/" in content.name or "/" in content.split:
        yield f"name, split: expected words without '/', got {content.name!r}, {content.split!r}."
    if not content.scenes:
        yield "scenes: expected at least one."
    if rules.episodes_per_scene < 1:
        yield f"social_nav.episodes_per_scene: expected at least 1, got {rules.episodes_per_scene}."
    if not 0 <= rules.spawn_distance_m < float("inf"):
        yield f"social_nav.spawn_distance_m: expected a distance in metres, got {rules.spawn_distance_m}."


def _entry(record: dict[str, Any], folder: Path) -> SceneEntry:
    if "file" not in record:
        generator = _generator(record)
        values = {name: value for name, value in record.items() if name != "kind"}
        table = msgspec.structs.asdict(msgspec.convert(values, generator.Table))
        return SceneEntry(id=_checked_id(table.pop("id")), source=generator.Spec(**table))
    entry = msgspec.convert(record, _File)
    if ".." in PurePosixPath(entry.file).parts:
        raise InputError(
            f"file: the path must not leave the folder of the set, got {entry.file!r}. Hint: use an absolute path.",
            code="H3-SCENE-059",
        )
    file = folder / entry.file
    if not file.is_file():
        raise InputError(f"file: no such file: {entry.file!r}.", code="H3-SCENE-060")
    return SceneEntry(id=_checked_id(entry.id), source=SceneFile(path=str(file), scene=entry.scene))


def _generator(record: Mapping[str, Any]) -> SceneGenerator:
    """Return the generator of a scene whose table names no file.

    Raises:
        InputError: there is no such generator, or its package is not installed.
    """
    with names_from_data():
        generator = SCENES.get(str(record.get("kind", "home")))
    if not isinstance(generator, SceneGenerator):
        raise InputError(
            f"kind: expected a generator of scenes such as home, got {record['kind']!r}.", code="H3-SCENE-064"
        )
    return generator


def _checked_id(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", text):
        raise InputError(f"id: expected letters, digits, '_' and '-', got {text!r}.", code="H3-SCENE-061")
    return text


def _readable(fault: Exception, kind: type[msgspec.Struct]) -> str:
    """Return the message of msgspec or ours, with the valid keys if a key is unknown."""
    text = str(fault).replace("`", "'").replace("$.", "").removesuffix(" - at '$'").rstrip(".")
    text = text.replace("Object contains unknown field", "unknown key").replace("Object missing required", "missing")
    valid = f" Expected: {', '.join(kind.__struct_fields__)}." if "unknown key" in text else ""
    return f"{text}.{valid}"
