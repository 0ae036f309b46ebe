"""Differences between two recordings, and a running hash that shows where two state streams diverge."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.recording.records import Recording
from h3data.recording.schema import episode_to_dict, layout_of, struct_to_dict, topic_of


def recordings_equal(a: Recording, b: Recording) -> list[str]:
    """Return the differences of two recordings, one line each; no lines if they are equal bit for bit.

    Any NaN equals any NaN, and the order of columns does not count.
    """
    differences = _dict_differences("episode", _episode(a), _episode(b))
    for kind in ("assets", "bodies", "agents", "skills", "events", "inputs"):
        ours, theirs = getattr(a, kind), getattr(b, kind)
        if len(ours) != len(theirs):
            differences.append(f"{kind}: {len(ours)} and {len(theirs)}")
            continue
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            # repr: NaN equals NaN, -0.0 differs from 0.0
            x, y = ({name: repr(value) for name, value in struct_to_dict(record).items()} for record in pair)
            differences += _dict_differences(f"{kind}[{i}]", x, y)
    differences += _set_differences("columns", a.columns, b.columns)
    for name in a.columns:
        if name in b.columns:
            differences += _array_differences(name, np.asarray(a.columns[name]), np.asarray(b.columns[name]))
    differences += _set_differences("attachments", a.attachments, b.attachments)
    differences += [
        f"attachment {name}: contents differ"
        for name in a.attachments
        if name in b.attachments and bytes(a.attachments[name]) != bytes(b.attachments[name])
    ]
    return differences


def _episode(rec: Recording) -> dict[str, Any]:
    values = episode_to_dict(rec.episode)
    # sorted, because the order of a mapping means nothing and differs between writers
    values["info"] = json.dumps(json.loads(values["info"]), sort_keys=True)
    return values


def _dict_differences(what: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    return [f"{what}.{k}: {a[k]!r} and {b[k]!r}" for k in a if a[k] != b[k]]


def _set_differences(what: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    out = [f"{what}: {name} only in the first" for name in a if name not in b]
    return out + [f"{what}: {name} only in the second" for name in b if name not in a]


def _array_differences(name: str, a: NDArray[Any], b: NDArray[Any]) -> list[str]:
    if a.dtype.newbyteorder("=") != b.dtype.newbyteorder("=") or a.shape != b.shape:
        return [f"{name}: {a.dtype} {list(a.shape)} and {b.dtype} {list(b.shape)}"]
    if not a.size:
        return []
    # as unsigned integers of the same bits, so that -0.0 differs from 0.0, which == would call equal
    x, y = (np.ascontiguousarray(v, v.dtype.newbyteorder("=")) for v in (a, b))
    unsigned = np.dtype(f"u{x.dtype.itemsize}")
    differ = x.view(unsigned) != y.view(unsigned)
    if x.dtype.kind == "f":
        # the bits of a NaN carry nothing, and differ between processors
        differ &= ~(np.isnan(x) & np.isnan(y))
    if not differ.any():
        return []
    first = tuple(int(i) for i in np.argwhere(differ)[0])
    return [f"{name}: {int(differ.sum())} of {x.size} values differ, first at {first}: {x[first]!r} and {y[first]!r}"]


def state_hash(columns: Mapping[str, NDArray[Any]], previous: int = 0) -> NDArray[np.uint64]:
    """Return the running hash of the state stream after each row, shape [T].

    Row k is BLAKE2b with an 8-byte digest over the digest of row k-1 (``previous`` before the first; little-endian) and
    the raw little-endian bytes of row k of every state column in the sorted order of their names. All columns are state
    columns except ``time_ns``, ``state_hash``, ``metrics.*``, ``input.*`` and ``agent_*.action``, because measurements
    and commands are not state.
    """
    names = sorted(n for n in columns if topic_of(n) == "state" and n not in ("time_ns", "state_hash"))
    # for its check alone: it refuses dtypes that no file can hold
    layout_of({n: columns[n] for n in names})
    steps = len(next(iter(columns.values()))) if columns else 0
    # little-endian on every machine, so that hashes can be compared between machines; columns of width 0 have no bytes
    parts = [
        np.ascontiguousarray(a, a.dtype.newbyteorder("<")).reshape(steps, -1).view(np.uint8)
        for a in (np.asarray(columns[n]) for n in names)
        if a.size
    ]
    joined = np.concatenate(parts, axis=1) if parts else np.empty((steps, 0), np.uint8)
    whole, width, blake2b = joined.tobytes(), joined.shape[1], hashlib.blake2b
    digests = [int(previous).to_bytes(8, "little")]
    for k in range(0, steps * width, width) if width else [0] * steps:
        digests.append(blake2b(digests[-1] + whole[k : k + width], digest_size=8).digest())
    return np.frombuffer(b"".join(digests[1:]), "<u8").astype(np.uint64)
