"""Arrays of a glTF document: accessors over buffer views, checked against the bytes available (glTF 2.0, 3.6).

Faults raise a `ValueError` that names the key, such as ``accessors[3].count``; callers add the name of the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from h3data.plugins import Registry

MESHOPT = "EXT_meshopt_compression"


@dataclass(frozen=True)
class GltfArrays:
    """Accessors and buffer views of one glTF document."""

    codecs: ClassVar[Registry[Callable[..., NDArray[np.uint8]]]] = Registry(
        "h3data.gltf_codecs", {}, what="codec of glTF files"
    )
    """Decoders of compressed buffer views, by the extension that describes them."""
    document: dict[str, Any]
    buffer: Callable[[int], bytes | memoryview]
    """Function that returns all bytes of a buffer by index; it may raise `ValueError`."""
    _unpacked: dict[int, memoryview] = field(default_factory=dict, init=False, repr=False, compare=False)

    def accessor(self, index: object) -> NDArray[Any]:
        """Return the elements of an accessor as stored, [count] or [count, width], if possible as a view of the bytes."""
        record, where = entry(self.document, "accessors", index), f"accessors[{index}]"
        widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
        if record.get("type") not in widths:
            raise ValueError(f"{where}.type is {record.get('type')!r}, not one of {', '.join(widths)}")
        width, count = widths[record["type"]], natural(record, "count", where)
        dtype = _component(record, where)
        if "bufferView" in record:
            array = self._strided(record, where, dtype, count, width)
        # without a view all is zero, and a tiny file must not allocate gigabytes
        elif count > 1 << 20:
            raise ValueError(f"{where}.count is {count} without a bufferView")
        else:
            array = np.zeros((count, width), dtype)
        if "sparse" in record:
            array = self._with_sparse(array, record["sparse"], f"{where}.sparse")
        return array[:, 0] if width == 1 else array

    def floats(self, index: object) -> NDArray[Any]:
        """Return the elements of an accessor as float32; normalised integers become 0..1 or -1..1."""
        array = self.accessor(index)
        if array.dtype.kind == "f" or not entry(self.document, "accessors", index).get("normalized"):
            return array.astype(np.float32, copy=False)
        # signed integers reach one step below -1 (-128 / 127)
        return np.maximum(array.astype(np.float32) / np.iinfo(array.dtype).max, np.float32(-1))

    def view(self, index: object) -> memoryview:
        """Return the bytes of a buffer view."""
        record, where = entry(self.document, "bufferViews", index), f"bufferViews[{index}]"
        packed = record.get("extensions")
        if isinstance(packed, dict) and MESHOPT in packed:
            assert isinstance(index, int)  # `entry` has checked it
            # several accessors share a view, which is unpacked once
            if index not in self._unpacked:
                self._unpacked[index] = self._unpack(packed[MESHOPT], f"{where}.extensions.{MESHOPT}")
            return self._unpacked[index]
        return self._bytes(record, where)

    def _unpack(self, packed: Any, where: str) -> memoryview:
        """Decompress a buffer view; ``packed`` is its entry for the extension ``EXT_meshopt_compression``."""
        if not isinstance(packed, dict):
            raise ValueError(f"{where} is not an object")
        count, stride = natural(packed, "count", where), natural(packed, "byteStride", where)
        data, mode = self._bytes(packed, where), str(packed.get("mode"))
        try:
            unpacked = self.codecs.get(MESHOPT)(
                data, mode=mode, filter=str(packed.get("filter", "NONE")), count=count, stride=stride
            )
        except ValueError as fault:
            raise ValueError(f"{where}: {fault}") from None
        return memoryview(unpacked.tobytes())

    def _bytes(self, record: dict[str, Any], where: str) -> memoryview:
        data = memoryview(self.buffer(natural(record, "buffer", where)))
        start, size = natural(record, "byteOffset", where, 0), natural(record, "byteLength", where)
        if start + size > len(data):
            raise ValueError(f"{where} needs bytes {start}..{start + size}, its buffer has {len(data)}")
        return data[start : start + size]

    def _strided(self, record: dict[str, Any], where: str, dtype: np.dtype, count: int, width: int) -> NDArray[Any]:
        """Return the elements [count, width] from the view that ``record`` names."""
        data = self.view(record["bufferView"])
        view = entry(self.document, "bufferViews", record["bufferView"])
        start, size = natural(record, "byteOffset", where, 0), width * dtype.itemsize
        stride = natural(view, "byteStride", f"bufferViews[{record['bufferView']}]", size) or size
        if stride < size:
            raise ValueError(f"bufferViews[{record['bufferView']}].byteStride is {stride}, {where} needs {size}")
        end = start + (stride * (count - 1) + size if count else 0)
        if end > len(data):
            raise ValueError(
                f"{where}.count is {count}: bytes {start}..{end} of bufferViews[{record['bufferView']}], "
                f"which has {len(data)}"
            )
        # packed densely, which most files are: no copy
        if stride == size:
            return np.frombuffer(data, dtype, count * width, start).reshape(count, width)
        if not count:
            return np.zeros((0, width), dtype)
        rows = as_strided(np.frombuffer(data, np.uint8, offset=start), (count, size), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(dtype)

    def _with_sparse(self, array: NDArray[Any], sparse: Any, where: str) -> NDArray[Any]:
        if not isinstance(sparse, dict):
            raise ValueError(f"{where} is not an object")
        count = natural(sparse, "count", where)
        places, values = (_child(sparse, key, where) for key in ("indices", "values"))
        kind = _component(places, f"{where}.indices")
        if kind.kind != "u":
            raise ValueError(f"{where}.indices.componentType is not an unsigned integer")
        index = self._strided(places, f"{where}.indices", kind, count, 1)[:, 0]
        if count and index.max() >= len(array):
            raise ValueError(f"{where}.indices go up to {index.max()}, there are {len(array)} elements")
        # it may be a view of the file's bytes
        array = array.copy()
        array[index] = self._strided(values, f"{where}.values", array.dtype, count, array.shape[1])
        return array


def entry(document: dict[str, Any], key: str, index: object) -> dict[str, Any]:
    """Return the object ``document[key][index]``."""
    items = document.get(key, [])
    if not isinstance(items, list) or not isinstance(index, int) or not 0 <= index < len(items):
        count = len(items) if isinstance(items, list) else "no"
        raise ValueError(f"{key}[{index!r}] is referred to, there are {count} {key}")
    if not isinstance(items[index], dict):
        raise ValueError(f"{key}[{index}] is not an object")
    return items[index]


def natural(record: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    """Return the non-negative integer ``record[key]``."""
    value = record.get(key, default)
    # Python counts True as an integer, JSON does not
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"{where}.{key} is {value!r}, not a non-negative integer")
    return value


def _child(record: dict[str, Any], key: str, where: str) -> dict[str, Any]:
    if not isinstance(record.get(key), dict):
        raise ValueError(f"{where}.{key} is not an object")
    return record[key]


def _component(record: dict[str, Any], where: str) -> np.dtype:
    kind = record.get("componentType")
    types = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    if kind not in types:
        raise ValueError(f"{where}.componentType is {kind!r}, not one of {', '.join(map(str, types))}")
    return np.dtype(types[kind])
