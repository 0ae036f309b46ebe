"""Writes ``golden_payload.json``, a packed block with what it holds, which the tests of the Python packer and of the TypeScript
reader read: ``python -m tests.viewers.replays.golden``."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from h3data_viewers.html_replay.packing import Payload

FILE = Path(__file__).parent / "golden_payload.json"
ABOUT = {"name": "</script><b>ä", "list": [1, None]}


def payload() -> tuple[Payload, dict[str, np.ndarray]]:
    """A block with a walk, a coarse curve with gaps, numbers of 32 bits, an empty array and a file."""
    rng = np.random.default_rng(3)
    arrays = {
        "walk": np.cumsum(rng.normal(size=(40, 3)) * 0.02, axis=0),
        "curve": np.where((np.arange(30) % 11 < 3)[:, None], np.nan, rng.uniform(-2, 2, (30, 1))),
        "far": rng.uniform(-4e5, 4e5, (12, 2)),
        "empty": np.zeros((0, 4)),
    }
    out = Payload()
    for name, values in arrays.items():
        out.add_array(name, values, 5e-4)
    out.add_file("file", bytes(range(256)))
    return out, arrays


def unpacked(block: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `Payload.packed` has packed: ``about``, and arrays [T, C] or bytes by name. Plain code, as a reference."""
    data = zlib.decompress(block)
    (length,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + length])
    found: dict[str, Any] = {}
    for name, entry in header["entries"].items():
        part = data[4 + length + entry["at"] :][: entry["bytes"]]
        if "shape" not in entry:
            found[name] = part
            continue
        rows, columns = entry["shape"]
        planes = np.frombuffer(part, np.uint8).reshape(entry["planes"], columns, rows).astype(np.int64)
        codes = sum(plane << (8 * k) for k, plane in enumerate(planes))
        changes = np.where(codes % 2, -(codes + 1) // 2, codes // 2)
        values = np.cumsum(changes, axis=1).T * entry["step"]
        for start, end in entry.get("gaps", ()):
            values[start:end] = np.nan
        found[name] = values
    return header["about"], found


def main() -> None:
    packed, arrays = payload()
    said = {name: [[None if np.isnan(v) else v for v in row] for row in rows.tolist()] for name, rows in arrays.items()}
    block = base64.b64encode(packed.packed(ABOUT)).decode()
    FILE.write_text(json.dumps({"block": block, "about": ABOUT, "arrays": said}) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
