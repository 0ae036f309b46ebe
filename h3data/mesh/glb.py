"""GLB containers (glTF 2.0 binary): the JSON document, the binary chunk, and records for all writers."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.geometry import Array, normalized
from h3data.mesh.png import png_bytes

FLOAT32, UINT32, UINT16, INT16, UINT8 = 5126, 5125, 5123, 5122, 5121
"""Values of ``componentType`` of an accessor."""
VERTICES, INDICES = 34962, 34963
"""Values of ``target`` of a buffer view."""

_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\x00"


GLTF_1_HINT = "which is not read. Hint: npx gltf-pipeline -i IN.gltf -o OUT.glb converts it to glTF 2.0."


class GlbChunk:
    """Binary chunk of a GLB under construction, with its buffer views and accessors."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: Any) -> int:
        """Append bytes; return the index of their view."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more})
        # glTF wants views to begin at multiples of the size of their components, which is 4 at most
        padded = data + bytes(-len(data) % 4)
        self.parts.append(padded)
        self.size += len(padded)
        return len(self.views) - 1

    def array(self, values: NDArray[Any], kind: str, component: int, target: int | None = None, **more: Any) -> int:
        """Append an array as one accessor (``kind`` such as ``VEC3``); return its index."""
        view = self.view(values.tobytes(), **({} if target is None else {"target": target}))
        self.accessors.append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind, **more}
        )
        return len(self.accessors) - 1

    def vectors(self, values: NDArray[Any], *, limits: bool = False) -> int:
        """Append float32 vectors per vertex, shape [V, 2..4].

        Return their accessor. glTF requires ``limits`` for positions.
        """
        values = values.astype("<f4")
        more = {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if limits else {}
        return self.array(values, f"VEC{values.shape[1]}", FLOAT32, VERTICES, **more)

    def triangles(self, faces: NDArray[Any], component: int = UINT32) -> int:
        """Append vertex indices of triangles; return their accessor."""
        kind = {UINT16: "<u2", UINT32: "<u4"}[component]
        return self.array(faces.astype(kind).ravel(), "SCALAR", component, INDICES)

    def image(self, pixels: NDArray[np.uint8], name: str, *, gray: bool) -> dict[str, Any]:
        """Append texels [H, W, 4] as PNG; return the image's record."""
        return {"bufferView": self.view(png_bytes(pixels, gray=gray)), "mimeType": "image/png", "name": name}

    def part(self, index: int, start: int, count: int) -> int:
        """Append an accessor for a range of elements of another one, which holds 32-bit scalars; return its index."""
        self.accessors.append({**self.accessors[index], "byteOffset": 4 * start, "count": count})
        return len(self.accessors) - 1

    def lists(self) -> dict[str, Any]:
        """Return the members of the document that describe the contents of the chunk."""
        return {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.size}],
        }


def gltf_document(
    scene: Mapping[str, Any], *, about: Mapping[str, Any] | None = None, **members: Any
) -> dict[str, Any]:
    """Return a glTF document of one scene; ``about`` becomes ``asset.extras``."""
    asset = {"version": "2.0", "generator": "h3data", **({} if about is None else {"extras": about})}
    return {"asset": asset, "scene": 0, "scenes": [scene], **members}


def placement(pose: Array, scale: Array) -> dict[str, Any]:
    """Return the members of a glTF node for its pose7 and scale, both float64."""
    rotation = np.clip(normalized(pose[3:]), -1, 1)  # validators refuse 1.0000000000000002
    return {"translation": pose[:3].tolist(), "rotation": rotation.tolist(), "scale": scale.tolist()}


def matte(texture: int | None = None, **more: Any) -> dict[str, Any]:
    """Return a material's ``pbrMetallicRoughness`` without gloss, with a base colour texture if one is given."""
    base = {} if texture is None else {"baseColorTexture": {"index": texture}}
    return {**base, "metallicFactor": 0.0, "roughnessFactor": 1.0, **more}


def cutout(pixels: NDArray[np.uint8]) -> dict[str, Any]:
    """Return the members of a material for the opacity of its texture [H, W, 4], empty if it is opaque."""
    return {} if (pixels[..., 3] == 255).all() else {"alphaMode": "MASK"}


def pack_glb(document: Mapping[str, Any], chunk: GlbChunk) -> bytes:
    """Return the bytes of a GLB; ``document`` already holds the chunk's views and accessors.

    Raises:
        TypeError, ValueError: the document is not plain JSON, or has numbers that are not finite.
    """
    text = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()
    # chunks end at multiples of 4 bytes: JSON with spaces, data with zeros (glTF 2.0, 4.4.3)
    chunks = [(_JSON, text + b" " * (-len(text) % 4))]
    if chunk.size:
        chunks.append((_BIN, b"".join(chunk.parts)))
    body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
    return _MAGIC + struct.pack("<II", 2, 12 + len(body)) + body


def unpack_glb(data: bytes, where: str, *, what: str = "a GLB") -> tuple[dict[str, Any], memoryview]:
    """Return the JSON document and binary chunk (a view of ``data``, maybe empty) of a GLB.

    Args:
        data: the bytes of the file.
        where: path of the file, for error texts.
        what: kind of file that was expected, for error texts.

    Raises:
        FormatError: the bytes are not a GLB, truncated or damaged.
    """
    if data[:4] != _MAGIC:
        raise FormatError(f"Expected {what} (first bytes 'glTF'), got {data[:4]!r}. File: {where}", code="H3-MESH-001")
    if len(data) < 20:
        raise FormatError(
            f"Truncated GLB: a header needs 20 bytes, there are {len(data)}. File: {where}", code="H3-MESH-002"
        )
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        hint = f", {GLTF_1_HINT}" if version == 1 else "."
        raise FormatError(f"Expected glTF version 2, got {version}{hint} File: {where}", code="H3-MESH-003")
    if length > len(data):
        raise FormatError(
            f"Truncated GLB: its header says {length} bytes, there are {len(data)}. File: {where}", code="H3-MESH-004"
        )
    chunks: dict[bytes, memoryview] = {}
    view = memoryview(data)
    at = 12
    while at + 8 <= length:
        (size,), kind = struct.unpack_from("<I", data, at), data[at + 4 : at + 8]
        if at + 8 + size > length:
            raise FormatError(
                f"Damaged GLB: chunk {kind!r} of {size} bytes runs past its end. File: {where}", code="H3-MESH-006"
            )
        # the first of each kind; chunks of unknown kinds are passed over, as the specification asks of readers
        chunks.setdefault(kind, view[at + 8 : at + 8 + size])
        at += 8 + size
    try:
        document = json.loads(bytes(chunks[_JSON]))
    except (KeyError, ValueError, RecursionError) as error:
        raise FormatError(f"Damaged GLB: it has no readable JSON chunk. File: {where}", code="H3-MESH-007") from error
    if not isinstance(document, dict):
        raise FormatError(f"Damaged GLB: its JSON is not an object. File: {where}", code="H3-MESH-005")
    return document, chunks.get(_BIN, memoryview(b""))
