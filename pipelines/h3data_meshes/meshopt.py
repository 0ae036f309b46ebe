"""Decoder of the glTF extension EXT_meshopt_compression, from its specification (appendices A and B).

Python has no maintained decoder (meshoptimizer's bindings are an alpha that needs a C++ compiler), and files of
gltfpack are common. Compiled kernels read the bit streams and check every byte access. The filters are plain NumPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.kernels import kernel

BYTES_MAX = 1 << 30
"""Largest uncompressed size of a view [bytes]; larger ones are refused before memory is allocated."""
_ATTRIBUTES, _TRIANGLES, _INDICES = 0xA0, 0xE1, 0xD1
"""First byte of a stream of each mode."""
_BLOCK_BYTES, _BLOCK_ELEMENTS, _GROUP = 8192, 256, 16
_TAIL_BYTES = 32
_FIFO = 16
_FILTER_STRIDES = {"OCTAHEDRAL": (4, 8), "QUATERNION": (8,), "EXPONENTIAL": tuple(range(4, 257, 4))}
_ENDS_EARLY, _NOT_USED_UP = 1, 2


def decode_view(data: bytes | memoryview, *, mode: str, filter: str, count: int, stride: int) -> NDArray[np.uint8]:
    """Return the bytes [count * stride] of a compressed buffer view.

    Args:
        data: Compressed stream, without further bytes.
        mode: ``ATTRIBUTES``, ``TRIANGLES`` or ``INDICES``.
        filter: ``NONE``, ``OCTAHEDRAL``, ``QUATERNION`` or ``EXPONENTIAL``.
        count: Number of elements.
        stride: Bytes per element.

    Raises:
        ValueError: The stream is damaged, has a later version, or does not fit the other arguments.
    """
    stream = np.frombuffer(data, np.uint8)
    if count * stride > BYTES_MAX:
        raise ValueError(f"it unpacks to {count * stride} bytes, the limit is {BYTES_MAX}")
    head = {"ATTRIBUTES": _ATTRIBUTES, "TRIANGLES": _TRIANGLES, "INDICES": _INDICES}.get(mode)
    if head is None:
        raise ValueError(f"its mode is {mode!r}, expected ATTRIBUTES, TRIANGLES or INDICES")
    fits = (stride % 4 == 0 and 4 <= stride <= 256) if mode == "ATTRIBUTES" else stride in (2, 4)
    if not fits or (mode == "TRIANGLES" and count % 3) or (filter != "NONE" and mode != "ATTRIBUTES"):
        raise ValueError(f"{count} elements of {stride} bytes do not go with mode {mode}, filter {filter}")
    if filter != "NONE" and stride not in _FILTER_STRIDES.get(filter, ()):
        raise ValueError(f"its filter is {filter!r} for {stride} bytes, expected NONE, {', '.join(_FILTER_STRIDES)}")
    if not len(stream) or stream[0] != head:
        raise ValueError(f"its stream starts with {bytes(stream[:1]).hex() or 'nothing'}, expected {head:02x} ({mode})")
    if mode == "ATTRIBUTES":
        out = np.zeros((count, stride), np.uint8)
        _check(_unpack_attributes(stream, out))
        return (_FILTERS[filter](out) if filter != "NONE" else out).reshape(-1)
    indices = np.zeros(count, np.uint32)
    _check(_unpack_triangles(stream, indices) if mode == "TRIANGLES" else _unpack_indices(stream, indices))
    if stride == 2 and count and indices.max() > 0xFFFF:
        raise ValueError(f"index {indices.max()} does not fit into 16 bits")
    return indices.astype(f"<u{stride}").view(np.uint8)


def _check(status: int) -> None:
    if status:
        raise ValueError("its stream ends early" if status == _ENDS_EARLY else "its stream has bytes left over")


# --- bit streams (appendix A) -----------------------------------------------------------------------------------------
@kernel()
def _unpack_attributes(data: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Unpack mode 0: bytes of equal place in successive elements, as differences in groups of 16."""
    count, stride = out.shape
    tail = max(stride, _TAIL_BYTES)
    end = len(data) - tail
    if end < 1:
        return _ENDS_EARLY
    last = data[len(data) - stride :].copy()
    block = min((_BLOCK_BYTES // stride) & ~(_GROUP - 1), _BLOCK_ELEMENTS)
    at = 1
    group = np.zeros(_GROUP, np.uint8)
    for first in range(0, count, block):
        size = min(block, count - first)
        groups = (size + _GROUP - 1) // _GROUP
        for place in range(stride):
            heads = at
            at += (groups + 3) // 4
            if at > end:
                return _ENDS_EARLY
            value = last[place]
            for g in range(groups):
                kind = (data[heads + g // 4] >> (2 * (g % 4))) & 3
                bits = 8 if kind == 3 else 2 * kind
                extra = at + 2 * bits  # sentinels' bytes follow the 16 short codes
                if extra > end:
                    return _ENDS_EARLY
                for k in range(_GROUP):
                    if bits == 0:
                        code = 0
                    elif bits == 8:
                        code = int(data[at + k])
                    else:
                        per_byte = 8 // bits
                        shift = 8 - bits - bits * (k % per_byte)
                        code = (int(data[at + k // per_byte]) >> shift) & ((1 << bits) - 1)
                        if code == (1 << bits) - 1:
                            if extra >= end:
                                return _ENDS_EARLY
                            code = int(data[extra])
                            extra += 1
                    group[k] = code
                at = extra
                for k in range(min(_GROUP, size - g * _GROUP)):
                    code = int(group[k])
                    value = np.uint8((int(value) + ((code >> 1) ^ -(code & 1))) & 0xFF)
                    out[first + g * _GROUP + k, place] = value
            last[place] = value
    return 0 if at == end else _NOT_USED_UP


@kernel()
def _varint(data: NDArray[np.uint8], at: int, end: int) -> tuple[int, int]:
    """Return an unsigned LEB128 number of at most 32 bits, and the place after it; -1 where the stream ends early."""
    value, shift = 0, 0
    while at < end and shift < 35:
        byte = int(data[at])
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFF, at
        shift += 7
    return 0, -1


@kernel()
def _signed(value: int) -> int:
    return -((value >> 1) + 1) if value & 1 else value >> 1


@kernel()
def _unpack_triangles(data: NDArray[np.uint8], out: NDArray[np.uint32]) -> int:
    """Unpack mode 1: corners of triangles from the 16 latest edges and vertices, mostly one byte per triangle."""
    triangles = len(out) // 3
    end = len(data) - 16
    at = 1 + triangles
    if at > end:
        return _ENDS_EARLY
    edges = np.zeros((_FIFO, 2), np.int64)
    vertices = np.zeros(_FIFO, np.int64)
    edge_top, vertex_top = 0, 0  # entries so far: the latest one is at top - 1
    following, last = 0, 0
    corner = np.zeros(3, np.int64)
    fresh = np.zeros(3, np.bool_)
    for t in range(triangles):
        code = int(data[1 + t])
        high, low = code >> 4, code & 15
        if high < 15:
            edge = (edge_top - 1 - high) % _FIFO
            corner[0], corner[1] = edges[edge, 0], edges[edge, 1]
            fresh[0], fresh[1], fresh[2] = False, False, True
            if low == 0:
                corner[2] = following
                following += 1
            elif low < 13:
                corner[2], fresh[2] = vertices[(vertex_top - 1 - low) % _FIFO], False
            elif low < 15:
                last += 1 if low == 14 else -1
                corner[2] = last
            else:
                value, at = _varint(data, at, end)
                if at < 0:
                    return _ENDS_EARLY
                last += _signed(value)
                corner[2] = last
        else:
            if low < 14:
                table = int(data[end + low])
            else:
                if at >= end:
                    return _ENDS_EARLY
                table = int(data[at])
                at += 1
                if table == 0:
                    following = 0
            for k in range(3):
                kind = (table >> (8 - 4 * k)) & 15 if k else (15 if low == 15 else 0)
                fresh[k] = kind == 0 or kind == 15
                if kind == 0:
                    corner[k] = following
                    following += 1
                elif kind < 15:
                    corner[k] = vertices[(vertex_top - kind) % _FIFO]
                else:
                    value, at = _varint(data, at, end)
                    if at < 0:
                        return _ENDS_EARLY
                    last += _signed(value)
                    corner[k] = last
            edges[edge_top % _FIFO, 0], edges[edge_top % _FIFO, 1] = corner[1], corner[0]
            edge_top += 1
        edges[edge_top % _FIFO, 0], edges[edge_top % _FIFO, 1] = corner[2], corner[1]
        edge_top += 1
        edges[edge_top % _FIFO, 0], edges[edge_top % _FIFO, 1] = corner[0], corner[2]
        edge_top += 1
        for k in range(3):
            if fresh[k]:
                vertices[vertex_top % _FIFO] = corner[k]
                vertex_top += 1
            out[3 * t + k] = np.uint32(corner[k] & 0xFFFFFFFF)
    return 0 if at == end else _NOT_USED_UP


@kernel()
def _unpack_indices(data: NDArray[np.uint8], out: NDArray[np.uint32]) -> int:
    """Unpack mode 2: differences from the latest index of one of two sequences."""
    end = len(data) - 4
    latest = np.zeros(2, np.int64)
    at = 1
    for k in range(len(out)):
        value, at = _varint(data, at, end)
        if at < 0:
            return _ENDS_EARLY
        latest[value & 1] += _signed(value >> 1)
        out[k] = np.uint32(latest[value & 1] & 0xFFFFFFFF)
    return 0 if at == end else _NOT_USED_UP


# --- filters (appendix B) ---------------------------------------------------------------------------------------------
def _octahedral(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    kind = np.int8 if data.shape[1] == 4 else np.dtype("<i2")
    values = data.view(kind).astype(np.float32)
    one = np.where(values[:, 2] == 0, 1, values[:, 2])
    x, y = values[:, 0] / one, values[:, 1] / one
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.minimum(z, 0)
    vector = np.stack([x - np.copysign(fold, x), y - np.copysign(fold, y), z], axis=1)
    vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12)
    out = data.view(kind).copy()
    out[:, :3] = _rounded(vector * np.iinfo(kind).max)
    return out.view(np.uint8)


def _quaternion(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    values = data.view("<i2")
    one = (values[:, 3] | 3).astype(np.float32)
    small = values[:, :3] / one[:, None] * np.float32(np.sqrt(0.5))
    largest = np.sqrt(np.maximum(1 - (small * small).sum(1), 0))
    out = np.zeros(values.shape, np.dtype("<i2"))
    rows = np.arange(len(out))
    for k, component in enumerate((largest, *small.T)):
        out[rows, ((values[:, 3] & 3) + k) % 4] = _rounded(component * 32767)
    return out.view(np.uint8)


def _exponential(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    values = data.view("<i4")
    with np.errstate(over="ignore"):
        return np.ldexp((values << 8 >> 8).astype(np.float32), values >> 24).astype("<f4").view(np.uint8)


def _rounded(values: NDArray[Any]) -> NDArray[Any]:
    """Round to the nearest integer, halves away from zero, as C's ``round``."""
    return np.trunc(values + np.copysign(0.5, values))


_FILTERS = {"OCTAHEDRAL": _octahedral, "QUATERNION": _quaternion, "EXPONENTIAL": _exponential}
