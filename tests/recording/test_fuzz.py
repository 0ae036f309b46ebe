"""All readers of recordings against files that were changed at random: the result is a recording or one of our errors.

Bytes are changed anywhere (most such files fail a checksum at once), and values are changed in place with checksums made
right again, as a hostile or a faulty writer would: messages, metadata, tables, JSON.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from h3data.errors import FormatError, H3DataError
from h3data.recording import Dataset, DatasetWriter, open_recording, read_mcap, rebuild_meta, recover_mcap, write_mcap
from tests.recording.strategies import simple_recording

FEW = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck), "print_blob": False}
EXAMPLES = [pytest.param(10), pytest.param(1000, marks=pytest.mark.slow)]
NUMBERS = [0, 1, -1, 2, 7, 255, 2**31 - 1, 2**31, 2**32, -(2**31), 2**62, 2**63 - 1, -(2**63), 10**12]
TEXTS = [
    "",
    "0",
    "-1",
    "nan",
    "[]",
    "{}",
    "null",
    "[[]]",
    "1e999",
    "9" * 30,
    "ü\0",
    "../../etc/passwd",
    "/",
    "[1, 2]",
    '{"a": 1}',
    '[["time_ns", "int64", []]]',
    '[["time_ns", "int64", [-1]]]',
    '[["time_ns", "complex128", []]]',
    '[["x", "int8", [1e9]]]',
    '[["time_ns", "int64", [0]], ["time_ns", "float32", [1000000, 1000000, 1000000]]]',
    '{"scene.glb": 5}',
    "[" * 5000,
]
VALUES = st.sampled_from(
    [*NUMBERS, *TEXTS, True, None, 0.5, float("nan"), float("inf"), [], {}, [NUMBERS], {"a": TEXTS}]
)


@st.composite
def changed_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """A few bytes overwritten, cut out, doubled or put in."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(out) - 1, 0)))
        length = draw(st.integers(1, 40))
        kind = draw(st.integers(0, 4))
        if kind == 0:
            out[at : at + 1] = bytes([draw(st.integers(0, 255))])
        elif kind == 1:
            del out[at : at + length]
        elif kind == 2:
            out[at:at] = out[at : at + length]
        elif kind == 3:
            number = draw(st.sampled_from(NUMBERS)) % 2**64
            out[at : at + 8] = number.to_bytes(8, "little")
        else:
            out[at:at] = draw(st.binary(max_size=16))
    return bytes(out)


def harmless(*attempts: Callable[[], Any]) -> None:
    """Each gives a result or one of our errors."""
    for attempt in attempts:
        with contextlib.suppress(H3DataError):
            repr(attempt())


def read_log(path: Path) -> None:
    harmless(
        lambda: read_mcap(path),
        lambda: open_recording(path),
        lambda: read_mcap(path, columns=["metrics.dist_agents"]),
        lambda: recover_mcap(path, path.with_name("saved.mcap"), overwrite=True),
    )


def read_dataset(root: Path) -> None:
    harmless(
        lambda: Dataset(root),
        lambda: Dataset(root).episodes,
        lambda: list(Dataset(root).recordings(range(2))),
        lambda: Dataset(root)[0],
        lambda: Dataset(root).layout(1),
        lambda: list(Dataset(root).iter_columns(["metrics.dist_agents", "agent_0.action"])),
        lambda: Dataset(root).recording(1, columns=["metrics.dist_agents"], records=["agents"]),
        lambda: rebuild_meta(root),
    )


# --- logs --------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(simple_recording(steps=6, bodies=1), tmp_path_factory.mktemp("fuzz") / "sound.mcap")


def rewritten(data: bytes, change: Callable[[str, Any], Any]) -> bytes:
    """The log with ``change(what, value)`` applied to its messages, metadata and attachments, checksums made right."""
    out, reader = io.BytesIO(), make_reader(io.BytesIO(data))
    writer = Writer(out)
    writer.start(profile="h3data")
    channels: dict[int, int] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None
        if channel.id not in channels:
            name, text = change("schema", schema.name), change("descriptor", schema.data)
            number = writer.register_schema(name, "protobuf", text)
            metadata = change("channel", dict(channel.metadata))
            channels[channel.id] = writer.register_channel(change("topic", channel.topic), "protobuf", number, metadata)
        payload = change("message", message.data)
        writer.add_message(channels[channel.id], message.log_time, payload, message.publish_time)
    for record in reader.iter_metadata():
        writer.add_metadata(record.name, change("metadata", dict(record.metadata)))
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize("examples", EXAMPLES)
def test_logs_with_changed_bytes(log, examples):
    data, path = log.read_bytes(), log.with_name("changed.mcap")

    @settings(max_examples=examples, **FEW)
    @given(changed=changed_bytes(data))
    def run(changed: bytes) -> None:
        path.write_bytes(changed)
        read_log(path)

    run()


@pytest.mark.parametrize("examples", EXAMPLES)
def test_logs_with_changed_values_and_right_checksums(log, examples):
    data, path = log.read_bytes(), log.with_name("changed.mcap")
    seen: list[str] = []
    rewritten(data, lambda what, value: seen.append(what) or value)

    @settings(max_examples=examples, **FEW)
    @given(data_=st.data(), at=st.integers(0, len(seen) - 1), text=st.sampled_from(TEXTS))
    def run(data_: st.DataObject, at: int, text: str) -> None:
        count = iter(range(len(seen)))

        def change(what: str, value: Any) -> Any:
            if next(count) != at:
                return value
            if isinstance(value, bytes):
                return data_.draw(changed_bytes(value))
            if isinstance(value, dict):
                return {**value, data_.draw(st.sampled_from([*value, "more"])): text}
            return text.replace("\0", "")

        path.write_bytes(rewritten(data, change))
        read_log(path)

    run()


# --- datasets ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fuzz") / "ds"
    with DatasetWriter(root) as writer:
        for seed in range(2):
            writer.add(simple_recording(steps=5 - seed, bodies=1, seed=seed))
    return root


FILES = [
    "meta/info.json",
    "h3/schema.json",
    "data/chunk-000/file-000.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    *(f"h3/{kind}/chunk-000/file-000.parquet" for kind in ("bodies", "agents", "skills", "events", "inputs")),
]


@pytest.mark.parametrize("examples", EXAMPLES)
def test_datasets_with_changed_bytes(dataset, tmp_path, examples):
    root = shutil.copytree(dataset, tmp_path / "ds")

    @settings(max_examples=examples, **FEW)
    @given(data=st.data(), name=st.sampled_from(FILES))
    def run(data: st.DataObject, name: str) -> None:
        (root / name).write_bytes(data.draw(changed_bytes((dataset / name).read_bytes())))
        read_dataset(root)
        restore(dataset, root, name)

    run()


def restore(dataset: Path, root: Path, name: str) -> None:
    for changed in (name, "meta/info.json", "meta/stats.json", "meta/tasks.parquet"):
        shutil.copy(dataset / changed, root / changed)


def test_an_episode_table_of_other_types_is_refused_by_name(dataset, tmp_path):
    root = shutil.copytree(dataset, tmp_path / "ds")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    for kind in (pa.string(), pa.list_(pa.int64())):
        other = pa.array([None, None], kind)
        pq.write_table(table.set_column(table.column_names.index("length"), "length", other), path)
        for read in (rebuild_meta, lambda root: Dataset(root).episodes):
            with pytest.raises(FormatError, match=r"H3-RECORDING-06(7|9)"):
                read(root)


def changed_json(draw: Callable[[Any], Any], value: Any) -> Any:
    """One value somewhere inside replaced by another, or taken out."""
    if isinstance(value, dict | list) and value and draw(st.integers(0, 9)) > 0:
        key = draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        inner = changed_json(draw, value[key])
        if isinstance(value, dict):
            return {**value, key: inner} if draw(st.integers(0, 5)) else {k: v for k, v in value.items() if k != key}
        return [*value[:key], inner, *value[key + 1 :]]
    return draw(VALUES)


def changed_table(draw: Callable[[Any], Any], table: pa.Table) -> pa.Table:
    """One value replaced, one column of another type or gone, or rows cut off or doubled."""
    kind, index = draw(st.integers(0, 4)), draw(st.integers(0, table.num_columns - 1))
    column = table.column(index)
    if kind == 0 or not len(table):
        return table.remove_column(index)
    if kind == 1:
        return table.slice(0, draw(st.integers(0, len(table) - 1)))
    if kind == 2:
        return pa.concat_tables([table, table])
    values = column.to_pylist() if kind == 3 else [draw(VALUES)] * len(table)
    values[draw(st.integers(0, len(values) - 1))] = draw(VALUES)
    try:
        changed = table.set_column(
            index, table.column_names[index], pa.array(values, column.type if kind == 3 else None)
        )
        pq.write_table(changed, io.BytesIO())  # not everything that Arrow holds can be written
        return changed
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        return table.remove_column(index)


@pytest.mark.parametrize("examples", EXAMPLES)
def test_datasets_with_changed_values_and_right_checksums(dataset, tmp_path, examples):
    root = shutil.copytree(dataset, tmp_path / "ds")

    @settings(max_examples=examples, **FEW)
    @given(data=st.data(), name=st.sampled_from(FILES))
    def run(data: st.DataObject, name: str) -> None:
        path = root / name
        if path.suffix == ".json":
            path.write_text(json.dumps(changed_json(data.draw, json.loads((dataset / name).read_text()))))
        else:
            table = changed_table(data.draw, pq.read_table(dataset / name))
            pq.write_table(table, path, row_group_size=5, write_page_checksum=True)
        read_dataset(root)
        restore(dataset, root, name)

    run()
    assert np.array_equal(Dataset(root)[0].columns["time_ns"], np.arange(5) * 33_333_333), "the sound one is readable"
