"""The MCAP log: what is written comes back exactly, whatever happens to the file is said."""

from __future__ import annotations

import dataclasses
import io
import random
import struct
from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from h3data.errors import FormatError, InputError
from h3data.recording import (
    Recording,
    RecordingWriter,
    open_recording,
    open_steps,
    read_mcap,
    recordings_equal,
    recover_mcap,
    write_mcap,
)
from h3data.recording.mcap.scan import MAGIC
from h3data.recording.mcap.wire import message_class, step_descriptor, struct_descriptor, wire_layouts
from h3data.recording.schema import RECORD_TYPES, STRUCTS, layout_of
from tests.random_cases import examples
from tests.recording.strategies import recordings, simple_recording

SOME = settings(
    max_examples=20, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@SOME
@given(rec=recordings())
@example(rec=simple_recording(steps=0))
@example(rec=simple_recording(steps=1, bodies=0))
def test_what_is_written_is_read(tmp_path, rec):
    write_mcap(rec, tmp_path / "a.mcap", overwrite=True)
    back = read_mcap(tmp_path / "a.mcap")
    assert recordings_equal(rec, back) == []
    assert list(back.columns) == list(rec.columns)
    assert all(a.flags.writeable and a.flags.c_contiguous for a in back.columns.values())


@SOME
@given(rec=recordings(max_steps=20), sizes=st.lists(st.integers(0, 7), max_size=8), flush_rows=st.integers(1, 9))
def test_blocks_of_any_size_make_the_same_recording(tmp_path, rec, sizes, flush_rows):
    cuts = np.clip(np.cumsum([0, *sizes, 40]), 0, len(rec))
    for compact in (False, True):
        with RecordingWriter(
            tmp_path / "a.mcap", rec, overwrite=True, flush_rows=flush_rows, compact=compact
        ) as writer:
            for a, b in pairwise(cuts):
                writer.append({n: v[a:b] for n, v in rec.columns.items()})
            for span in rec.skills:
                writer.skill(span)
            for event in rec.events:
                writer.event(event)
            for given_input in rec.inputs:
                writer.input(given_input)
        assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []


def test_equal_recordings_make_equal_files(tmp_path):
    a, b = (write_mcap(simple_recording(), tmp_path / name).read_bytes() for name in ("a.mcap", "b.mcap"))
    assert a == b


def test_every_field_of_every_record_is_stored():
    for name, record in RECORD_TYPES.items():
        assert list(STRUCTS[name]) == [f.name for f in fields(record)], f"a field of {record.__name__} would be lost"


def test_other_readers_decode_the_messages(tmp_path):
    rec = simple_recording(steps=5)
    data = write_mcap(rec, tmp_path / "a.mcap").read_bytes()
    seen: dict[str, list] = {}
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        decoded = message_class(schema.data, schema.name).FromString(message.data)
        seen.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {t: len(m) for t, m in seen.items()} == {
        "/h3/scene": 1,
        "/h3/state": 5,
        "/h3/action": 5,
        "/h3/skill": 1,
        "/h3/event": 1,
    }
    for k, (log_time, state) in enumerate(seen["/h3/state"]):
        assert (state.step, state.time_ns, log_time) == (k, rec.columns["time_ns"][k], rec.columns["time_ns"][k])
        assert np.array_equal(np.float32(state.object_pose), rec.columns["object_pose"][k].ravel())
        assert np.array_equal(np.float32(state.agent_1_base_pose), rec.columns["agent_1.base_pose"][k])
    assert seen["/h3/scene"][0][1].bodies[1].name == "box 1"
    assert reader.get_header().profile == "h3data"


def test_rerun_opens_it(tmp_path):
    chunk = pytest.importorskip("rerun.chunk")
    write_mcap(simple_recording(steps=50), tmp_path / "a.mcap")
    rows = {c.entity_path: c.num_rows for c in chunk.McapReader(str(tmp_path / "a.mcap")).stream() if c.num_rows > 1}
    assert rows == {"/h3/state": 50, "/h3/action": 50}


def test_field_names_are_unique_protobuf_names():
    rec = simple_recording(steps=1)
    columns = {n: np.zeros(1, np.float32) for n in ("sim.a_b", "sim.aB", "sim.a.b", "步", "1", "step", "STEP", "sim.x")}
    layout = layout_of({**rec.columns, **columns})
    state = wire_layouts(layout)["state"]
    assert len({f.name for f in state}) == len(state)
    assert message_class(step_descriptor("State", state), "h3.State") is not None


def test_only_the_wanted_columns(tmp_path):
    rec = simple_recording()
    path = write_mcap(rec, tmp_path / "a.mcap")
    part = read_mcap(path, columns=["metrics.dist_agents"])
    needed = {"time_ns", "object_pose", "agent_0.base_pose", "agent_1.base_pose"}
    assert set(part.columns) == {"metrics.dist_agents", *needed}
    assert np.array_equal(part.columns["metrics.dist_agents"], rec.columns["metrics.dist_agents"])
    with pytest.raises(InputError, match=r"(?s)\['metrics\.nope'\].*H3-RECORDING-028"):
        read_mcap(path, columns=["metrics.nope"])


# --- messages of other writers -----------------------------------------------------------------------------------------
def rewritten(
    data: bytes, edit, *, extra=None, schema=lambda text: text, profile="h3data", records=True, **options
) -> bytes:
    """The log with every message passed through ``edit(topic, decoded) -> bytes``, written by mcap alone; without ``records``
    only its messages."""
    out, reader = io.BytesIO(), make_reader(io.BytesIO(data))
    writer = Writer(out, **options)
    writer.start(profile=profile)
    ids: dict[int, int] = {}
    for of, channel, message in reader.iter_messages(log_time_order=False):
        assert of is not None
        if channel.id not in ids:
            ids[channel.id] = writer.register_channel(
                channel.topic,
                channel.message_encoding,
                writer.register_schema(of.name, of.encoding, schema(of.data)),
                channel.metadata,
            )
        decoded = message_class(of.data, of.name).FromString(message.data)
        changed = edit(channel.topic, decoded)
        if changed is not None:
            writer.add_message(ids[channel.id], message.log_time, changed, message.publish_time)
    if extra:
        extra(writer)
    for record in reader.iter_metadata() if records else ():
        writer.add_metadata(record.name, record.metadata)
    for record in reader.iter_attachments() if records else ():
        writer.add_attachment(0, 0, record.name, record.media_type, record.data)
    writer.finish()
    return out.getvalue()


def test_messages_without_zeros_take_the_slow_path(tmp_path):
    rec = simple_recording(steps=9)  # protobuf leaves out zeros: lengths differ, e.g. in step 0
    (tmp_path / "a.mcap").write_bytes(
        rewritten(write_mcap(rec, tmp_path / "b.mcap").read_bytes(), lambda _, m: m.SerializeToString())
    )
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []


@pytest.mark.parametrize("compression", list(CompressionType))
def test_logs_of_any_compression_are_read(tmp_path, compression):
    """Other tools write a log anew with their own defaults, e.g. lz4."""
    rec = simple_recording(steps=9)
    data = rewritten(
        write_mcap(rec, tmp_path / "b.mcap").read_bytes(),
        lambda _, m: m.SerializeToString(),
        compression=compression,
        chunk_size=2000,
    )
    (tmp_path / "a.mcap").write_bytes(data)
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    saved = recover_mcap(tmp_path / "cut.mcap", tmp_path / "saved.mcap")
    assert 0 < saved.steps <= len(rec)


@pytest.mark.parametrize("profile", ["h3data", "", "tool"])
def test_logs_without_metadata_records_are_read(tmp_path, profile):
    """Other tools filter and merge logs, and leave our metadata records and attachments out."""
    rec, path = simple_recording(steps=30), tmp_path / "bare.mcap"
    whole = write_mcap(rec, tmp_path / "b.mcap").read_bytes()
    data = rewritten(whole, lambda _, m: m.SerializeToString(), profile=profile, records=False, chunk_size=2000)
    path.write_bytes(data)
    back = read_mcap(path)
    expected = dataclasses.replace(rec, episode=back.episode, attachments={})
    assert recordings_equal(expected, back) == []
    assert back.episode.dt_ns == int(rec.columns["time_ns"][1] - rec.columns["time_ns"][0])
    assert (back.episode.task, back.episode.info["recovered"]["steps"]) == ("unknown", 30)
    assert set(read_mcap(path, columns=["metrics.dist_agents"]).columns) >= {"metrics.dist_agents", "time_ns"}
    with open_steps(path) as steps:
        assert recordings_equal(dataclasses.replace(steps.recording(0, 30), episode=back.episode), back) == []
        assert steps.recording(3, 4).episode.uid == back.episode.uid
    write_mcap(back, tmp_path / "again.mcap")
    assert recordings_equal(read_mcap(tmp_path / "again.mcap"), back) == []
    assert "no metadata records" in recover_mcap(path, tmp_path / "whole.mcap").reason
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"(?s), [1-9]\d* .*h3data recover.*H3-RECORDING-018"):
        read_mcap(path)
    assert 0 < recover_mcap(path, tmp_path / "saved.mcap").steps < 30
    assert read_mcap(tmp_path / "saved.mcap").episode.info["recovered"]["reason"].startswith("truncated")
    assert "no metadata records" in read_mcap(tmp_path / "saved.mcap").episode.info["recovered"]["reason"]


def test_metadata_records_out_of_reach_are_not_made_up(tmp_path):
    """The log has its metadata records, but its summary does not index them: steps cannot be told apart from a bare log's."""
    rec = simple_recording(steps=9)
    index = IndexType.ALL & ~IndexType.METADATA
    data = rewritten(
        write_mcap(rec, tmp_path / "b.mcap").read_bytes(), lambda _, m: m.SerializeToString(), index_types=index
    )
    (tmp_path / "a.mcap").write_bytes(data)
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []
    with pytest.raises(FormatError, match="H3-RECORDING-040"):
        open_steps(tmp_path / "a.mcap")


def test_unknown_topics_and_fields_are_skipped(tmp_path):
    rec = simple_recording(steps=9)

    def more_topics(writer: Writer) -> None:
        channel = writer.register_channel("/h3/clouds", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel, 5, b"{}", 5)

    unknown_field = bytes([0xFA, 0x3F, 3]) + b"abc"  # field 1023, three bytes
    data = rewritten(
        write_mcap(rec, tmp_path / "b.mcap").read_bytes(),
        lambda _, m: m.SerializeToString() + unknown_field,
        extra=more_topics,
    )
    (tmp_path / "a.mcap").write_bytes(data)
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []


def test_a_lost_message_is_noticed(tmp_path):
    rec = simple_recording(steps=9)
    for topic in ("/h3/state", "/h3/action"):
        data = rewritten(
            write_mcap(rec, tmp_path / "b.mcap", overwrite=True).read_bytes(),
            lambda t, m, lost=topic: None if t == lost and m.step == 4 else m.SerializeToString(),
        )
        (tmp_path / "a.mcap").write_bytes(data)
        with pytest.raises(FormatError, match=r"(?s)0\.\.8.*H3-RECORDING-027"):
            read_mcap(tmp_path / "a.mcap")
        assert recover_mcap(tmp_path / "a.mcap", tmp_path / "c.mcap", overwrite=True).steps == 4


# --- hostile files -----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> tuple[Recording, bytes]:
    rec = simple_recording(steps=90)
    path = tmp_path_factory.mktemp("sound") / "a.mcap"
    with RecordingWriter(path, rec, compact=False) as writer:
        for k in range(0, 90, 10):
            writer.append({n: a[k : k + 10] for n, a in rec.columns.items()})
        writer.skill(rec.skills[0])
        writer.event(rec.events[0])
    return rec, path.read_bytes()


def test_truncated_anywhere(tmp_path, sound):
    rec, data = sound
    rng = random.Random(1)
    path, last = tmp_path / "t.mcap", -1
    for cut in sorted({0, 1, 8, len(data) - 1, *(rng.randrange(len(data)) for _ in range(60))}):
        path.write_bytes(data[:cut])
        with pytest.raises(FormatError) as error:
            read_mcap(path)
        try:
            saved = recover_mcap(path, tmp_path / "r.mcap", overwrite=True)
        except FormatError:
            assert last <= 0, "more bytes cannot hold less"
            continue
        assert f" {saved.steps} complete steps" in str(error.value)
        assert saved.steps >= last
        last = saved.steps
        back = read_mcap(tmp_path / "r.mcap")
        assert len(back) == saved.steps
        assert all(np.array_equal(back.columns[n], a[: len(back)]) for n, a in rec.columns.items() if n in back.columns)
    assert last == 90


def test_flipped_bits_anywhere(tmp_path, sound):
    rec, data = sound
    rng = random.Random(2)
    path = tmp_path / "t.mcap"
    for _ in range(100):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(FormatError):
            read_mcap(path)
        try:
            recover_mcap(path, tmp_path / "r.mcap", overwrite=True)
        except FormatError:
            continue
        back = read_mcap(tmp_path / "r.mcap")  # whatever was saved are true rows: chunks have checksums
        assert all(np.array_equal(back.columns[n], a[: len(back)]) for n, a in rec.columns.items())


@settings(max_examples=examples(80), deadline=None, derandomize=True)
@given(junk=st.binary(max_size=200), magic=st.booleans())
def test_junk_is_refused(tmp_path_factory, junk, magic):
    path = tmp_path_factory.getbasetemp() / "junk.mcap"
    path.write_bytes((MAGIC if magic else b"") + junk)
    for read in (read_mcap, open_recording, lambda p: recover_mcap(p, p.with_suffix(".out"))):
        with pytest.raises(FormatError):
            read(path)


def edited_metadata(data: bytes, name: str, **changes: str) -> bytes:
    """The log with other values in one of its metadata records, checksums made right again."""
    out, reader = io.BytesIO(), make_reader(io.BytesIO(data))
    writer = Writer(out)
    writer.start(profile="h3data")
    for record in reader.iter_metadata():
        writer.add_metadata(record.name, {**record.metadata, **(changes if record.name == name else {})})
    writer.finish()
    return out.getvalue()


def test_newer_and_foreign_files_are_named(tmp_path, sound):
    path = tmp_path / "t.mcap"
    path.write_bytes(edited_metadata(sound[1], "h3.schema", version="2.0"))
    for read in (read_mcap, lambda p: recover_mcap(p, tmp_path / "out.mcap")):
        with pytest.raises(FormatError, match=r"(?s)2\.0.*H3-RECORDING-110"):
            read(path)
    path.write_bytes(edited_metadata(sound[1], "h3.schema", version="soon"))
    with pytest.raises(FormatError, match="H3-RECORDING-112"):
        read_mcap(path)
    path.write_bytes(edited_metadata(sound[1], "h3.episode", seed="many"))
    with pytest.raises(FormatError):
        read_mcap(path)
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(FormatError, match=r"(?s)'ros2'.*H3-RECORDING-020"):
        read_mcap(path)
    with pytest.raises(FormatError, match="H3-RECORDING-025"):
        read_mcap(tmp_path)
    with pytest.raises(InputError, match="H3-FORMAT-013"):
        read_mcap(tmp_path / "none.mcap")


def test_a_length_that_lies_allocates_nothing(tmp_path):
    lie = struct.pack("<BQ", 6, 2**63)  # a chunk of 8 EiB, as an unfinished chunk of the Rust writer looks
    (tmp_path / "a.mcap").write_bytes(MAGIC + lie + b"x" * 50)
    with pytest.raises(FormatError, match=r"(?s)truncated.*H3-RECORDING-018"):
        read_mcap(tmp_path / "a.mcap")


def test_fields_of_another_type_are_refused(tmp_path, sound):
    path = tmp_path / "t.mcap"
    data = rewritten(
        sound[1],
        lambda _, m: m.SerializeToString(),
        schema=lambda text: text.replace(b"semantic_id\x18\x05 \x01", b"semantic_id\x18\x05 \x03"),
    )
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"(?s)int64.*Body\.semantic_id.*H3-RECORDING-113"):
        read_mcap(path)


def test_descriptors_do_not_change_by_accident():
    cls = message_class(struct_descriptor(), "h3.Skill")
    numbers = {f.name: f.number for f in cls.DESCRIPTOR.fields}
    assert numbers == {
        "agent": 1,
        "name": 2,
        "target": 3,
        "start_step": 4,
        "end_step": 5,
        "outcome": 6,
        "reason": 7,
        "span": 100,
    }
