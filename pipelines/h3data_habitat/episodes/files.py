"""Reading and writing of habitat-lab's episode datasets (``.json.gz``, ``.json``, split by scene, ``.pickle``)."""

from __future__ import annotations

import gc
import gzip
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import FormatError, InputError
from h3data.formats import SourceFile, json_format
from h3data.recording.task_episodes.rearrange_episode import ContentFile, EpisodeSet, RearrangeEpisode
from h3data_habitat.episodes.episode_json import Notes, decode_episodes, encode_episode, encode_json
from h3data_habitat.episodes.episode_pickle import unpickle_episodes
from h3data_habitat.json_files import not_json
from h3data_habitat.safe_pickle import is_pickle

_OBJECT = msgspec.json.Decoder(dict[str, msgspec.Raw])
_LIST = msgspec.json.Decoder(list[msgspec.Raw])
_CONTENT_PATH = "{data_path}/content/{scene}.json.gz"


def read_episodes(path: str | Path, *, strict: bool = False) -> EpisodeSet:
    """Return the episodes of a dataset file; with ``strict``, warnings become errors.

    If a file without episodes is next to a folder ``content``, the files in it are read, as Habitat does
    (spec/habitat.md 6.5). Pickled datasets are read without running anything that they contain.

    Raises:
        FormatError: the file has another format or is damaged, or a value has the wrong type; the message names episode
            and key.
    """
    with _collector_paused():
        return _read(Path(path), strict)


def _read(path: Path, strict: bool) -> EpisodeSet:
    notes = Notes(path, strict)
    raws, extra = _open(path)
    contents: list[ContentFile] = []
    if raws:
        episodes = decode_episodes(raws, notes)
    else:
        episodes = []
        for name, file in _content_files(path, extra):
            notes.path = file
            raws, more = _open(file)
            episodes += decode_episodes(raws, notes)
            contents.append(ContentFile(name=name, episodes=len(raws), extra=more))
    return EpisodeSet(episodes=tuple(episodes), extra=extra, contents=tuple(contents), warnings=notes.texts())


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Pause the search for reference cycles, of which there are none here: 2.1 instead of 2.9 s for 37,000 episodes."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


# --- the file ---------------------------------------------------------------------------------------------------------
def _open(path: Path) -> tuple[Sequence[msgspec.Raw], dict[str, Any]]:
    """Return the episodes, still text, and the other keys of the file."""
    data = SourceFile(path).data
    if is_pickle(data):
        return unpickle_episodes(data, path), {}
    try:
        top = _OBJECT.decode(data)
        # logs of HITL sessions have a key of this name too
        if "episodes" not in top or {"session", "users"} <= set(top):
            raise _other_kind(path, data)
        raws = _LIST.decode(top.pop("episodes"))
        return raws, {key: msgspec.json.decode(raw) for key, raw in top.items()}
    except msgspec.ValidationError:
        raise _other_kind(path, data) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as fault:
        raise _not_json(path, data, fault) from None
    except RecursionError:
        raise _too_deep(path) from None


def _other_kind(path: Path, data: bytes) -> FormatError:
    try:
        content = msgspec.json.decode(data)
    except RecursionError:
        return _too_deep(path)
    except (msgspec.DecodeError, UnicodeDecodeError) as fault:
        return _not_json(path, data, fault)
    other = json_format(content, name=path.name)
    if other.name == "rearrange_episodes":
        got = type(content["episodes"]).__name__
        return FormatError(
            f"Expected a list under 'episodes', got {_JSON_WORDS.get(got, got)}: {path}", code="H3-HABITAT-004"
        )
    if not isinstance(content, dict):
        word = _JSON_WORDS.get(type(content).__name__, "a value")
        return FormatError(
            f"Expected an episode dataset, an object with the key 'episodes'; this is {word}: {path}",
            code="H3-HABITAT-005",
        )
    keys = ", ".join(list(content)[:5]) or "no keys"
    return FormatError(
        f"Expected an episode dataset, this is {other.title} (it has {keys}): {path}", code="H3-HABITAT-002"
    )


_JSON_WORDS = {
    "dict": "an object",
    "list": "a list",
    "str": "a string",
    "int": "a number",
    "float": "a number",
    "bool": "true or false",
    "NoneType": "null",
}
_NON_FINITE = re.compile(rb"[\[,:\s](NaN|-?Infinity)[\],}\s]")


def _not_json(path: Path, data: bytes, fault: Exception) -> FormatError:
    """Say where a NaN stands, which Python writes though it is no JSON; else where the JSON stops."""
    if _NON_FINITE.search(data):
        try:
            where = _non_finite(json.loads(data))
        except (ValueError, RecursionError):
            where = None
        if where is not None:
            return FormatError(
                f"Expected finite numbers, {where[0]} is {where[1]}. Hint: leave that out. {path}",
                code="H3-HABITAT-010",
            )
    return not_json(path, data, fault)


def _non_finite(content: Any) -> tuple[str, float] | None:
    """Return the first NaN or infinity, and where it is."""
    # a stack, as the file may be nested deeper than Python recurses; reversed keeps the order of the file
    stack: list[tuple[str, Any]] = [("", content)]
    while stack:
        where, value = stack.pop()
        if isinstance(value, float) and not math.isfinite(value):
            return where, value
        if isinstance(value, dict):
            stack += reversed([(_joined(where, key), entry) for key, entry in value.items()])
        elif isinstance(value, list):
            stack += reversed([(f"{where}[{k}]", entry) for k, entry in enumerate(value)])
    return None


def _joined(where: str, key: str) -> str:
    return (f"{where}.{key}" if where else key) if key.isidentifier() else f"{where}[{key!r}]"


def _too_deep(path: Path) -> FormatError:
    return FormatError(
        f"Expected an episode dataset, this is JSON nested deeper than any of them: {path}", code="H3-HABITAT-003"
    )


def _content_files(path: Path, extra: Mapping[str, Any]) -> list[tuple[str, Path]]:
    """Return the names and paths of the files that a split dataset consists of, by name."""
    pattern = extra.get("content_scenes_path", _CONTENT_PATH)
    if not isinstance(pattern, str) or pattern.count("{scene}") != 1 or not pattern.startswith("{data_path}/"):
        raise FormatError(
            f"Expected content_scenes_path like {_CONTENT_PATH!r}, got {pattern!r}: {path}", code="H3-HABITAT-006"
        )
    before, after = pattern.removeprefix("{data_path}/").split("{scene}")
    # the pattern comes from the file, and must not lead to other files
    if ".." in Path(before + after).parts or Path(before).is_absolute() or "/" in after:
        raise FormatError(
            f"content_scenes_path must stay in the folder of the dataset, is {pattern!r}: {path}", code="H3-HABITAT-007"
        )
    folder = path.parent / before
    if not folder.is_dir():
        return []
    found = [(file.name.removesuffix(after), file) for file in folder.iterdir() if file.name.endswith(after)]
    return sorted(found)


# --- writing ------------------------------------------------------------------------------------------------------------
def write_episodes(episode_set: EpisodeSet, path: str | Path) -> None:
    """Write a dataset as ``.json.gz`` (which Habitat reads) or ``.json``; the same episodes give the same bytes.

    A set with ``contents`` keeps its structure: ``path`` without episodes, and ``content/<name>.json.gz``.
    Nothing is left at ``path`` if an episode cannot be written.

    Raises:
        InputError: a value is a matrix or number that JSON cannot represent; the message names the episode.
    """
    path = Path(path)
    if not path.name.endswith((".json", ".json.gz")):
        raise InputError(f"Expected a name that ends in .json.gz or .json: {path}", code="H3-HABITAT-008")
    episodes, contents = episode_set.episodes, episode_set.contents
    if not contents:
        _write(path, episodes, 0, episode_set.extra)
        return
    total = sum(part.episodes for part in contents)
    if total != len(episodes):
        raise InputError(
            f"contents accounts for {total} episodes, the set has {len(episodes)}. Hint: contents=() writes one file.",
            code="H3-HABITAT-009",
        )
    pattern = str(episode_set.extra.get("content_scenes_path", _CONTENT_PATH))
    at = 0
    for part in contents:
        file = path.parent / pattern.removeprefix("{data_path}/").replace("{scene}", part.name)
        # names of parts may come from a file of somebody else
        if path.parent.resolve() not in file.resolve().parents:
            raise InputError(
                f"The content file {part.name!r} would lie outside the folder of the dataset: {file}",
                code="H3-HABITAT-011",
            )
        file.parent.mkdir(parents=True, exist_ok=True)
        _write(file, episodes[at : at + part.episodes], at, part.extra)
        at += part.episodes
    # last, because readers begin with it
    _write(path, (), 0, episode_set.extra)


def _write(path: Path, episodes: Sequence[RearrangeEpisode], first: int, extra: Mapping[str, Any]) -> None:
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as raw:
            if path.name.endswith(".gz"):
                # no name and no time of day inside: the same episodes give the same bytes
                with gzip.GzipFile(filename="", mode="wb", fileobj=raw, compresslevel=6, mtime=0) as packed:
                    packed.writelines(_pieces(episodes, first, extra))
            else:
                raw.writelines(_pieces(episodes, first, extra))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _pieces(episodes: Sequence[RearrangeEpisode], first: int, extra: Mapping[str, Any]) -> Iterator[bytes]:
    yield b"{"
    for key, value in extra.items():
        if key == "episodes":
            raise InputError("extra must not hold 'episodes': they are in EpisodeSet.episodes", code="H3-HABITAT-012")
        yield encode_json(key, "extra") + b":" + encode_json(value, f"extra.{key}") + b","
    yield b'"episodes":['
    for k, episode in enumerate(episodes):
        yield (b"," if k else b"") + encode_episode(episode, where=f"episodes[{first + k}]")
    yield b"]}"
