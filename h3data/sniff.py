"""What a file is, told from its content."""

from __future__ import annotations

import gzip
import json
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal

from h3data.errors import FormatError, InputError

FileKind = Literal[
    "gfx_replay", "hitl_session", "hitl_episode", "hitl_log", "rearrange_episodes", "scene_dataset_config",
    "scene_instance", "stage_config", "object_config", "ao_config", "lighting_config", "semantic_config", "physics_config",
    "scene_filter", "json", "mcap", "parquet", "rrd", "glb", "navmesh", "pickle", "zip", "unknown",
]  # fmt: skip

KIND_WORDS: dict[str, str] = {
    "gfx_replay": "a gfx-replay recording",
    "hitl_session": "a human-in-the-loop session (habitat-lab rearrange_v2)",
    "hitl_episode": "an episode of a human-in-the-loop session (habitat-lab rearrange_v2)",
    "hitl_log": "a human-in-the-loop log of the first generation (habitat-lab rearrange)",
    "rearrange_episodes": "an episode dataset",
    "scene_dataset_config": "a scene dataset configuration",
    "scene_instance": "a scene instance",
    "stage_config": "a stage configuration",
    "object_config": "an object configuration",
    "ao_config": "an articulated object configuration",
    "lighting_config": "a lighting configuration",
    "semantic_config": "a semantic configuration",
    "physics_config": "a physics configuration",
    "scene_filter": "a receptacle filter",
    "json": "JSON of an unknown kind",
}

UNPACKED_BYTES = 64 << 20
UNPACKED_RATIO = 200
"""Gzip data may unpack to so many bytes, or to so many times their own size (JSON of recordings: 5 to 30 times)."""

CHUNK_BYTES = 1 << 20
"""So much of a file is read at once."""

_MAGIC: tuple[tuple[bytes, FileKind], ...] = (
    (b"\x89MCAP0\r\n", "mcap"),
    (b"PAR1", "parquet"),
    (b"RRF", "rrd"),
    (b"glTF", "glb"),
    (b"TESM", "navmesh"),
    (b"PK\x03\x04", "zip"),
    (b"\x80\x03", "pickle"),
    (b"\x80\x04", "pickle"),
    (b"\x80\x05", "pickle"),
)

BYTE_ORDER_MARK = b"\xef\xbb\xbf"

REPLAY_MEMBERS = frozenset({
    "loads", "rigCreations", "creations", "metadata", "deletions", "stateUpdates", "rigUpdates", "userTransforms",
    "lights", "lightsChanged",
})  # fmt: skip
"""What a keyframe of a gfx-replay can hold (spec/habitat.md 5.1)."""

_REPLAY = re.compile(
    rb"""\s*\{\s*"keyframes"\s*:\s*\[\s*(?:\{\s*\}\s*,\s*)*(?:\]|\{\s*\}\s*\]|\{\s*"(?:%s)"\s*:)"""
    % b"|".join(name.encode() for name in sorted(REPLAY_MEMBERS))
)
"""The beginning of a gfx-replay as habitat-sim writes it."""


def sniff(path: str | Path) -> FileKind:
    """The kind of a file, from its content (gzip is looked through); a name only decides between sorts of config.

    Of a gfx-replay as habitat-sim writes them only the beginning is read. NaN and Infinity, which are not JSON, are
    looked through as well: what cannot be read is still of a kind.
    """
    path = Path(path)
    try:
        chunks = byte_chunks(path)
        head = next(chunks, b"")
        for magic, kind in _MAGIC:
            if head.startswith(magic):
                return kind
        if _REPLAY.match(head.removeprefix(BYTE_ORDER_MARK)):
            return "gfx_replay"
        data = b"".join([head, *chunks])
    except FormatError:
        return "unknown"
    return content_kind(data, name=path.name)


def content_kind(data: bytes, *, name: str = "") -> FileKind:
    """The kind of JSON text; "unknown" if it is none. Members that do not tell are not unfolded: files may be long."""
    import msgspec

    try:
        members = decode_json(data, dict[str, msgspec.Raw])
        return json_kind({key: _glimpse(key, bytes(text)) for key, text in members.items()}, name=name)
    except msgspec.ValidationError:
        return "json"
    except msgspec.DecodeError:
        pass
    try:
        return json_kind(json.loads(data.removeprefix(BYTE_ORDER_MARK)), name=name)
    except (ValueError, RecursionError):
        return "unknown"


def _glimpse(key: str, text: bytes) -> Any:
    """What `json_kind` looks at: the keyframes of a replay, of all others whether they are objects."""
    if key in ("keyframes", "keyframe"):
        return decode_json(text)
    return {} if text.startswith(b"{") else None


def json_kind(content: Any, *, name: str = "") -> FileKind:
    """The kind of a parsed JSON document."""
    if not isinstance(content, dict):
        return "json"
    keys = set(content)
    rules: tuple[tuple[bool, FileKind], ...] = (
        (_is_replay(content), "gfx_replay"),
        ({"session", "users", "episodes"} <= keys, "hitl_session"),
        ({"session", "episode", "frames"} <= keys, "hitl_episode"),
        ("steps" in keys and bool(keys & {"episode_id", "scene_id", "start_time"}), "hitl_log"),
        ("episodes" in keys, "rearrange_episodes"),
        ("stage_instance" in keys or "object_instances" in keys, "scene_instance"),
        ("region_annotations" in keys, "semantic_config"),
        ("lights" in keys and "stages" not in keys, "lighting_config"),
        ("active" in keys and "manually_filtered" in keys, "scene_filter"),
        (_is_dataset(content), "scene_dataset_config"),
        ("urdf_filepath" in keys or ".ao_config." in name, "ao_config"),
        (".physics_config." in name or "physics_simulator" in keys, "physics_config"),
        (".stage_config." in name or bool(keys & {"gravity", "nav_asset", "semantic_asset"}), "stage_config"),
        (".object_config." in name or "render_asset" in keys, "object_config"),
    )
    for fits, kind in rules:
        if fits:
            return kind
    return "json"


def read_bytes(path: Path) -> bytes:
    """The content of a file, unpacked if it is gzip; `InputError` if there is none, `FormatError` if it is damaged."""
    return b"".join(byte_chunks(path))


def byte_chunks(path: Path, size: int = CHUNK_BYTES) -> Iterator[bytes]:
    """The same in pieces of at most ``size`` bytes.

    Gzip data may unpack to `UNPACKED_BYTES`, or to `UNPACKED_RATIO` times their own size.
    """
    try:
        with path.open("rb") as raw:
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            if packed:
                yield from _unpacked(raw, path, size)
            else:
                while chunk := raw.read(size):
                    yield chunk
    except FileNotFoundError:
        raise InputError(f"There is no such file: {path}") from None
    except IsADirectoryError:
        raise InputError(f"Expected a file, this is a folder: {path}") from None
    except OSError as error:
        raise InputError(f"The file cannot be read ({error.strerror}): {path}") from None


def _unpacked(raw: BinaryIO, path: Path, size: int) -> Iterator[bytes]:
    """The content of gzip data, as long as it is not out of all proportion to their size."""
    packed = raw.seek(0, os.SEEK_END)
    raw.seek(0)
    most, total = max(UNPACKED_RATIO * packed, UNPACKED_BYTES), 0
    with gzip.GzipFile(fileobj=raw) as stream:
        while True:
            try:
                chunk = stream.read(size)
            except (OSError, EOFError, zlib.error) as fault:
                raise FormatError(
                    f"The gzip data are damaged or cut off ({fault}). Hint: copy the file again. {path}"
                ) from None
            total += len(chunk)
            if total > most:
                raise FormatError(
                    f"The {packed} bytes of gzip data unpack to more than {most >> 20} MiB, so they are not read. Hint: if "
                    f"that is right, unpack the file first. {path}"
                )
            if not chunk:
                return
            yield chunk


def decode_json(data: bytes, kind: Any = Any) -> Any:
    """The JSON document as ``kind``; every fault is a `msgspec.DecodeError`. A byte order mark is skipped."""
    import msgspec

    try:
        return msgspec.json.decode(data.removeprefix(BYTE_ORDER_MARK), type=kind)
    except RecursionError:
        raise msgspec.DecodeError("JSON is malformed: brackets are nested too deep") from None
    except UnicodeDecodeError as fault:
        raise msgspec.DecodeError(f"JSON is malformed: a text is not UTF-8 ({fault.reason})") from None


def read_json(path: Path) -> tuple[bytes, Any]:
    """Bytes and content of a JSON file (gzip allowed); `FormatError` says where it stops being JSON."""
    import msgspec

    data = read_bytes(path)
    try:
        return data, decode_json(data)
    except msgspec.DecodeError as fault:
        raise not_json(path, data, fault) from None


def not_json(path: Path, data: bytes, fault: Exception, *, start: int = 0) -> FormatError:
    """The error for bytes that are not a JSON document; they begin at byte ``start`` of the file."""
    text = str(fault)
    if not data.strip():
        return FormatError(f"Expected JSON, the file is empty: {path}")
    if "truncated" in text:
        return truncated(path, start + len(data))
    binary = next((kind for magic, kind in _MAGIC if data.startswith(magic)), None)
    if binary is not None:
        return FormatError(f"Expected JSON, this is a {binary} file: {path}")
    infinite = _not_finite(data.removeprefix(BYTE_ORDER_MARK), text, start)
    if infinite is not None:
        return FormatError(f"{infinite}, which is no number in JSON. Hint: mend it where the file was made. {path}")
    text = re.sub(
        r"\(byte (\d+)\)", lambda at: f"(byte {int(at[1]) + start})", text.removeprefix("JSON is malformed: ")
    )
    return FormatError(f"Expected JSON, this is not: {text}: {path}")


def truncated(path: Path, size: int) -> FormatError:
    """The error for a JSON document of ``size`` bytes that goes on."""
    return FormatError(
        f"The JSON breaks off at its end (byte {size}): the file is truncated. Hint: copy it again. {path}"
    )


def _not_finite(data: bytes, fault: str, start: int) -> str | None:
    """Where the NaN or infinity stands at which JSON ends, as Python and NumPy write them; None if it is another fault."""
    at = re.search(r"\(byte (\d+)\)", fault)
    found = re.compile(rb"-?(?:NaN|Infinity)").match(data, int(at[1])) if at else None
    if found is None:
        return None
    keys = re.findall(rb'"((?:[^"\\]|\\.)*)"\s*:', data[: found.start()])
    under = f"under {keys[-1].decode(errors='replace')!r} " if keys else ""
    return f"{found[0].decode()} {under}(byte {start + found.start()})"


def _is_replay(content: dict[str, Any]) -> bool:
    """Whether there are keyframes that hold what a gfx-replay's can hold, or nothing at all."""
    keyframes = content.get("keyframes", [content["keyframe"]] if "keyframe" in content else None)
    if not isinstance(keyframes, list):
        return False
    found = [keyframe for keyframe in keyframes if isinstance(keyframe, dict)]
    return not any(found) or any(not REPLAY_MEMBERS.isdisjoint(keyframe) for keyframe in found)


def _is_dataset(content: dict[str, Any]) -> bool:
    sections = {"stages", "objects", "articulated_objects", "light_setups", "scene_instances"}
    found = sections & set(content)
    return bool(found) and all(isinstance(content[s], dict) for s in found)
