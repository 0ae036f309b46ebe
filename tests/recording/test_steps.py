"""Single steps of stored episodes: the same as of the whole, without reading the whole; damage is named or not touched."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from h3data.errors import FormatError, H3DataError, InputError
from h3data.recording import (
    DatasetWriter,
    Event,
    InputEvent,
    Recording,
    RecordingWriter,
    SkillSpan,
    Steps,
    open_steps,
    read_mcap,
    recordings_equal,
    write_mcap,
)
from h3data.recording.mcap.steps import McapSteps
from h3data.recording.storage import place
from tests.recording.strategies import recordings, simple_recording

SOME = settings(
    max_examples=15, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def small_chunks(rec: Recording, path: Path, rows: int) -> Path:
    """A log in chunks of a few rows, with skills and events between them."""
    with RecordingWriter(path, rec, overwrite=True, flush_rows=rows, chunk_bytes=700, compact=False) as writer:
        for k in range(0, len(rec), rows):
            writer.append({n: a[k : k + rows] for n, a in rec.columns.items()})
            for event in rec.events[k // rows :: 50]:
                writer.event(event)
        for span in rec.skills:
            writer.skill(span)
        for given_input in rec.inputs:
            writer.input(given_input)
    return path


def as_dataset(rec: Recording, root: Path) -> Path:
    with DatasetWriter(root, overwrite=True, nominal_fps=True) as writer:
        writer.add(replace(rec, episode=replace(rec.episode, uid="other")))
        writer.add(rec)
    return root


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return list(a) == list(b) and all(
        a[n].dtype == b[n].dtype and a[n].shape == b[n].shape and a[n].tobytes() == b[n].tobytes() for n in a
    )


@pytest.mark.slow
@SOME
@given(rec=recordings(max_steps=25), cut=st.tuples(st.integers(0, 25), st.integers(0, 25)), rows=st.integers(1, 9))
@example(rec=simple_recording(steps=0), cut=(0, 0), rows=1)
@example(rec=simple_recording(steps=20), cut=(3, 17), rows=2)
def test_rows_are_those_of_the_whole(tmp_path, rec, cut, rows):
    start, stop = sorted(min(c, len(rec)) for c in cut)
    expected = {n: a[start:stop] for n, a in rec.columns.items()}
    for open_it in (
        lambda: open_steps(write_mcap(rec, tmp_path / "a.mcap", overwrite=True)),
        lambda: open_steps(small_chunks(rec, tmp_path / "b.mcap", rows)),
        lambda: open_steps(as_dataset(rec, tmp_path / "ds"), episode=1),
    ):
        with open_it() as steps:
            assert len(steps) == len(rec)
            assert {c.name for c in steps.layout} == set(rec.columns)
            assert same(steps.rows(start, stop), expected)
            some = list(rec.columns)[1::2]
            assert same(steps.rows(start, stop, columns=some[::-1]), {n: expected[n] for n in some})
            for k in (0, -1) if len(rec) else ():
                assert same(steps[k], {n: a[k] for n, a in rec.columns.items()})


def stores(rec: Recording, folder: Path) -> list[Steps]:
    return [
        open_steps(write_mcap(rec, folder / "a.mcap")),
        open_steps(small_chunks(rec, folder / "b.mcap", 7)),
        open_steps(as_dataset(rec, folder / "ds"), episode=1),
    ]


def test_a_window_is_a_recording_of_its_own(tmp_path):
    rec = replace(
        simple_recording(steps=60),
        skills=(
            SkillSpan(agent=0, name="before", start_step=0, end_step=19),
            SkillSpan(agent=0, name="over", start_step=15, end_step=45, outcome="failed", reason="late"),
            SkillSpan(agent=1, name="in", start_step=22, end_step=24),
            SkillSpan(agent=1, name="after", start_step=30, end_step=59),
        ),
        events=tuple(Event(step=k, agent=0, kind=str(k)) for k in (3, 19, 20, 29, 30)),
    )
    for steps in stores(rec, tmp_path):
        window = steps.recording(20, 30)
        assert same(dict(window.columns), {n: a[20:30] for n, a in rec.columns.items()})
        assert [(s.name, s.start_step, s.end_step, s.outcome) for s in window.skills] == [
            ("over", 0, 9, "running"),
            ("in", 2, 4, "done"),
        ]
        assert [(e.kind, e.step) for e in window.events] == [("20", 0), ("29", 9)]
        assert window.episode.info["window"] == {"start": 20, "stop": 30, "of": 60}
        assert window.attachments == rec.attachments
        whole = steps.recording(0, 60)
        assert recordings_equal(rec, replace(whole, episode=rec.episode)) == []
        steps.close()


def test_windows_side_by_side_share_out_the_input(tmp_path):
    """What came between two rows belongs to the later one; what came before and after the episode to its ends."""
    plain = simple_recording(steps=60)
    times = plain.columns["time_ns"]
    came = [-5, int(times[0]), int(times[20]), int(times[20]) + 1, int(times[33]), int(times[59]), int(times[59]) + 9]
    rec = replace(plain, inputs=tuple(InputEvent(time_ns=t, kind=str(k)) for k, t in enumerate(came)))
    cuts = [0, 1, 20, 21, 21, 22, 34, 59, 60, 60]
    for steps in stores(rec, tmp_path):
        with steps:
            parts = [steps.recording(a, b).inputs for a, b in itertools.pairwise(cuts)]
            assert tuple(itertools.chain(*parts)) == rec.inputs == steps.recording(0, 60).inputs
            assert [i.kind for i in steps.recording(20, 21).inputs] == ["2"]
            assert [i.kind for i in steps.recording(21, 34).inputs] == ["3", "4"]


def test_a_step_can_be_drawn_without_the_others(tmp_path):
    from h3data.replay import Replay

    rec = simple_recording(steps=60)
    rec = replace(rec, attachments={}, agents=tuple(replace(agent, model="") for agent in rec.agents))
    whole = Replay(rec).at(41)
    for steps in stores(rec, tmp_path):
        with steps:
            alone = Replay(steps.recording(41, 42)).at(0)
        assert alone.poses.keys() == whole.poses.keys()
        assert all(np.array_equal(alone.poses[name], pose) for name, pose in whole.poses.items())


def test_what_is_not_there_is_refused(tmp_path):
    for steps in stores(simple_recording(steps=9), tmp_path):
        for start, stop in ((-1, 3), (0, 10), (5, 4)):
            with pytest.raises(InputError, match=r"(?s)9, 0.*8.*H3-RECORDING-117"):
                steps.rows(start, stop)
        with pytest.raises(IndexError, match="there is no 9"):
            steps[9]
        with pytest.raises(InputError, match=r"(?s)\['nope'\].*time_ns.*H3-RECORDING-116"):
            steps.rows(0, 1, columns=["nope"])
        steps.close()
    with pytest.raises(InputError, match="H3-RECORDING-055"):
        open_steps(tmp_path / "ds")
    with pytest.raises(InputError, match=r"(?s)7.*H3-RECORDING-065"):
        open_steps(tmp_path / "ds", episode=7)
    with pytest.raises(InputError, match="H3-RECORDING-051"):
        open_steps(tmp_path / "a.mcap", episode=0)
    with pytest.raises(InputError, match=r"(?s)No such.*H3-RECORDING-026"):
        open_steps(tmp_path / "none.mcap")


def test_only_what_is_needed_is_read(tmp_path, monkeypatch):
    rec = simple_recording(steps=3000)
    path = small_chunks(rec, tmp_path / "a.mcap", 100)
    read: list[int] = []
    with McapSteps(path) as steps:
        whole = steps._bytes

        def counted(offset: int, size: int) -> bytes:
            read.append(size)
            return whole(offset, size)

        monkeypatch.setattr(steps, "_bytes", counted)
        steps.rows(1234, 1236)
    assert 0 < sum(read) < path.stat().st_size / 20


def test_uris(tmp_path):
    rec = simple_recording(steps=40)
    write_mcap(rec, place("mock://steps/a.mcap"))
    with open_steps("mock://steps/a.mcap") as steps:
        assert same(steps[17], {n: a[17] for n, a in rec.columns.items()})


# --- bad files ---------------------------------------------------------------------------------------------------------
def everything(path: Path) -> list[Recording]:
    with open_steps(path) as steps:
        return [steps.recording(k, k + 1) for k in range(len(steps))]


def test_a_log_with_a_flipped_bit_anywhere(tmp_path):
    rec = replace(simple_recording(steps=12, bodies=1), attachments={"a": b"x"})
    data, path = small_chunks(rec, tmp_path / "a.mcap", 4).read_bytes(), tmp_path / "b.mcap"
    for at in range(0, len(data), 67):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            found = everything(path)
        except FormatError:
            continue
        for k, window in enumerate(found):  # what is given is the truth
            assert same(dict(window.columns), {n: a[k : k + 1] for n, a in rec.columns.items()}), at
    for cut in range(0, len(data), 131):
        path.write_bytes(data[:cut])
        with pytest.raises(FormatError):
            open_steps(path)


def test_unfinished_and_other_logs_are_named(tmp_path):
    rec, path = simple_recording(steps=50), tmp_path / "a.mcap"
    writer = RecordingWriter(path, rec)
    writer.append(rec.columns)
    writer.abort()
    with pytest.raises(FormatError, match=r"(?s)never finished.*H3-RECORDING-041"):
        open_steps(path.with_name("a.mcap.part"))
    others: list[tuple[dict[str, Any], str]] = [
        (
            {
                "index_types": IndexType.NONE,
                "use_statistics": False,
                "repeat_channels": False,
                "repeat_schemas": False,
                "use_summary_offsets": False,
            },
            "H3-RECORDING-039",
        ),
        ({"compression": CompressionType.LZ4}, "H3-RECORDING-020"),
    ]
    for options, found in others:
        with open(path, "wb") as stream:
            other = Writer(stream, **options)
            other.start(profile="h3data" if "summary" in found else "ros2")
            other.finish()
        with pytest.raises(FormatError, match=found):
            open_steps(path)
    path.write_bytes(b"PAR1" * 40)
    with pytest.raises(FormatError, match="H3-RECORDING-038"):
        open_steps(path)


@SOME
@given(data=st.data())
def test_logs_with_changed_bytes(tmp_path, data):
    path = tmp_path / "a.mcap"
    sound = bytearray(small_chunks(simple_recording(steps=6, bodies=1), path, 2).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(sound) - 1))
        if data.draw(st.booleans()):
            sound[at : at + 8] = data.draw(st.sampled_from([0, 1, 2**31, 2**62, 2**64 - 1])).to_bytes(8, "little")
        else:
            del sound[at : at + data.draw(st.integers(1, 40))]
    path.write_bytes(sound)
    try:
        everything(path)
    except H3DataError:
        with pytest.raises(H3DataError):
            read_mcap(path)
