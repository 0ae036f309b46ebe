"""Conversion of episodes of habitat-lab from and to JSON, with errors that name the key."""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.recording.task_episodes.rearrange_episode import (
    RIGID_TOLERANCE,
    Marker,
    Matrix,
    RearrangeEpisode,
    RigidObject,
    handles_of,
    is_rigid,
)

_Row = tuple[float, float, float, float]
_Rows = tuple[_Row, _Row, _Row, _Row]
_Receptacles = list[tuple[str, int | None]]

KEYS: dict[str, Any] = {
    "episode_id": str | int,
    "scene_id": str,
    "scene_dataset_config": str,
    "additional_obj_config_paths": list[str],
    "start_position": tuple[float, float, float],
    "start_rotation": _Row,
    "info": dict[str, Any],
    "ao_states": dict[str, dict[int, float]],
    "rigid_objs": list[tuple[str, _Rows]],
    "targets": dict[str, _Rows],
    "markers": list[dict[str, Any]],
    "target_receptacles": _Receptacles,
    "goal_receptacles": _Receptacles,
    "name_to_receptacle": dict[str, str],
}
"""Known keys of an episode, in Habitat's order, and their JSON types."""

_DECODERS = {key: msgspec.json.Decoder(kind) for key, kind in KEYS.items()}
_FIELDS = {"rigid_objs": "rigid_objects"}
_OLDER = {"info": b"null", "markers": b"{"}
"""Beginnings of values that other versions of Habitat wrote and nothing reads any more; they are kept in ``extra``."""
_OBJECT = msgspec.json.Decoder(dict[str, msgspec.Raw])
_BLOCK = 1000
"""Number of episodes that are decoded at once; their matrices become one array before the next block is read."""


@dataclass
class Notes:
    """Irregularities of a file, counted by kind, each with its first place."""

    path: Path
    strict: bool
    found: dict[str, tuple[int, str]] = field(default_factory=dict)

    def add(self, what: str, where: str) -> None:
        """Count an irregularity and store its first place; with ``strict``, raise a `FormatError`."""
        if self.strict:
            raise FormatError(f"{where}: {what}: {self.path}", code="H3-HABITAT-018")
        count, first = self.found.get(what, (0, f"{where} in {self.path.name}"))
        self.found[what] = (count + 1, first)

    def texts(self) -> tuple[str, ...]:
        """Return one line for each kind of irregularity, with its count and its first place."""
        return tuple(f"{what}: {count} times, first at {first}" for what, (count, first) in self.found.items())


@dataclass
class _Draft:
    """An episode whose matrices still lie in the block's list."""

    fields: dict[str, Any]
    configs: list[str]
    handles: list[str]


def decode_episodes(raws: Sequence[msgspec.Raw], notes: Notes) -> list[RearrangeEpisode]:
    """Decode episodes from JSON; irregularities are added to ``notes``.

    Raises:
        FormatError: an episode is malformed; the message names its key.
    """
    episodes: list[RearrangeEpisode] = []
    for start in range(0, len(raws), _BLOCK):
        rows: list[_Rows] = []
        drafts = [_draft(raw, start + k, rows, notes.path) for k, raw in enumerate(raws[start : start + _BLOCK])]
        flat = chain.from_iterable(chain.from_iterable(rows))
        block = np.fromiter(flat, np.float64, count=16 * len(rows)).reshape(-1, 4, 4)
        # matrices of many episodes are views of it
        block.flags.writeable = False
        rigid = is_rigid(block)
        at = 0
        for k, draft in enumerate(drafts):
            size = len(draft.configs) + len(draft.handles)
            episode = _finished(draft, block[at : at + size])
            _check(episode, draft, rigid[at : at + size], start + k, notes)
            episodes.append(episode)
            at += size
    return episodes


def _draft(raw: msgspec.Raw, index: int, rows: list[_Rows], path: Path) -> _Draft:
    where = f"episodes[{index}]"
    try:
        found = _OBJECT.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError) as fault:
        raise FormatError(f"{where}: {_reworded(fault)}: {path}", code="H3-HABITAT-019") from None
    missing = [key for key in ("episode_id", "scene_id") if key not in found]
    if missing:
        raise FormatError(f"{where} lacks {' and '.join(missing)}: {path}", code="H3-HABITAT-013")
    values: dict[str, Any] = {}
    extra: dict[str, Any] = {}
    for key, text in found.items():
        decoder = _DECODERS.get(key)
        try:
            # kept as it is, so that writing the episode again loses nothing
            if decoder is None or (key in _OLDER and bytes(text).startswith(_OLDER[key])):
                extra[key] = msgspec.json.decode(text)
            else:
                values[key] = decoder.decode(text)
        except (msgspec.DecodeError, UnicodeDecodeError) as fault:
            raise FormatError(f"{_located(where, key, fault, text)}: {path}", code="H3-HABITAT-023") from None
        except RecursionError:
            raise FormatError(f"{where}.{key} is nested too deeply: {path}", code="H3-HABITAT-024") from None
    absent = _shared(frozenset(KEYS.keys() - values.keys()))
    objects = values.pop("rigid_objs", ())
    targets = values.pop("targets", {})
    if targets:
        _no_twins(found["targets"], targets, f"{where}.targets", path)
    rows += [matrix for _, matrix in objects]
    rows += targets.values()
    fields = {
        key: tuple(value) if isinstance(value, list) else sys.intern(value) if isinstance(value, str) else value
        for key, value in values.items()
    }
    if "markers" in fields:
        fields["markers"] = tuple(_marker(m, f"{where}.markers[{k}]", path) for k, m in enumerate(values["markers"]))
    if "info" in values:
        _check_labels(values["info"].get("object_labels"), f"{where}.info.object_labels", path)
    fields |= {"extra": extra, "absent": absent}
    return _Draft(fields, [sys.intern(config) for config, _ in objects], list(targets))


@lru_cache(256)
def _shared(keys: frozenset[str]) -> frozenset[str]:
    """Return the first set that was equal to ``keys``: 37,000 episodes lack the same ones."""
    return keys


def _finished(draft: _Draft, matrices: Matrix) -> RearrangeEpisode:
    split = len(draft.configs)
    return RearrangeEpisode(
        rigid_objects=tuple(map(RigidObject, draft.configs, matrices[:split])),
        targets=dict(zip(draft.handles, matrices[split:], strict=True)),
        **draft.fields,
    )


def _check(episode: RearrangeEpisode, draft: _Draft, rigid: NDArray[np.bool_], index: int, notes: Notes) -> None:
    """Note what Habitat would stumble over, though the file can be read."""
    where = f"episodes[{index}]"
    if not rigid.all():
        at = int(np.argmin(rigid))
        split = len(draft.configs)
        place = f"rigid_objs[{at}][1]" if at < split else f"targets[{draft.handles[at - split]!r}]"
        notes.add("a matrix is not a rotation and a translation", f"{where}.{place}")
    if abs(math.hypot(*episode.start_rotation) - 1) > RIGID_TOLERANCE:
        notes.add("start_rotation is not a unit quaternion", where)
    if draft.handles and draft.configs:
        strangers = set(draft.handles).difference(handles_of(draft.configs))
        if strangers:
            notes.add("a target is no object of the episode", f"{where}.targets[{min(strangers)!r}]")


def _no_twins(text: msgspec.Raw, targets: dict[str, Any], where: str, path: Path) -> None:
    """Refuse an object that has a key twice: JSON readers silently keep the last one."""
    raw = bytes(text)
    # five brackets for each matrix: more of them mean that a key was there twice
    if raw.count(b"[") == 5 * len(targets) + sum(handle.count("[") for handle in targets):
        return
    pairs = json.loads(raw, object_pairs_hook=lambda pairs: pairs)
    twins = [handle for handle, count in Counter(handle for handle, _ in pairs).items() if count > 1]
    if twins:
        raise FormatError(
            f"{where} has the handle {twins[0]!r} twice. Hint: which goal is right? {path}", code="H3-HABITAT-014"
        )


def _check_labels(labels: Any, where: str, path: Path) -> None:
    if labels is None:
        return
    if not isinstance(labels, dict) or not all(isinstance(label, str) for label in labels.values()):
        raise FormatError(f"{where}: Expected an object of names by handle: {path}", code="H3-HABITAT-015")


def _marker(content: dict[str, Any], where: str, path: Path) -> Marker:
    params = content.get("params")
    if not isinstance(params, dict):
        raise FormatError(
            f"{where}.params: Expected an object with offset, link and object: {path}", code="H3-HABITAT-016"
        )
    extra = {key: value for key, value in content.items() if key not in ("name", "type", "params")}
    unknown = {key: value for key, value in params.items() if key not in ("offset", "link", "object")}
    if unknown:
        extra["params"] = unknown
    known = {"name": content.get("name"), "kind": content.get("type"), "extra": extra}
    try:
        return msgspec.convert({**known, **{key: params.get(key) for key in ("offset", "link", "object")}}, Marker)
    except msgspec.ValidationError as fault:
        raise FormatError(f"{_located(where, '', fault)}: {path}", code="H3-HABITAT-020") from None


def _located(where: str, key: str, fault: Exception, text: msgspec.Raw | None = None) -> str:
    """Return ``episodes[3].rigid_objs[0][1]: Expected ...`` from msgspec's words about the ``text`` of ``key``."""
    words, _, place = str(fault).partition(" - at ")
    inner = match[0][1:] if (match := re.search(r"\$[^`]*", place)) else ""
    if text is not None and inner.startswith("[...]"):
        inner = f"[{_culprit(key, text)!r}]{inner[5:]}"
    hint = ""
    if key == "rigid_objs" and "got `int`" in words:
        hint = " (a number in place of the matrix refers to a separate file of transformations, which is not supported)"
    return f"{where}.{key}{inner}: {_reworded(words)}{hint}" if key else f"{where}{inner}: {_reworded(words)}"


def _culprit(key: str, text: msgspec.Raw) -> str:
    """Return which entry of an object has the wrong type, because msgspec does not say."""
    # only after a fault, so that it may be slow
    decoder = msgspec.json.Decoder(get_args(KEYS[key])[1])
    for name, entry in _OBJECT.decode(text).items():
        try:
            decoder.decode(entry)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return name
    return "..."


def _reworded(fault: object) -> str:
    return str(fault).partition(" - at ")[0].replace("`", "")


def encode_episode(episode: RearrangeEpisode, *, where: str = "episode") -> bytes:
    """Return the JSON object of one episode with keys in Habitat's order; ``where`` names the episode in errors."""
    names = [key for key in KEYS if key not in episode.absent]
    # both would be written, and readers keep the last one
    clash = set(names) & set(episode.extra)
    if clash:
        raise InputError(
            f"{where}: extra must not hold {sorted(clash)}, which are fields of the record", code="H3-HABITAT-017"
        )
    matrices = [thing.matrix for thing in episode.rigid_objects] + list(episode.targets.values())
    for matrix in matrices:
        if np.shape(matrix) != (4, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{where}: Expected finite matrices of shape [4, 4], got\n{matrix}", code="H3-HABITAT-021")
    content = {key: getattr(episode, _FIELDS.get(key, key)) for key in names}
    content |= {
        key: made(content[key])
        for key, made in (("rigid_objs", _objects_json), ("markers", _markers_json), ("targets", _targets_json))
        if key in content
    }
    return encode_json({**content, **episode.extra}, where)


def _objects_json(objects: Sequence[RigidObject]) -> list[Any]:
    return [[thing.config, np.asarray(thing.matrix, np.float64).tolist()] for thing in objects]


def _targets_json(targets: Mapping[str, Matrix]) -> dict[str, Any]:
    return {handle: np.asarray(matrix, np.float64).tolist() for handle, matrix in targets.items()}


def _markers_json(markers: Sequence[Marker]) -> list[Any]:
    out = []
    for m in markers:
        params = {"offset": m.offset, "link": m.link, "object": m.object, **m.extra.get("params", {})}
        out.append({"name": m.name, "type": m.kind, **m.extra, "params": params})
    return out


def encode_json(content: Any, where: str) -> bytes:
    """Encode a value as compact JSON.

    Raises:
        InputError: the value contains a number that is not finite, or a type that JSON does not support; the message
            names ``where``.
    """
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    except (ValueError, TypeError, RecursionError) as fault:
        raise InputError(f"{where} cannot be written as JSON: {fault}", code="H3-HABITAT-022") from None
