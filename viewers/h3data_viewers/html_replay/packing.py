"""Format of the data of an HTML replay: one compressed block with a JSON header, quantised arrays, and unchanged files.

```
u32 length of the header | header: JSON, UTF-8 | arrays and files, one after the other
```

An array [T, C] is rounded to multiples of its step. The differences between rows become unsigned numbers (zigzag).
Bytes of equal significance are stored together, column by column: neighbouring rows differ little, so most bytes are 0.
The block is compressed with zlib, which browsers unpack themselves (`DecompressionStream`). `web/src/replay/payload.ts`
reads the block. The tests of Python and TypeScript read the same block (tests/viewers/replays/golden.py).
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data_exporters.posed_parts import spans


@dataclass
class Payload:
    """Collector of the arrays and files of an HTML replay."""

    entries: dict[str, dict[str, Any]] = field(default_factory=dict)
    _parts: list[bytes] = field(default_factory=list)
    _size: int = 0

    def add_array(self, name: str, values: ArrayLike, step: float) -> str:
        """Add numbers [T, C] or [T], rounded to multiples of ``step``, and return their name.

        Rows with a number that is not finite take no space, and are read as NaN.
        """
        rows = np.asarray(values, np.float64)
        rows = rows[:, None] if rows.ndim == 1 else rows
        assert rows.ndim == 2
        there: NDArray[np.bool_] = np.all(np.isfinite(rows), axis=1)
        # levels stay within 2^30 so that zigzag codes of differences fit into 32 bits; a finer step is made coarser
        step = max(step, float(np.abs(rows[there]).max(initial=0.0)) / 2**30)
        # absent rows repeat the one before, or are zeros, so that their differences are zeros, which compress best
        latest = np.maximum.accumulate(np.where(there, np.arange(len(rows)), -1)) if len(rows) else np.zeros(0, np.intp)
        levels = np.rint(np.where(latest[:, None] < 0, 0.0, rows[latest]) / step).astype(np.int64)
        # differences of whole levels, not of values: rounding does not add up along the track
        changes = np.diff(levels, axis=0, prepend=0)
        codes = np.where(changes < 0, -2 * changes - 1, 2 * changes).astype("<u4")
        planes = next(p for p in (1, 2, 3, 4) if p == 4 or not (codes >> np.uint32(8 * p)).any())
        # lowest bytes first, column by column: the higher bytes are nearly all 0 and lie together
        data = b"".join(
            ((codes >> np.uint32(8 * p)) & np.uint32(255)).astype(np.uint8).T.tobytes() for p in range(planes)
        )
        gaps = [[start, end] for start, end in spans(~there)]
        self._add(name, data, shape=list(rows.shape), step=step, planes=planes, **({"gaps": gaps} if gaps else {}))
        return name

    def add_file(self, name: str, data: bytes) -> str:
        """Add a file with unchanged content and return its name in the payload."""
        self._add(name, data)
        return name

    def _add(self, name: str, data: bytes, **more: Any) -> None:
        assert name not in self.entries
        self.entries[name] = {"at": self._size, "bytes": len(data), **more}
        self._parts.append(data)
        self._size += len(data)

    def packed(self, about: dict[str, Any]) -> bytes:
        """Return the compressed block of all arrays and files; ``about`` is plain JSON that goes into its header."""
        header = json.dumps({"about": about, "entries": self.entries}, allow_nan=False, separators=(",", ":")).encode()
        return zlib.compress(struct.pack("<I", len(header)) + header + b"".join(self._parts), 9)
