"""The frame of a GLB file (glTF 2.0 binary): its JSON, its binary chunk, and the arrays in it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from h3data.errors import FormatError

FLOAT32, UINT32, UINT16, INT16, UINT8 = 5126, 5125, 5123, 5122, 5121
"""Kinds of component."""
VERTICES, INDICES = 34962, 34963
"""What a buffer view is for."""

_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\x00"


class GlbChunk:
    """The binary chunk that is being filled, with its buffer views and accessors."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: Any) -> int:
        """Appends bytes and gives the index of their view."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more})
        padded = data + bytes(-len(data) % 4)
        self.parts.append(padded)
        self.size += len(padded)
        return len(self.views) - 1

    def array(self, values: NDArray[Any], kind: str, component: int, target: int | None = None, **more: Any) -> int:
        """Appends one accessor (``kind`` as ``VEC3``) and gives its index."""
        view = self.view(values.tobytes(), **({} if target is None else {"target": target}))
        self.accessors.append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind, **more}
        )
        return len(self.accessors) - 1

    def part(self, index: int, start: int, count: int) -> int:
        """Appends an accessor of some elements of another one, which holds 32-bit scalars, and gives its index."""
        self.accessors.append({**self.accessors[index], "byteOffset": 4 * start, "count": count})
        return len(self.accessors) - 1

    def lists(self) -> dict[str, Any]:
        """The members of the document that describe what is in the chunk."""
        return {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.size}],
        }


def pack_glb(document: Mapping[str, Any], chunk: GlbChunk) -> bytes:
    """The bytes of a GLB; ``document`` is its JSON, with the chunk's views and accessors already in it.

    Raises:
        TypeError, ValueError: the document is not plain JSON, or has numbers that are not finite.
    """
    text = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()
    chunks = [(_JSON, text + b" " * (-len(text) % 4))]
    if chunk.size:
        chunks.append((_BIN, b"".join(chunk.parts)))
    body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
    return _MAGIC + struct.pack("<II", 2, 12 + len(body)) + body


def unpack_glb(data: bytes, where: str, *, what: str = "a GLB") -> tuple[dict[str, Any], memoryview]:
    """JSON document and binary chunk (a view of ``data``, maybe empty); ``what`` and ``where`` are for messages.

    Raises:
        FormatError: it is something else, cut off or damaged.
    """
    if data[:4] != _MAGIC:
        raise FormatError(f"Expected {what} (first bytes 'glTF'), got {data[:4]!r}. File: {where}")
    if len(data) < 20:
        raise FormatError(f"Truncated GLB: a header needs 20 bytes, there are {len(data)}. File: {where}")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FormatError(f"Expected glTF version 2, got {version}. File: {where}")
    if length > len(data):
        raise FormatError(f"Truncated GLB: its header says {length} bytes, there are {len(data)}. File: {where}")
    chunks: dict[bytes, memoryview] = {}
    view = memoryview(data)
    at = 12
    while at + 8 <= length:
        (size,), kind = struct.unpack_from("<I", data, at), data[at + 4 : at + 8]
        if at + 8 + size > length:
            raise FormatError(f"Damaged GLB: chunk {kind!r} of {size} bytes runs past its end. File: {where}")
        chunks.setdefault(kind, view[at + 8 : at + 8 + size])
        at += 8 + size
    try:
        document = json.loads(bytes(chunks[_JSON]))
    except (KeyError, ValueError, RecursionError) as error:
        raise FormatError(f"Damaged GLB: it has no readable JSON chunk. File: {where}") from error
    if not isinstance(document, dict):
        raise FormatError(f"Damaged GLB: its JSON is not an object. File: {where}")
    return document, chunks.get(_BIN, memoryview(b""))
