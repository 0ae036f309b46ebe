"""Recording on bad days: processes are killed at any moment, disks fill up, folders are read-only, files end anywhere."""

from __future__ import annotations

import contextlib
import io
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.dataset as pads
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from h3data.errors import FormatError, H3DataError, InputError
from h3data.recording import (
    Dataset,
    DatasetWriter,
    Event,
    Recording,
    RecordingWriter,
    SkillSpan,
    open_recording,
    read_mcap,
    recordings_equal,
    recover_mcap,
    write_mcap,
)
from h3data.recording.mcap.scan import scan_records
from tests.paths import ROOT
from tests.random_cases import examples
from tests.recording.strategies import simple_recording

FLUSH_ROWS = 30  # one second
PRELUDE = f"""
import itertools, os, sys
sys.path.insert(0, {str(ROOT)!r})
from tests.recording.strategies import simple_recording
from h3data.recording import DatasetWriter, RecordingWriter
out = sys.argv[1]
def report(k):  # unbuffered: what the parent reads has happened
    os.write(1, b"%07d\\n" % k)
"""

RECORDS_FOR_EVER = """
rec = simple_recording(steps=100)
with RecordingWriter(out, rec) as writer:
    for k in itertools.count():
        rows = {name: array[k % 100 : k % 100 + 1].copy() for name, array in rec.columns.items()}
        rows["time_ns"] += k // 100 * 10**10
        writer.append(rows)
        if k % 7 == 0:
            writer.event(rec.events[0])
        report(k + 1)
"""

CLOSES_FOR_EVER = """
rec = simple_recording(steps=100)
for k in itertools.count():
    with RecordingWriter(f"{out}{k}.mcap", rec) as writer:
        for row in range(0, 100, 50):
            writer.append({name: array[row : row + 50] for name, array in rec.columns.items()})
        report(2 * k + 1)
    report(2 * k + 2)
"""

ADDS_FOR_EVER = """
with DatasetWriter(out, episodes_per_file=2) as writer:
    for k in itertools.count():
        writer.add(simple_recording(steps=20, seed=k))
        report(k + 1)
"""


def killed_after(code: str, out: Path, reports: int) -> int:
    """Run ``code`` until it has reported so often, then kill -9; returns the last number that it got out."""
    process = subprocess.Popen([sys.executable, "-c", PRELUDE + code, str(out)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    for _ in range(reports):
        assert process.stdout.readline(), "it ended by itself"
    process.kill()
    whole = [line for line in process.stdout.read().split(b"\n") if len(line) == 7]
    process.stdout.close()
    assert process.wait() == -signal.SIGKILL
    return int(whole[-1]) if whole else reports


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_kill_9_at_any_moment_costs_a_log_at_most_one_second(tmp_path, seed):
    path = tmp_path / "a.mcap"
    reported = killed_after(RECORDS_FOR_EVER, path, random.Random(seed).randrange(1, 400))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap.part"], "an unfinished recording has no final name"
    if reported < FLUSH_ROWS:
        with pytest.raises(FormatError, match=r"H3-RECORDING-0(18|41|50)"):
            open_recording(path.with_name("a.mcap.part"))
        return
    saved = recover_mcap(path.with_name("a.mcap.part"), path)
    assert reported - reported % FLUSH_ROWS <= saved.steps <= reported + 1
    back, rec = read_mcap(path), simple_recording(steps=100)
    rows = np.arange(saved.steps)
    for name, array in rec.columns.items():
        assert np.array_equal(
            back.columns[name], array[rows % 100] + (rows // 100 * 10**10 if name == "time_ns" else 0)
        )
    assert abs(len(back.events) - saved.steps / 7) <= 1 + FLUSH_ROWS / 7


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_kill_9_while_logs_are_closed_costs_nothing(tmp_path, seed):
    reported = killed_after(CLOSES_FOR_EVER, tmp_path / "a", random.Random(seed).randrange(1, 30))
    named = list(tmp_path.glob("a*.mcap"))
    assert reported // 2 <= len(named) <= (reported + 1) // 2 + 1
    for path in named:
        assert len(read_mcap(path)) == 100
    for part in tmp_path.glob("a*.mcap.part"):
        assert part.with_suffix("") not in named, "a log has one name"


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_kill_9_at_any_moment_costs_a_dataset_its_unfinished_file(tmp_path, seed):
    root = tmp_path / "ds"
    reported = killed_after(ADDS_FOR_EVER, root, random.Random(seed).randrange(2, 25))
    kept = len(Dataset(root))
    assert reported - reported % 2 <= kept <= reported + 1
    with DatasetWriter(root, resume=True, episodes_per_file=2) as writer:
        assert len(writer) == kept
        writer.add(simple_recording(steps=20, seed=kept))
    dataset = Dataset(root)
    assert len(dataset) == kept + 1
    for k in range(kept + 1):
        back = dataset.recording(k)
        assert recordings_equal(simple_recording(steps=20, seed=k), back) == []
    assert pads.dataset(root / "data", format="parquet").count_rows() == 20 * (kept + 1), "others see the same episodes"
    assert not list(root.glob("**/*.part"))


# --- nowhere to write --------------------------------------------------------------------------------------------------
FILLS_UP = """
import resource, signal
from h3data.errors import InputError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
rec = simple_recording(steps=3000)
try:
    with RecordingWriter(out + "/a.mcap", rec) as writer:
        for k in range(3000):
            writer.append({name: array[k : k + 1] for name, array in rec.columns.items()})
            report(k + 1)
except InputError as error:
    assert "File too large" in str(error), error
try:
    with DatasetWriter(out + "/ds", episodes_per_file=1) as writer:
        writer.add(simple_recording(steps=20))
        writer.add(rec)
except InputError as error:
    assert "File too large" in str(error) and "resume=True" in str(error), error
"""


@pytest.mark.slow
def test_a_file_that_may_not_grow_keeps_what_was_flushed(tmp_path):
    command = [sys.executable, "-c", PRELUDE + FILLS_UP, str(tmp_path)]
    process = subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=60)
    reported = int(process.stdout.split()[-1])
    assert reported < 3000
    assert not (tmp_path / "a.mcap").exists()
    saved = recover_mcap(tmp_path / "a.mcap.part", tmp_path / "b.mcap").steps
    assert reported - FLUSH_ROWS <= saved <= reported + 1
    assert [len(r) for r in Dataset(tmp_path / "ds")] == [20]
    with DatasetWriter(tmp_path / "ds", resume=True) as writer:
        assert writer.add(simple_recording(steps=3000)) == 1
    assert len(Dataset(tmp_path / "ds")) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full on this system")
def test_a_full_device_is_reported(tmp_path):
    (tmp_path / "a.mcap.part").symlink_to("/dev/full")
    with pytest.raises(InputError, match=r"(?s)No space left on device.*H3-RECORDING-017"):
        write_mcap(simple_recording(), tmp_path / "a.mcap", overwrite=True)
    assert not (tmp_path / "a.mcap").exists()


@contextlib.contextmanager
def nobody() -> Iterator[None]:
    """Without the rights of root, which may write everywhere."""
    me = os.geteuid()
    if me:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(me)


def test_folders_without_permission_are_named():
    rec = simple_recording(steps=5)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_mcap(rec, root / "warm.mcap")
        with DatasetWriter(root / "ds") as writer:
            writer.add(rec)
        (root / "closed").mkdir()
        write_mcap(rec, root / "closed/a.mcap")
        root.chmod(0o555)
        (root / "closed").chmod(0)
        (root / "ds/data/chunk-000/file-000.parquet").chmod(0)
        try:
            with nobody():
                for attempt in (
                    lambda: RecordingWriter(root / "b.mcap", rec),
                    lambda: RecordingWriter(root / "deep/b.mcap", rec),
                    lambda: RecordingWriter(root / "closed/b.mcap", rec),
                    lambda: recover_mcap(root / "warm.mcap", root / "b.mcap"),
                    lambda: recover_mcap(root / "closed/a.mcap", root / "b.mcap"),
                    lambda: read_mcap(root / "closed/a.mcap"),
                    lambda: open_recording(root / "closed/a.mcap"),
                    lambda: open_recording(root / "closed"),
                    lambda: DatasetWriter(root / "ds2"),
                    lambda: DatasetWriter(root / "ds", overwrite=True),
                    lambda: DatasetWriter(root / "ds", resume=True).add(rec),
                    lambda: DatasetWriter(root / "closed/ds"),
                    lambda: Dataset(root / "closed/ds"),
                    lambda: Dataset(root / "ds").recording(0),
                ):
                    with pytest.raises(H3DataError, match=r"H3-RECORDING-(015|017|026|054|060|066|103)"):
                        attempt()
        finally:
            root.chmod(0o755)
            (root / "closed").chmod(0o755)
            (root / "ds/data/chunk-000/file-000.parquet").chmod(0o644)
        assert {p.name for p in root.iterdir()} == {"warm.mcap", "ds", "closed"}
        assert recordings_equal(rec, Dataset(root / "ds").recording(0)) == []


# --- files that end anywhere, and files with a flipped bit -------------------------------------------------------------
def small_recording(steps: int, seed: int = 0) -> Recording:
    return replace(simple_recording(steps=steps, bodies=1, seed=seed), attachments={})


def small_log(path: Path) -> bytes:
    """A log of 6 steps in chunks of 2."""
    rec = small_recording(6)
    with RecordingWriter(path, rec, flush_rows=2, compact=False) as writer:
        for k in range(0, 6, 2):
            writer.append({name: array[k : k + 2] for name, array in rec.columns.items()})
        writer.skill(rec.skills[0])
    return path.read_bytes()


def check_log(path: Path) -> int:
    """Steps that can be saved; every reader gives the truth or one of our errors."""
    rec = small_recording(6)
    with pytest.raises(FormatError):
        read_mcap(path)
    try:
        saved = recover_mcap(path, path.with_name("saved.mcap"), overwrite=True)
    except FormatError:
        return 0
    back = read_mcap(saved.path)
    assert all(np.array_equal(back.columns[n], a[: saved.steps]) for n, a in rec.columns.items() if n in back.columns)
    return saved.steps


@pytest.mark.parametrize("stride", [17, pytest.param(1, marks=pytest.mark.slow)])
def test_the_records_of_a_log_cut_at_every_byte(tmp_path, stride):
    data = small_log(tmp_path / "sound.mcap")
    counts = [0]
    for cut in range(0, len(data), stride):
        log = scan_records(data[:cut])
        assert log.fault is not None
        state = log.channel_of("/h3/state")
        counts.append(len(log.messages.get(state, ())) if state else 0)
    assert counts == sorted(counts)
    assert set(counts) == {0, 2, 4, 6}, "what was flushed is there as soon as its last byte is"
    for at in range(0, len(data), stride):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        assert scan_records(bytes(damaged)).fault is not None, at


@pytest.mark.parametrize("stride", [107, pytest.param(2, marks=pytest.mark.slow)])
def test_a_log_cut_at_every_byte(tmp_path, stride):
    data, path, saved = small_log(tmp_path / "sound.mcap"), tmp_path / "cut.mcap", [0]
    for cut in range(0, len(data), stride):
        path.write_bytes(data[:cut])
        saved.append(check_log(path))
    path.write_bytes(data[:-1])
    assert check_log(path) == 6
    assert saved == sorted(saved)


def closed_log(path: Path, *, loops: bool) -> tuple[Recording, bytes, int]:
    """A minute of a person behind a scene of random bytes, its file, and where the scene ends in it."""
    rng, steps, scene = np.random.default_rng(4), 1800, np.random.default_rng(5).bytes(5000)
    rec = small_recording(steps)
    joints = rng.normal(size=(60 if loops else steps, 54, 4)).astype(np.float32)
    columns = {**rec.columns, "agent_1.joint_quat": joints[np.arange(steps) % len(joints)]}
    columns["time_ns"] = np.arange(steps, dtype=np.int64) * 33_333_333
    columns.pop("state_hash", None)
    events = tuple(Event(step=k, agent=0, kind="beat") for k in range(0, steps, 100))
    skills = tuple(SkillSpan(agent=0, name="walk", start_step=k, end_step=k + 450) for k in range(0, 1300, 400))
    rec = replace(rec, columns=columns, events=events, skills=skills, inputs=(), attachments={"scene.glb": scene})
    data = write_mcap(rec, path, overwrite=True).read_bytes()
    return rec, data, data.index(scene) + len(scene)


@pytest.mark.parametrize("loops", [False, pytest.param(True, marks=pytest.mark.slow)])
@settings(
    max_examples=examples(15),
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(share=st.floats(0, 1))
def test_a_closed_log_that_is_cut_loses_only_what_was_cut_off(tmp_path, loops, share):
    """However it was cut behind the scene, all chunks before the cut are saved: 10 s of the episode at most are lost."""
    rec, data, begin = closed_log(tmp_path / "whole.mcap", loops=loops)
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    chunks = [c for c in summary.chunk_indexes if c.message_end_time > 0]
    if not loops:
        assert len(chunks) == 6
        assert max(c.message_end_time - c.message_start_time for c in chunks) <= 10_000_000_000
    cut = begin + 1200 + int(share * (len(data) - begin - 1200))  # behind the description of the columns
    (tmp_path / "cut.mcap").write_bytes(data[:cut])
    saved = recover_mcap(tmp_path / "cut.mcap", tmp_path / "saved.mcap", overwrite=True)
    back, steps = read_mcap(saved.path), saved.steps
    complete = sum(c.chunk_start_offset + c.chunk_length <= cut for c in chunks)
    assert steps >= (1800 if complete == len(chunks) else 300 * complete)
    first, last = chunks[0].chunk_start_offset, chunks[-1].chunk_start_offset + chunks[-1].chunk_length
    assert steps >= 1800 * min((cut - first) / (last - first), 1) - 300, "10 s more than what is missing"
    assert all(np.array_equal(back.columns[name], column[:steps]) for name, column in rec.columns.items())
    assert back.attachments == rec.attachments
    assert validate_skills(back) == []
    known = steps - 300
    if known > 0:
        assert {e.step for e in back.events} >= {e.step for e in rec.events if e.step < known}
        assert {s.start_step for s in back.skills} >= {s.start_step for s in rec.skills if s.start_step < known}


def validate_skills(rec: Recording) -> list[SkillSpan]:
    """Skills that are not within the steps of their recording."""
    return [span for span in rec.skills if not 0 <= span.start_step <= span.end_step < len(rec)]


@pytest.mark.parametrize("stride", [107, pytest.param(1, marks=pytest.mark.slow)])
def test_a_log_with_a_flipped_bit_in_every_byte(tmp_path, stride):
    data, path = small_log(tmp_path / "sound.mcap"), tmp_path / "flipped.mcap"
    for at in range(0, len(data), stride):
        damaged = bytearray(data)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        check_log(path)


@pytest.fixture(scope="module")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("small") / "ds"
    with DatasetWriter(root) as writer:
        for seed in range(2):
            writer.add(small_recording(5, seed))
    return root


def check_dataset(root: Path) -> bool:
    """Whether it could be read; then poses are the truth."""
    try:
        dataset = Dataset(root)
        repr(dataset)
        for seed, back in enumerate(dataset.recordings(range(len(dataset)))):
            differences = recordings_equal(small_recording(5, seed), back)
            assert [line for line in differences if "values differ" in line] == []
    except FormatError:
        return False
    return True


FILES = ["data", "meta/episodes", "h3/bodies", "h3/assets", "h3/agents", "h3/skills", "h3/events", "h3/inputs"]


@pytest.mark.parametrize("stride", [151, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", FILES)
def test_a_dataset_file_cut_at_every_byte(small_dataset, kind, stride):
    path = small_dataset / kind / "chunk-000/file-000.parquet"
    data = path.read_bytes()
    try:
        for cut in range(0, len(data), stride):
            path.write_bytes(data[:cut])
            assert not check_dataset(small_dataset), cut
    finally:
        path.write_bytes(data)
    assert check_dataset(small_dataset)


@pytest.mark.parametrize("stride", [151, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", FILES)
def test_a_dataset_file_with_a_flipped_bit_in_every_byte(small_dataset, kind, stride):
    path = small_dataset / kind / "chunk-000/file-000.parquet"
    data = path.read_bytes()
    try:
        for at in range(0, len(data), stride):
            damaged = bytearray(data)
            damaged[at] ^= 1 << at % 8
            path.write_bytes(damaged)
            check_dataset(small_dataset)
    finally:
        path.write_bytes(data)


KILLED_AT = """
if not hasattr(os, "fork"):
    sys.exit("no fork")
import signal
recordings = [simple_recording(steps=20, seed=k) for k in range(2)]
with DatasetWriter(out + "-warm", like=recordings) as writer:  # imports what is imported at first use
    writer.add(recordings[0])

def run(root, last):
    count = 0
    def hook(event, args):
        nonlocal count
        first = str(args[0]) if args else ""
        writes = event in ("os.mkdir", "os.rename", "os.remove") or (event == "open" and args[2] & (os.O_WRONLY | os.O_RDWR))
        if writes and first.startswith(root):
            count += 1
            if count == last:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    with DatasetWriter(root, like=recordings) as writer:
        for recording in recordings:
            writer.add(recording)
            writer.commit()

for k in itertools.count(1):
    root = f"{out}{k}"
    child = os.fork()
    if not child:
        run(root, k)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    report(k)
    if status == 0:
        break
"""


@pytest.mark.slow  # quick: test_a_dataset_that_was_killed_at_once_is_gone_on_with_or_replaced
def test_a_dataset_killed_at_any_write_is_gone_on_with(tmp_path: Path) -> None:
    """Kill -9 before each write of a dataset, the first ones included: the folder is never one that nobody takes."""
    code = [sys.executable, "-c", PRELUDE + KILLED_AT, str(tmp_path / "ds")]
    reported = subprocess.run(code, stdout=subprocess.PIPE, check=True).stdout.split()
    folders = [tmp_path / f"ds{int(k)}" for k in reported]
    assert len(folders) > 10
    found = []
    for root in folders:
        with DatasetWriter(root, resume=True) as writer:
            found.append(len(writer))
            for seed in range(len(writer), 2):
                writer.add(simple_recording(steps=20, seed=seed))
        dataset = Dataset(root)
        assert [dataset.recording(k).episode.episode_id for k in range(2)] == [
            simple_recording(steps=20, seed=k).episode.episode_id for k in range(2)
        ]
        assert not list(root.rglob("*.part"))
    assert found == sorted(found)
    assert {*found} == {0, 1, 2}
