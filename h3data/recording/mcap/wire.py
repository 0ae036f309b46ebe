"""Protobuf messages of fixed length, written and read as whole blocks by numpy.

Packed ``repeated float`` is the little-endian bytes of a float32 array behind a tag and a length. With only fixed-size
wire types, constant list lengths and every field always present, all messages of a topic have the same length, so T
messages are one uint8 matrix [T, L]: 4x faster to write and 6x faster to read than message objects
(``research/formats.md`` 1.2). They remain ordinary protobuf: the descriptor is in the file and any reader decodes them.
Messages of other lengths, from other writers, are read through google.protobuf.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError
from h3data.recording.schema import STRUCTS, Column, Layout, Topic, layout_from_json, layout_to_json, log_topic_of

STEP = Column("", "uint32", ())
"""Field ``step`` (number 2) with the row number, which relates messages of different topics; it is not a column of the
recording."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_WIRE = {  # dtype -> protobuf type, numpy dtype on the wire, wire type of one value
    "float16": ("float", "<f4", _FIXED32),
    "float32": ("float", "<f4", _FIXED32),
    "float64": ("double", "<f8", _FIXED64),
    "int8": ("sfixed32", "<i4", _FIXED32),
    "int16": ("sfixed32", "<i4", _FIXED32),
    "int32": ("sfixed32", "<i4", _FIXED32),
    "int64": ("sfixed64", "<i8", _FIXED64),
    "uint8": ("fixed32", "<u4", _FIXED32),
    "uint16": ("fixed32", "<u4", _FIXED32),
    "uint32": ("fixed32", "<u4", _FIXED32),
    "uint64": ("fixed64", "<u8", _FIXED64),
    "bool": ("bool", "u1", _VARINT),  # 0 and 1 are one-byte varints
}


@dataclass(frozen=True)
class WireField:
    """Field of a Protobuf message that is written at every step."""

    column: Column
    name: str
    """Name of the field in Protobuf."""
    number: int

    @property
    def proto_type(self) -> str:
        """Name of the field's protobuf type."""
        return "bytes" if self._as_bytes else _WIRE[self.column.dtype][0]

    @property
    def repeated(self) -> bool:
        """Return whether the field holds several numbers, written as a packed repeated field."""
        return bool(self.column.shape) and not self._as_bytes

    @property
    def wire_dtype(self) -> np.dtype[Any]:
        """Type of the field's numbers in the message."""
        return np.dtype("u1" if self._as_bytes else _WIRE[self.column.dtype][1])

    @property
    def size(self) -> int:
        """Size of the values in one message, without tag and length [bytes]."""
        return self.column.width * self.wire_dtype.itemsize

    @property
    def head(self) -> bytes:
        """Bytes before the values: tag and, for lists, length."""
        if self.column.shape:
            return varint(self.number << 3 | _BYTES) + varint(self.size)
        return varint(self.number << 3 | _WIRE[self.column.dtype][2])

    @property
    def _as_bytes(self) -> bool:
        # protobuf has no small integers: as fixed32 each byte would take four
        return self.column.dtype == "uint8" and bool(self.column.shape)


WireLayout = tuple[WireField, ...]


def varint(value: int) -> bytes:
    """Encode a non-negative integer with Protobuf's variable length."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def wire_layouts(layout: Layout) -> dict[Topic, WireLayout]:
    """Return fields of each per-step message for these columns; ``state`` always exists."""
    topics: dict[Topic, list[Column]] = {"state": []}
    for column in layout:
        topics.setdefault(log_topic_of(column.name), []).append(column)
    layouts: dict[Topic, WireLayout] = {}
    for topic, columns in topics.items():
        fields, taken, number = [WireField(STEP, "step", 2)], {"step"}, 3
        for column in columns:
            # time comes first and is always field 1, so that any viewer finds it
            if column.name == "time_ns":
                fields.insert(0, WireField(column, "time_ns", 1))
                taken.add("timens")
                continue
            fields.append(WireField(column, _proto_name(column.name, taken), number))
            number += 1
        layouts[topic] = tuple(fields)
    return layouts


def _proto_name(name: str, taken: set[str]) -> str:
    """Return a protobuf identifier that is unique, also in its camelCase JSON form."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).lower()
    plain = plain if plain[:1].isalpha() else f"c_{plain}"
    candidate, n = plain, 2
    # names that differ by underscores only are the same in JSON, and protobuf refuses them
    while candidate.replace("_", "") in taken:
        candidate, n = f"{plain}_n{n}", n + 1
    taken.add(candidate.replace("_", ""))
    return candidate


# --- blocks of messages -----------------------------------------------------------------------------------------------
def _template(fields: WireLayout) -> tuple[NDArray[np.uint8], list[int], NDArray[np.bool_]]:
    """Return one message with all values 0, the offset of each field's values, and a mask of the bytes that never change."""
    message, fixed, starts = bytearray(), [], []
    for field in fields:
        message += field.head
        starts.append(len(message))
        fixed += [True] * len(field.head) + [False] * field.size
        message += bytes(field.size)
    return np.frombuffer(bytes(message), np.uint8), starts, np.array(fixed, bool)


def encode_block(fields: WireLayout, columns: Mapping[str, NDArray[Any]], *, first_step: int) -> NDArray[np.uint8]:
    """Return messages of consecutive rows, one per row of the result, shape [n, L]."""
    # tags and lengths are the same in all messages, so they are copied and only values are filled in
    template, starts, _ = _template(fields)
    arrays = [columns[f.column.name] for f in fields if f.column is not STEP]
    rows = len(arrays[0]) if arrays else 0
    block = np.repeat(template[None], rows, axis=0)
    for field, start in zip(fields, starts, strict=True):
        if field.column is STEP:
            values = np.arange(first_step, first_step + rows)
        else:
            values = np.asarray(columns[field.column.name])
        flat = np.ascontiguousarray(values.reshape(rows, field.column.width), field.wire_dtype)
        if field.size:
            block[:, start : start + field.size] = flat.view(np.uint8).reshape(rows, field.size)
    return block


def decode_messages(
    fields: WireLayout,
    messages: Sequence[memoryview],
    *,
    wanted: set[str] | None = None,
    descriptor: bytes,
    message: str,
) -> dict[str, NDArray[Any]]:
    """Decode the messages of one topic into columns, and the row numbers under ``""``.

    If ``wanted`` is given, only these columns are decoded.

    A single `np.frombuffer` decodes them if all messages have the length and tags of the layout; otherwise each is
    decoded as a protobuf object.

    Raises:
        FormatError: a list has another length, or a value does not fit its column.
    """
    template, starts, fixed = _template(fields)
    chosen = [(f, s) for f, s in zip(fields, starts, strict=True) if wanted is None or f.column.name in {"", *wanted}]
    rows = len(messages)
    # equal lengths alone could be chance, so the tags are compared too before values are read by their place
    if all(len(m) == len(template) for m in messages):
        block = np.frombuffer(b"".join(messages), np.uint8).reshape(rows, len(template))
        if np.all(block[:, fixed] == template[fixed]):
            # the slice is copied, since only contiguous bytes can be viewed as numbers
            return {
                f.column.name: _narrow(
                    block[:, s : s + f.size].copy().view(f.wire_dtype).reshape(rows, f.column.width), f
                )
                if f.size
                else f.column.empty(rows)
                for f, s in chosen
            }
    return _decode_objects([f for f, _ in chosen], messages, message_class(descriptor, message))


def _decode_objects(fields: Sequence[WireField], messages: Sequence[memoryview], cls: Any) -> dict[str, NDArray[Any]]:
    out = {f.column.name: np.zeros((len(messages), f.column.width), f.wire_dtype) for f in fields}
    for k, data in enumerate(messages):
        decoded = cls.FromString(bytes(data))
        for field in fields:
            value = getattr(decoded, field.name)
            if field.proto_type == "bytes":
                value = np.frombuffer(value, np.uint8)
            elif not field.repeated:
                value = [value]
            if len(value) != field.column.width:
                raise FormatError(
                    f"Message {k} of {cls.DESCRIPTOR.full_name}: expected {field.column.width} values in field "
                    f"{field.name}, got {len(value)}.",
                    code="H3-RECORDING-045",
                )
            out[field.column.name][k] = value
    return {f.column.name: _narrow(out[f.column.name], f) for f in fields}


def _narrow(values: NDArray[Any], field: WireField) -> NDArray[Any]:
    """Return values in the dtype of their column; raise a `FormatError` if they do not fit."""
    narrow = values.astype(field.column.dtype, copy=False)
    # protobuf has no integers of 8 and 16 bits, so another writer may have sent larger numbers
    if field.column.dtype in ("int8", "int16", "uint8", "uint16") and not np.array_equal(narrow, values):
        raise FormatError(f"Column {field.column.name}: values exceed {field.column.dtype}.", code="H3-RECORDING-042")
    return narrow.reshape(len(values), *field.column.shape)


# --- channel metadata -------------------------------------------------------------------------------------------------
def fields_to_metadata(fields: WireLayout) -> dict[str, str]:
    """Return channel metadata that restore the exact columns: layout, field names and numbers."""
    column_fields = [f for f in fields if f.column is not STEP]
    return {
        "h3.columns": layout_to_json(tuple(f.column for f in column_fields)),
        "h3.fields": json.dumps([[f.name, f.number] for f in column_fields]),
    }


def fields_from_metadata(metadata: Mapping[str, str], *, topic: str) -> WireLayout:
    """Return the inverse of `fields_to_metadata`, in the order of field numbers, including ``step``."""
    try:
        layout = layout_from_json(metadata["h3.columns"])
        named = json.loads(metadata["h3.fields"])
        fields = [WireField(c, str(n), int(k)) for c, (n, k) in zip(layout, named, strict=True)]
    except (KeyError, ValueError, TypeError) as error:
        raise FormatError(
            f"The channel {topic} has no usable column layout ({error!r}).", code="H3-RECORDING-043"
        ) from error
    return tuple(sorted([*fields, WireField(STEP, "step", 2)], key=lambda f: f.number))


# --- descriptors ------------------------------------------------------------------------------------------------------
def step_descriptor(message: str, fields: WireLayout) -> bytes:
    """Return the serialised FileDescriptorSet of one per-step message, such as ``State`` in package ``h3``."""
    signatures = [(f.name, f.number, f.proto_type, f.repeated) for f in fields]
    return _descriptor_set(f"h3/{message.lower()}.proto", {message: signatures})


@lru_cache(maxsize=1)  # made for every message, it was 8% of the CPU of a session's step
def struct_descriptor() -> bytes:
    """Return the serialised FileDescriptorSet of ``h3.Scene``, ``h3.Event``, ``h3.Skill``, ``h3.Input`` and their parts."""
    messages = {
        struct: [(name, k + 1, kind.rstrip("*"), kind.endswith("*")) for k, (name, kind) in enumerate(fields.items())]
        for struct, fields in STRUCTS.items()
    }
    # numbered far above the fields of the record, which may grow
    messages["Skill"].append(("span", 100, "int64", False))
    messages["Scene"] = [("assets", 1, "Asset", True), ("bodies", 2, "Body", True), ("agents", 3, "Agent", True)]
    return _descriptor_set("h3/records.proto", messages)


def _descriptor_set(filename: str, messages: Mapping[str, Sequence[tuple[str, int, str, bool]]]) -> bytes:
    from google.protobuf import descriptor_pb2

    kinds = descriptor_pb2.FieldDescriptorProto
    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name=filename, package="h3", syntax="proto3")
    for message, fields in messages.items():
        proto = file.message_type.add(name=message)
        for name, number, kind, repeated in fields:
            label = kinds.LABEL_REPEATED if repeated else kinds.LABEL_OPTIONAL
            if kind in messages:
                proto.field.add(name=name, number=number, label=label, type=kinds.TYPE_MESSAGE, type_name=f".h3.{kind}")
            else:
                proto.field.add(name=name, number=number, label=label, type=kinds.Type.Value(f"TYPE_{kind.upper()}"))
    # equal recordings have equal files, byte for byte
    return files.SerializeToString(deterministic=True)


@lru_cache(maxsize=32)
def message_class(descriptor_set: bytes, name: str) -> Any:
    """Return the google.protobuf class of message ``name`` of a serialised FileDescriptorSet."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    # a pool of its own: two logs may define the same message names with other fields
    pool = descriptor_pool.DescriptorPool()
    waiting = list(descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file)
    added: set[str] = set()
    while waiting:
        # other writers list files in any order, and the pool wants those first on which others depend
        ready = [f for f in waiting if set(f.dependency) <= added]
        if not ready:
            raise FormatError(f"The descriptor of {name} lacks files that it depends on.", code="H3-RECORDING-044")
        for file in ready:
            pool.Add(file)
            added.add(file.name)
        waiting = [f for f in waiting if f.name not in added]
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
