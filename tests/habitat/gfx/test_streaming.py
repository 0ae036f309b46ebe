"""Long gfx-replays are read in pieces: wherever they are cut the result is the same, and memory does not grow with them."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError
from h3data.formats import SourceFile, detect
from h3data.formats.builtin_formats import REPLAY_MEMBERS
from h3data.recording import recordings_equal
from h3data_habitat.gfx.keyframes import Keyframe, read_keyframes
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.json_stream import ArrayElements, ArrayFault

NASTY = ['"', "\\", '\\"', "}{][", "é\u2028\x00", "\\\\", 'a"b\\', ""]
TEXT = b'[{"loads":[{"filepath":"a\\\\\\"]}{[\\u0022.glb"}]} ,\n{}, {"a":{"b":[[],[{}],"}"]}},{"c":"\\\\"}\t]  ,"more":[{}]}'


def cut(data: bytes, size: int) -> Iterator[bytes]:
    yield from (data[k : k + size] for k in range(0, len(data), size))


def elements(chunks: Iterator[bytes], longest: int = 1 << 20) -> tuple[list[Any], list[int], bytes]:
    """The objects, where they begin, and what follows the array's bracket in all of the chunks."""
    found = ArrayElements(chunks, 0, longest)
    pairs = list(found)
    return [json.loads(text) for _, text in pairs], [at for at, _ in pairs], found.rest + b"".join(chunks)


# --- where a file is cut ----------------------------------------------------------------------------------------------
def test_borders_at_every_byte() -> None:
    body = TEXT[1:]
    expected = json.loads(b'{"k":' + TEXT)
    for border in range(len(body) + 1):
        objects, starts, rest = elements(iter([body[:border], body[border:]]))
        assert objects == expected["k"]
        assert all(body[at : at + 1] == b"{" for at in starts)
        assert rest == b'  ,"more":[{}]}'
    for size in range(1, 20):
        assert elements(cut(body, size))[0] == expected["k"]


strings = st.text(max_size=5) | st.sampled_from(NASTY)
values = st.recursive(
    st.none() | st.integers(-9, 9) | strings,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(strings, inner, max_size=3),
    max_leaves=8,
)


@given(
    objects=st.lists(st.dictionaries(strings, values, max_size=3), max_size=5),
    size=st.integers(1, 40),
    indent=st.none() | st.integers(0, 2),
    ascii_only=st.booleans(),
)
def test_any_objects_come_out_as_they_went_in(objects: Any, size: int, indent: int | None, ascii_only: bool) -> None:
    text = json.dumps(objects, indent=indent, ensure_ascii=ascii_only).encode("utf-8", "surrogatepass")
    assert elements(cut(text[1:] + b"}", size))[0] == objects


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{}", "truncated"),
        ('{"a":"]', "truncated"),
        ("{}{}]", "comma"),
        ("{},]", "missing"),
        ("{},,{}]", "no json"),
        (",{}]", "no json"),
        ("3,{}]", "no json"),
        ("{},3]", "no json"),
        ("[}]", "no json"),
        ('{"a" 3}]', "no json"),
        ("{" * 2000 + "}" * 2000 + "]", "longer"),
    ],
)
def test_what_is_no_array_of_objects_is_told(text: str, fault: str) -> None:
    if fault == "no json":
        with pytest.raises(msgspec.DecodeError):
            [msgspec.json.decode(raw, type=dict[str, Any]) for _, raw in ArrayElements(iter([text.encode()]), 0, 99)]
        return
    with pytest.raises(ArrayFault, match=fault):
        list(ArrayElements(cut(text.encode(), 10), 0, 999))


# --- files ------------------------------------------------------------------------------------------------------------
def pose(x: float) -> dict[str, Any]:
    return {"absTransform": {"translation": [x, 0.5, -1.25], "rotation": [1, 0, 0, 0]}}


def replay(frames: int, bodies: int = 3, **more: Any) -> dict[str, Any]:
    create = [{"instanceKey": k, "creation": {"filepath": f'o"{k}\\.glb'}} for k in range(bodies)]
    moved = [
        {"stateUpdates": [{"instanceKey": k, "state": pose(0.01 * step + k)} for k in range(bodies)]}
        for step in range(frames)
    ]
    moved[0] = {"creations": create, **moved[0]}
    return {"keyframes": moved, **more}


def test_the_members_of_a_keyframe_are_those_that_tell_a_replay() -> None:
    assert set(Keyframe.__struct_fields__) == REPLAY_MEMBERS


@pytest.mark.parametrize("size", [1, 7, 4095, 4096, 4097, 1 << 20])
def test_a_file_is_the_same_in_pieces_of_any_size(tmp_path: Path, size: int) -> None:
    content = replay(60)
    path = tmp_path / "x.gfx_replay.json.gz"
    path.write_bytes(gzip.compress(json.dumps(content).encode()))
    seen = bytearray()
    keyframes = list(read_keyframes(SourceFile(path, chunk_bytes=size), seen.extend))
    assert bytes(seen) == gzip.decompress(path.read_bytes())
    assert keyframes == msgspec.convert(content["keyframes"], list[Keyframe])


def test_keyframes_need_not_come_first(tmp_path: Path) -> None:
    content = replay(5)
    (tmp_path / "a.json").write_text(json.dumps(content))
    (tmp_path / "b.json").write_text(json.dumps({"before": [1, {"keyframes": 3}], **content, "behind": "x"}))
    (tmp_path / "c.json").write_text(json.dumps({**content, "behind": {"keyframes": []}}, indent=1))
    first = read_gfx_replay(tmp_path / "a.json")
    for name in ("b.json", "c.json"):
        again = read_gfx_replay(tmp_path / name)
        for column, values in first.columns.items():
            np.testing.assert_array_equal(again.columns[column], values)
        assert detect(tmp_path / name).name == "gfx_replay"


@pytest.mark.parametrize(
    ("tail", "fault"),
    [
        (b"", "H3-FORMAT-009"),
        (b",", "H3-FORMAT-009"),
        (b"]", "H3-FORMAT-008"),
        (b"} x", r"(?s)byte.*H3-FORMAT-008"),
        (b',"keyframes":[{}]}', "H3-HABITAT-062"),
        (b',"a":NaN}', r"(?s)NaN under 'a'.*H3-FORMAT-012"),
    ],
)
def test_what_stands_behind_the_keyframes_is_read_too(tmp_path: Path, tail: bytes, fault: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(json.dumps(replay(400)).encode()[:-1] + tail)
    with pytest.raises(FormatError, match=fault):
        read_gfx_replay(path)


def test_a_fault_far_inside_is_placed(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    text = json.dumps(replay(4000)).encode()
    at = text.rindex(b"[1, 0, 0, 0]")
    path.write_bytes(text[:at] + b"[1, 0, NaN, 0]" + text[at + 12 :])
    with pytest.raises(FormatError, match="H3-FORMAT-012"):
        read_gfx_replay(path)
    path.write_bytes(text[:at] + b"[1, 0, 0]" + text[at + 12 :])
    with pytest.raises(FormatError, match=r"(?s)keyframe 3999, stateUpdates, instance 2.*H3-HABITAT-059"):
        read_gfx_replay(path)


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    peaks = []
    for frames in (2_000, 8_000):
        path = tmp_path / f"{frames}.json"
        path.write_text(json.dumps(replay(frames)))
        tracemalloc.start()
        count = sum(1 for _ in read_keyframes(SourceFile(path, chunk_bytes=1 << 14), lambda _: None))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert count == frames
    assert path.stat().st_size > 2_500_000
    assert peaks[1] < 1.2 * peaks[0] < 1_000_000


MOST_MIB = 400
"""Memory in which half a gigabyte is imported; docs/import.md says so."""
_IMPORT = """
import sys
from h3data_pipelines.cli import main
assert main(["import", sys.argv[1], "-o", sys.argv[2]]) == 0
with open("/proc/self/status") as file:
    print("peak", next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM")))
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".json", ".json.gz"])
def test_half_a_gigabyte_is_imported_in_little_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"long.gfx_replay{suffix}"
    first, *others = (json.dumps(k).encode() for k in replay(501, 22)["keyframes"])
    block = b"," + b",".join(others)
    blocks = -(-(500 << 20) // len(block))
    with gzip.open(path, "wb", 1) if suffix.endswith("gz") else path.open("wb") as out:
        out.write(b'{"keyframes":[' + first)
        for _ in range(blocks):
            out.write(block)
        out.write(b"]}")
    done = subprocess.run(
        [sys.executable, "-c", _IMPORT, str(path), str(tmp_path / "rec")], check=True, capture_output=True, text=True
    )
    assert f"{1 + 500 * blocks} steps" in done.stdout
    assert float(done.stdout.split("peak ")[1]) < MOST_MIB


def test_packed_and_plain_are_the_same_recording(tmp_path: Path) -> None:
    text = json.dumps(replay(20)).encode()
    (tmp_path / "x.json").write_bytes(text)
    (tmp_path / "x.json.gz").write_bytes(gzip.compress(text))
    plain, packed = (read_gfx_replay(tmp_path / name) for name in ("x.json", "x.json.gz"))
    differences = recordings_equal(plain, packed)
    assert len(differences) <= 1  # the file's name
    assert plain.episode.uid == packed.episode.uid
