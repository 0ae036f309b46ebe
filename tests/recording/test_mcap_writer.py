"""The MCAP log while it is written: rows, skills and input as they come, crashes, full disks."""

from __future__ import annotations

import contextlib
import errno
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from h3data.errors import FormatError, InputError
from h3data.recording import (
    DatasetWriter,
    Event,
    InputEvent,
    Recording,
    RecordingHeader,
    RecordingWriter,
    SkillSpan,
    open_recording,
    open_steps,
    read_mcap,
    recordings_equal,
    recover_mcap,
    write_mcap,
)
from h3data.recording.mcap import part as mcap_part
from tests.recording.strategies import simple_recording


def test_skills_begin_as_running_and_are_replaced(tmp_path):
    rec = simple_recording(steps=10)
    with RecordingWriter(tmp_path / "a.mcap", replace(rec, skills=())) as writer:
        first = writer.skill(SkillSpan(agent=0, name="walk", start_step=0, end_step=0, outcome="running"))
        writer.append(rec.columns)
        writer.skill(SkillSpan(agent=1, name="wait", start_step=2, end_step=3))
        writer.skill(SkillSpan(agent=0, name="walk", start_step=0, end_step=9, outcome="failed"), replaces=first)
        with pytest.raises(InputError, match=r"(?s)replaces=7.*H3-RECORDING-011"):
            writer.skill(rec.skills[0], replaces=7)
    skills = read_mcap(tmp_path / "a.mcap").skills
    assert [(s.name, s.end_step, s.outcome) for s in skills] == [("walk", 9, "failed"), ("wait", 3, "done")]


def record_live(path: Path, rec: Recording, **options: Any) -> Path:
    """Row by row, as it would happen: each skill said twice, events between the rows."""
    with RecordingWriter(path, replace(rec, skills=(), events=()), **options) as writer:
        for span in rec.skills:
            writer.skill(replace(span, end_step=span.start_step, outcome="running"))
        for k in range(len(rec)):
            writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})
            for event in rec.events:
                if event.step == k:
                    writer.event(event)
        for number, span in enumerate(rec.skills):
            writer.skill(span, replaces=number)
    return path


def test_a_live_log_ends_as_the_file_that_is_written_at_once(tmp_path):
    rec = simple_recording(steps=100)
    at_once = write_mcap(rec, tmp_path / "at_once.mcap").read_bytes()
    live = record_live(tmp_path / "live.mcap", rec)
    assert live.read_bytes() == at_once
    assert len(record_live(tmp_path / "loose.mcap", rec, compact=False).read_bytes()) > len(at_once)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["at_once.mcap", "live.mcap", "loose.mcap"]


KEYS = tuple(
    InputEvent(time_ns=k * 10_000_000 - 7, kind=("key_down", "key_up")[k % 2], payload='{"key": "w"}')
    for k in range(90)
)


def record_typing(writer: RecordingWriter, rec: Recording) -> None:
    """Row by row, each after the keys that led to it."""
    keys = list(rec.inputs)
    for k, time_ns in enumerate(rec.columns["time_ns"]):
        while keys and keys[0].time_ns <= time_ns:
            writer.input(keys.pop(0))
        writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})
    for key in keys:
        writer.input(key)


def test_raw_input_keeps_its_own_times_between_the_rows(tmp_path):
    rec = replace(simple_recording(steps=20), skills=(), events=(), inputs=KEYS)
    at_once = write_mcap(rec, tmp_path / "at_once.mcap")
    for compact in (True, False):
        with RecordingWriter(
            tmp_path / "live.mcap", rec, overwrite=True, flush_rows=3, t0_unix_ns=1_000, compact=compact
        ) as writer:
            record_typing(writer, rec)
        assert recordings_equal(rec, read_mcap(tmp_path / "live.mcap")) == []
        reader = make_reader(io.BytesIO((tmp_path / "live.mcap").read_bytes()))
        came = [(m.log_time, s) for s, _, m in reader.iter_messages(topics=["/h3/input"])]
        assert [t for t, _ in came] == [1_000 + key.time_ns for key in KEYS]
        assert {s.name for _, s in came if s} == {"h3.Input"}
    assert recordings_equal(rec, read_mcap(at_once)) == []
    silent = make_reader(io.BytesIO(write_mcap(replace(rec, inputs=()), tmp_path / "silent.mcap").read_bytes()))
    summary = silent.get_summary()
    assert summary is not None
    assert "/h3/input" not in {c.topic for c in summary.channels.values()}


def test_raw_input_of_an_unfinished_log_is_saved(tmp_path):
    rec = replace(simple_recording(steps=20), skills=(), events=(), inputs=KEYS)
    writer = RecordingWriter(tmp_path / "a.mcap", rec, flush_rows=1)
    record_typing(writer, rec)
    writer.abort()
    recover_mcap(tmp_path / "a.mcap.part", tmp_path / "b.mcap")
    assert read_mcap(tmp_path / "b.mcap").inputs == KEYS


# --- files shared by the logs of a folder ------------------------------------------------------------------------------
def test_a_folder_of_logs_stores_their_scene_once(tmp_path):
    study, scene = tmp_path / "study", b"a scene" * 1000
    recs = [replace(simple_recording(seed=k, steps=60), attachments={"scene.glb": scene}) for k in range(3)]
    write_mcap(recs[0], study / "a.mcap", share_in=study)
    write_mcap(recs[1], study / "p01" / "b.mcap", share_in=study)
    with RecordingWriter(study / "p01" / "c.mcap", replace(recs[2], skills=(), events=()), share_in=study) as writer:
        for k in range(60):
            writer.append({n: a[k : k + 1] for n, a in recs[2].columns.items()})
    (file,) = (study / "h3" / "files").iterdir()
    assert file.read_bytes() == scene
    study = study.rename(tmp_path / "moved")
    for rec, log in zip(recs[:2], ("a.mcap", "p01/b.mcap"), strict=True):
        assert (study / log).stat().st_size < write_mcap(rec, tmp_path / "embedded.mcap", overwrite=True).stat().st_size
        assert recordings_equal(rec, open_recording(study / log)) == []
    assert read_mcap(study / "p01" / "c.mcap").attachments == {"scene.glb": scene}
    with open_steps(study / "p01/b.mcap") as steps:
        assert steps.recording(2, 4).attachments == {"scene.glb": scene}
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(read_mcap(study / "a.mcap"))
    with pytest.raises(InputError, match="H3-RECORDING-036"):
        write_mcap(recs[0], tmp_path / "elsewhere.mcap", share_in=study)
    assert not list(tmp_path.glob("elsewhere*"))


def test_a_shared_scene_that_is_missing_or_damaged_is_named(tmp_path):
    rec = simple_recording(steps=60)
    write_mcap(rec, tmp_path / "a.mcap", share_in=tmp_path)
    (file,) = (tmp_path / "h3" / "files").glob("*.glb")
    file.write_bytes(b"damaged")
    with pytest.raises(FormatError, match="H3-RECORDING-005"):
        open_recording(tmp_path / "a.mcap")
    file.unlink()
    with pytest.raises(FormatError, match="H3-RECORDING-037"):
        open_recording(tmp_path / "a.mcap")
    with open_steps(tmp_path / "a.mcap") as steps:
        assert len(steps.rows(0, 60)["time_ns"]) == 60, "numbers need no scene"
        with pytest.raises(FormatError, match=r"(?s)scene\.glb of the recording a\.mcap.*H3-RECORDING-037"):
            steps.recording(0, 4)
    saved = recover_mcap(tmp_path / "a.mcap", tmp_path / "saved.mcap")
    assert "scene.glb" in saved.reason
    back = read_mcap(saved.path)
    assert len(back) == 60
    assert "is missing" in back.episode.info["recovered"]["reason"]


@pytest.mark.parametrize("wrong", [{"time_ns": 2**63}, {"time_ns": 1, "payload": "\ud800"}])
def test_input_that_cannot_be_stored_is_refused(tmp_path, wrong):
    rec = replace(simple_recording(), inputs=(InputEvent(kind="text", **wrong),))
    with pytest.raises(InputError):
        write_mcap(rec, tmp_path / "a.mcap")
    with DatasetWriter(tmp_path / "ds") as writer:
        with pytest.raises(InputError, match=r"(?s)inputs.*H3-RECORDING-075"):
            writer.add(rec)
        assert writer.add(replace(rec, inputs=())) == 0


def test_start_time_and_info_given_late_survive_the_rewriting(tmp_path):
    rec, path = simple_recording(steps=70), tmp_path / "a.mcap"
    writer = RecordingWriter(path, rec, t0_unix_ns=5_000)
    for k in range(70):
        writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})
    writer.close(info={"ended": "collision"})
    reader = make_reader(io.BytesIO(path.read_bytes()))
    assert [r.metadata["info"] for r in reader.iter_metadata() if r.name == "h3.episode"] == ['{"ended": "collision"}']
    times = [m.log_time for _, _, m in reader.iter_messages(topics=["/h3/state"])]
    assert times == [5_000 + int(t) for t in rec.columns["time_ns"]]


@pytest.mark.parametrize("room", [0, 1_000, 4_000])
def test_no_room_for_the_rewriting_leaves_the_live_log(tmp_path, monkeypatch, room):
    def open_full(part, *, overwrite):
        if ".compact" not in part.name:
            return open(part, "wb")
        disk = FullDisk(part, "wb")
        disk.room = room
        return io.BufferedWriter(disk, 256)

    monkeypatch.setattr(mcap_part, "open_part", open_full)
    rec = simple_recording(steps=100)
    path = record_live(tmp_path / "a.mcap", rec)
    assert recordings_equal(rec, read_mcap(path)) == []
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert path.read_bytes() == record_live(tmp_path / "b.mcap", rec, compact=False).read_bytes()


def test_an_interrupt_while_rewriting_leaves_the_live_log(tmp_path, monkeypatch):
    rec = simple_recording(steps=100)

    def interrupted(writer, recording):
        raise KeyboardInterrupt

    monkeypatch.setattr(RecordingWriter, "append_recording", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_live(tmp_path / "a.mcap", rec)
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_disk_that_forgets_is_noticed(tmp_path, monkeypatch):
    rec = simple_recording(steps=100)

    def forgetful(part, final):
        data = bytearray(part.read_bytes())
        data[len(data) // 2] ^= 1
        final.write_bytes(data)

    monkeypatch.setattr(mcap_part, "publish", forgetful)
    with pytest.raises(FormatError, match="H3-RECORDING-018"):
        record_live(tmp_path / "a.mcap", rec)


def test_info_can_be_added_at_the_end(tmp_path):
    writer = RecordingWriter(tmp_path / "a.mcap", replace(simple_recording(), columns=simple_recording().columns))
    writer.append(simple_recording().columns)
    writer.close(info={"ended": "collision"})
    assert read_mcap(tmp_path / "a.mcap").episode.info == {"ended": "collision"}


def test_an_exception_leaves_a_part_that_can_be_recovered(tmp_path):
    rec = simple_recording(steps=50)
    path, part = tmp_path / "a.mcap", tmp_path / "a.mcap.part"

    def interrupted() -> None:
        with RecordingWriter(path, rec) as writer:
            for k in range(45):
                writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert part.exists()
    assert not path.exists()
    with pytest.raises(FormatError, match=r"(?s)never finished.*45.*H3-RECORDING-018"):
        open_recording(part)
    with pytest.raises(InputError, match=r"(?s)unfinished one exists.*H3-RECORDING-049"):
        open_recording(path)
    with pytest.raises(InputError, match="H3-RECORDING-014"):
        RecordingWriter(path, rec)
    saved = recover_mcap(part, tmp_path / "b.mcap")
    assert (saved.steps, saved.path) == (45, tmp_path / "b.mcap")
    back = read_mcap(saved.path)
    assert back.episode.info["recovered"]["steps"] == 45
    assert np.array_equal(back.columns["object_pose"], rec.columns["object_pose"][:45])


def test_recovering_to_the_name_it_should_have_had(tmp_path):
    rec, path = simple_recording(steps=50), tmp_path / "a.mcap"
    writer = RecordingWriter(path, rec)
    writer.append(rec.columns)
    writer.abort()
    part = path.with_name("a.mcap.part")
    before = part.read_bytes()
    assert recover_mcap(part, path).steps == 50
    assert len(read_mcap(path)) == 50
    assert part.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "a.mcap.part"}
    with pytest.raises(InputError, match="H3-RECORDING-031"):
        recover_mcap(part, path)


def test_byte_order_does_not_matter(tmp_path):
    rec = simple_recording(steps=4)
    swapped = replace(
        rec, columns={n: a if n == "time_ns" else a.astype(a.dtype.newbyteorder(">")) for n, a in rec.columns.items()}
    )
    assert recordings_equal(rec, read_mcap(write_mcap(swapped, tmp_path / "a.mcap"))) == []
    with pytest.raises(InputError, match="H3-RECORDING-008"):
        write_mcap(replace(rec, episode=replace(rec.episode, info={"t0_unix_ns": "now"})), tmp_path / "b.mcap")
    late = replace(rec, episode=replace(rec.episode, info={"t0_unix_ns": 1_700_000_000 * 10**9}))
    reader = make_reader(io.BytesIO(write_mcap(late, tmp_path / "c.mcap").read_bytes()))
    times = [m.log_time for _, c, m in reader.iter_messages(topics=["/h3/state"])]
    assert times == [1_700_000_000 * 10**9 + int(t) for t in rec.columns["time_ns"]]


def test_what_was_flushed_survives_a_killed_process(tmp_path):
    rec = simple_recording(steps=70)
    writer = RecordingWriter(tmp_path / "a.mcap", rec, flush_s=1e9)
    for k in range(70):
        writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})
    on_disk = (tmp_path / "a.mcap.part").read_bytes()  # what another process would find now
    writer.abort(keep=False)
    assert not list(tmp_path.iterdir())
    (tmp_path / "killed.part").write_bytes(on_disk)
    assert recover_mcap(tmp_path / "killed.part", tmp_path / "b.mcap").steps == 60
    with pytest.raises(InputError, match="H3-RECORDING-012"):
        writer.append(rec.columns)


class FullDisk(io.FileIO):
    """A disk with room for ``room`` bytes."""

    room = 3000

    def write(self, data) -> int:  # type: ignore[override]
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


@pytest.mark.parametrize("room", [10, 3000, 20_000])
def test_a_full_disk_never_shows_the_final_name(tmp_path, monkeypatch, room):
    def open_full(part, *, overwrite):
        disk = FullDisk(part, "wb")
        disk.room = room
        return io.BufferedWriter(disk, 256)

    monkeypatch.setattr(mcap_part, "open_part", open_full)
    rec = simple_recording(steps=600)

    def record() -> None:
        with RecordingWriter(tmp_path / "a.mcap", rec) as writer:
            for k in range(600):
                writer.append({n: a[k : k + 1] for n, a in rec.columns.items()})

    with pytest.raises(InputError, match=r"(?s)No space left on device.*H3-RECORDING-017"):
        record()
    assert not (tmp_path / "a.mcap").exists()
    if room == 20_000:
        monkeypatch.undo()
        steps = recover_mcap(tmp_path / "a.mcap.part", tmp_path / "b.mcap").steps
        assert steps > 0
        assert steps % 30 == 0


class FillingDisk(io.FileIO):
    """A disk that takes what there is room for, as the operating system does: a part of a write, then an error."""

    room = 0

    def write(self, data) -> int:  # type: ignore[override]
        room = self.room - self.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(memoryview(data)[:room])


@pytest.mark.parametrize("rows", [7, 30])
def test_a_writer_goes_on_when_a_full_disk_has_space_again(tmp_path, monkeypatch, rows):
    rec, disks = simple_recording(steps=120), []

    def open_filling(part, *, overwrite):
        disks.append(FillingDisk(part, "wb"))
        disks[-1].room = 12_345
        return disks[-1]

    def tried(act) -> None:
        """As somebody who clears the disk bit by bit: after each fault there is a little more room."""
        while True:
            try:
                act()
                return
            except InputError as fault:
                said.add("No space left on device" in str(fault))
                faults.append(recover(tmp_path / "a.mcap.part"))
                disks[0].room += 777
                act = writer.close if act == writer.close else writer.flush

    def recover(part) -> int:
        with contextlib.suppress(FormatError):
            return recover_mcap(part, tmp_path / "saved" / "a.mcap", overwrite=True).steps
        return 0

    faults: list[int] = []
    said: set[bool] = set()
    monkeypatch.setattr(mcap_part, "open_part", open_filling)
    (tmp_path / "saved").mkdir()
    writer = RecordingWriter(tmp_path / "a.mcap", rec, compact=False, flush_rows=rows, flush_s=1e9)
    monkeypatch.undo()
    for k in range(0, 120, rows):
        tried(lambda k=k: writer.append({n: a[k : k + rows] for n, a in rec.columns.items()}))
    for event in rec.events:
        writer.event(event)
    for span in rec.skills:
        writer.skill(span)
    for message in rec.inputs:
        writer.input(message)
    tried(writer.close)
    assert len(faults) > 4
    assert said == {True}
    assert faults == sorted(faults), "what is on the disk can be read at any moment"
    assert recordings_equal(rec, read_mcap(tmp_path / "a.mcap")) == []
    assert not (tmp_path / "a.mcap.part").exists()
    with pytest.raises(InputError, match="H3-RECORDING-012"):
        writer.append(rec.columns)


def test_existing_files_are_kept(tmp_path):
    path = write_mcap(simple_recording(), tmp_path / "a.mcap")
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"(?s)a\.mcap.*H3-RECORDING-013"):
        write_mcap(simple_recording(seed=1), path)
    assert path.read_bytes() == before
    write_mcap(simple_recording(seed=1), path, overwrite=True)
    assert read_mcap(path).episode.seed == 1


def test_rows_that_do_not_fit_are_refused(tmp_path):
    rec = simple_recording(steps=4)
    rows = dict(rec.columns)
    with RecordingWriter(tmp_path / "a.mcap", rec) as writer:
        bad = {
            **rows,
            "agent_0.action": rows["agent_0.action"][:, :1],
            "metrics.collision": np.zeros(4),
            "new": rows["time_ns"],
        }
        del bad["agent_1.base_pose"]
        with pytest.raises(InputError) as error:
            writer.append(bad)
        for name in ("agent_0.action", "metrics.collision", "new", "agent_1.base_pose is missing"):
            assert name in str(error.value)
        with pytest.raises(InputError, match="H3-RECORDING-033"):
            writer.append({**rows, "agent_0.action": rows["agent_0.action"][:3]})
        writer.append(rows)
        with pytest.raises(InputError, match="H3-RECORDING-034"):
            writer.append(rows)
    assert recordings_equal(read_mcap(tmp_path / "a.mcap"), replace(rec, skills=(), events=())) == []


def test_headers_decide_or_the_first_rows_do(tmp_path):
    rec = simple_recording(steps=4)
    header = RecordingHeader(episode=rec.episode, assets=rec.assets, bodies=rec.bodies, agents=rec.agents)
    with RecordingWriter(tmp_path / "a.mcap", header) as writer:
        writer.append(rec.columns)
    assert set(read_mcap(tmp_path / "a.mcap").columns) == set(rec.columns)
    with RecordingWriter(tmp_path / "b.mcap", header):
        pass  # ended before its first step
    empty = read_mcap(tmp_path / "b.mcap")
    assert len(empty) == 0
    assert empty.columns["object_pose"].shape == (0, 2, 7)
    with (
        pytest.raises(FormatError, match=r"(?s)'e0'.*object_pose.*H3-RECORDING-107"),
        RecordingWriter(tmp_path / "c.mcap", header) as writer,
    ):
        writer.append({**rec.columns, "object_pose": rec.columns["object_pose"][:, :1]})
    with pytest.raises(InputError, match=r"(?s)'sim\.z' has dtype complex128.*H3-RECORDING-108"):
        write_mcap(replace(rec, columns={**rec.columns, "sim.z": np.zeros(4, complex)}), tmp_path / "d.mcap")
    with pytest.raises(InputError, match="H3-RECORDING-114"):
        write_mcap(replace(rec, episode=replace(rec.episode, info={"x": object()})), tmp_path / "e.mcap")
    with pytest.raises(InputError, match="H3-RECORDING-009"):
        write_mcap(replace(rec, episode=replace(rec.episode, scene="\udcff")), tmp_path / "f.mcap")
    with pytest.raises(InputError, match=r"(?s)h3\.Event.*H3-RECORDING-010"):
        write_mcap(replace(rec, events=(Event(step=2**80, agent=0, kind="x"),)), tmp_path / "g.mcap")
    assert {p.name for p in tmp_path.iterdir()} >= {"a.mcap", "b.mcap"}
    assert not {"c.mcap", "d.mcap", "e.mcap", "f.mcap", "g.mcap"} & {p.name for p in tmp_path.iterdir()}
