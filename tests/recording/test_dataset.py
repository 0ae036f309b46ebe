"""The Parquet dataset: exact both ways, a LeRobot v3 folder for others, and no committed episode is ever lost."""

from __future__ import annotations

import copy
import errno
import io
import json
import os
import pickle
import random
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError
from h3data.recording import (
    SCHEMA_VERSION,
    Agent,
    Dataset,
    DatasetWriter,
    InputEvent,
    Recording,
    file_store,
    open_recording,
    read_mcap,
    rebuild_meta,
    recordings_equal,
    state_hash,
    write_mcap,
)
from h3data.recording.parquet import shard as dataset_shard
from h3data.recording.parquet.folder import EpisodeRows
from h3data.recording.parquet.moments import lerobot_stats, merged, moments_of, pack_moments, unpack_moments
from h3data.recording.parquet.records import _records
from h3data.recording.parquet.schema import SIDECARS, record_schema
from h3data.recording.schema import DTYPES, struct_from_dict
from tests.paths import REAL, ROOT
from tests.random_cases import examples
from tests.recording.strategies import recordings, simple_recording

SOME = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def written(root: Path, *episodes: Recording, **options) -> Dataset:
    with DatasetWriter(root, overwrite=root.exists() and any(root.iterdir()), **options) as writer:
        for k, episode in enumerate(episodes):
            assert writer.add(episode) == k
    return Dataset(root)


@SOME
@given(rec=recordings())
@example(rec=simple_recording(steps=0))
@example(rec=simple_recording(steps=1, bodies=0))
def test_what_is_added_is_read(tmp_path, rec):
    ds = written(tmp_path / "ds", rec)
    assert len(ds) == 1
    back = ds.recording(0)
    assert recordings_equal(rec, back) == []
    assert list(back.columns) == list(rec.columns)
    assert all(a.flags.writeable and a.flags.c_contiguous for a in back.columns.values())


@SOME
@given(recs=st.lists(recordings(max_steps=12), min_size=2, max_size=4), per_file=st.integers(1, 3))
@pytest.mark.slow
def test_episodes_of_different_shapes_share_a_dataset(tmp_path, recs, per_file):
    kinds: dict[str, tuple] = {}
    for k, rec in enumerate(recs):  # a column has one dtype in a dataset
        kept = {n: a for n, a in rec.columns.items() if kinds.setdefault(n, (a.dtype, a.ndim)) == (a.dtype, a.ndim)}
        recs[k] = replace(rec, columns=kept)
    ds = written(tmp_path / "ds", *recs, like=recs, episodes_per_file=per_file)
    assert len(ds) == len(recs)
    for k, rec in enumerate(recs):
        assert recordings_equal(rec, ds.recording(k)) == []
        assert list(ds.recording(k).columns) == list(rec.columns)


@settings(max_examples=examples(12), deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(rec=recordings())
def test_log_to_dataset_to_log(tmp_path, rec):
    first = read_mcap(write_mcap(rec, tmp_path / "a.mcap", overwrite=True))
    second = read_mcap(write_mcap(written(tmp_path / "ds", first).recording(0), tmp_path / "b.mcap", overwrite=True))
    assert recordings_equal(rec, second) == []
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_columns_are_streamed(tmp_path):
    recs = [simple_recording(steps=n, seed=n, bodies=n % 3) for n in (10, 0, 7)]
    ds = written(tmp_path / "ds", *recs, max_bodies=2)
    seen = dict(ds.iter_columns(["metrics.dist_agents", "object_pose"]))
    assert list(seen) == [0, 1, 2]
    for k, rec in enumerate(recs):
        assert set(seen[k]) == {"metrics.dist_agents", "object_pose"}
        assert all(np.array_equal(seen[k][n], rec.columns[n]) for n in seen[k])
    assert [k for k, _ in ds.iter_columns(["time_ns"], episodes=[2, 0])] == [2, 0]
    assert set(ds.recording(0, columns=[]).columns) == {
        "time_ns",
        "object_pose",
        "agent_0.base_pose",
        "agent_1.base_pose",
    }
    with pytest.raises(InputError, match=r"(?s)metrics\.nope.*H3-RECORDING-059"):
        next(ds.iter_columns(["metrics.nope"]))
    for index in (3, -1):
        with pytest.raises(InputError, match=r"(?s)0\.\.2.*H3-RECORDING-065"):
            ds.recording(index)
    assert "3 episodes, 17 steps" in repr(ds)
    assert "object_pose              float32  [T, 2, 7]" in repr(ds)


def test_wider_episodes_are_refused_with_advice(tmp_path):
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(simple_recording(bodies=2))
        with pytest.raises(
            InputError, match=r"(?s)\[T, 3, 7\] is wider than object_pose float32 \[T, 2, 7\].*H3-RECORDING-090"
        ):
            writer.add(simple_recording(bodies=3))
        extra = simple_recording()
        columns = {**extra.columns, "metrics.new": np.zeros(60), "metrics.collision": np.zeros(60, np.int8)}
        with pytest.raises(InputError, match=r"(?s)metrics\.collision int8.*metrics\.new.*a column.*H3-RECORDING-090"):
            writer.add(replace(extra, columns=columns))
        with pytest.raises(InputError, match="H3-RECORDING-091"):
            writer.add(replace(extra, episode=replace(extra.episode, dt_ns=10**8)))
        with pytest.raises(InputError, match="H3-RECORDING-101"):
            writer.add(replace(extra, episode=replace(extra.episode, seed=2**70)))
        writer.add(simple_recording(bodies=1))
    assert len(Dataset(tmp_path / "ds")) == 2
    for name in ("index", "metrics.a/b"):
        with pytest.raises(InputError, match="H3-RECORDING-100"):
            written(tmp_path / name.replace("/", ""), replace(extra, columns={**extra.columns, name: np.zeros(60)}))


# --- what others see ---------------------------------------------------------------------------------------------------
def test_it_is_a_lerobot_v3_dataset(tmp_path):
    root = tmp_path / "ds"
    recs = [simple_recording(steps=n, seed=n) for n in (10, 20, 5)]
    recs[2] = replace(recs[2], episode=replace(recs[2].episode, task="tidy"))
    written(root, *recs, episodes_per_file=2)
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 30, "robot/quad_arm")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 35, 2)
    assert info["splits"] == {"train": "0:3"}
    table = pads.dataset(root / "data", format="parquet").to_table()
    assert set(table.column_names) == set(info["features"]), "undeclared columns break lerobot"
    for name, feature in info["features"].items():
        kind = table.schema.field(name).type
        if pa.types.is_fixed_size_list(kind):
            assert [kind.list_size] == feature["shape"]
            kind = kind.value_type
        else:
            assert feature["shape"] == [1]
        assert str(kind) == {"float32": "float"}.get(feature["dtype"], feature["dtype"])
        assert "/" not in name
    assert table["index"].to_pylist() == list(range(35))
    assert table["episode_index"].to_pylist() == [0] * 10 + [1] * 20 + [2] * 5
    assert table["task_index"].to_pylist() == [0] * 30 + [1] * 5
    assert np.allclose(table["timestamp"].to_numpy()[:10], np.arange(10) / 30)
    assert sum(table[c].null_count for c in table.column_names) == 0
    tasks = pq.read_table(root / "meta/tasks.parquet")
    pandas = json.loads(tasks.schema.metadata[b"pandas"])
    assert pandas["index_columns"] == ["__index_level_0__"]
    assert tasks.to_pydict() == {"task_index": [0, 1], "__index_level_0__": ["social_nav", "tidy"]}
    for k, (rec, place) in enumerate(
        zip(recs, pads.dataset(root / "meta/episodes").to_table().to_pylist(), strict=True)
    ):
        assert (place["episode_index"], place["length"], place["tasks"]) == (k, len(rec), [rec.episode.task])
        path = info["data_path"].format(chunk_index=place["data/chunk_index"], file_index=place["data/file_index"])
        file = pq.ParquetFile(root / path)
        group = file.read_row_group(place["row_group"])
        assert group["index"].to_pylist() == list(range(place["dataset_from_index"], place["dataset_to_index"]))
        column = file.metadata.row_group(0).column(file.schema_arrow.names.index("timestamp"))
        assert column.compression == "ZSTD"
        assert "BYTE_STREAM_SPLIT" in column.encodings


def test_rerun_reads_it_as_lerobot(tmp_path):
    rerun = pytest.importorskip("rerun.experimental")
    recs = [simple_recording(steps=20 + k, seed=k) for k in range(4)]
    written(tmp_path / "ds", *recs, episodes_per_file=2)
    reader = rerun.LeRobotReader(str(tmp_path / "ds"))
    for k in (0, 3):
        rows = {chunk.entity_path: chunk.num_rows for chunk in reader.stream(k)}
        assert rows["/object_pose"] == rows["/metrics.dist_agents"] == rows["/task"] == 20 + k


def test_stats_are_right(tmp_path):
    recs = [simple_recording(steps=n, seed=n, bodies=b) for n, b in ((10, 2), (20, 1), (5, 2))]
    written(tmp_path / "ds", *recs, episodes_per_file=2)
    stats = json.loads((tmp_path / "ds/meta/stats.json").read_text())
    whole = np.concatenate([r.columns["agent_0.base_pose"] for r in recs]).astype(float)
    mine = stats["agent_0.base_pose"]
    for name, expected in (
        ("min", whole.min(0)),
        ("max", whole.max(0)),
        ("mean", whole.mean(0)),
        ("std", whole.std(0)),
    ):
        assert np.allclose(mine[name], expected), name
    assert mine["count"] == [35]
    second_body = np.concatenate([r.columns["object_pose"][:, 1] for r in recs if len(r.bodies) > 1])
    assert np.allclose(stats["object_pose"]["mean"][7:], second_body.mean(0), atol=1e-6), "padding must not count"
    assert set(stats) == set(json.loads((tmp_path / "ds/meta/info.json").read_text())["features"])


QUANTILE_SHARES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def test_every_episode_has_lerobots_statistics_of_every_feature_with_quantiles(tmp_path):
    recs = [simple_recording(steps=steps, seed=steps) for steps in (40, 200)]
    ds = written(tmp_path / "ds", *recs)
    table = pads.dataset(tmp_path / "ds/meta/episodes", format="parquet").to_table()
    rows, features = table.to_pylist(), json.loads((tmp_path / "ds/meta/info.json").read_text())["features"]
    stats = json.loads((tmp_path / "ds/meta/stats.json").read_text())
    pose = "agent_0.base_pose"
    for rec, row in zip(recs, rows, strict=True):
        ordered = np.sort(rec.columns[pose], axis=0)
        for name, share in QUANTILE_SHARES.items():  # those of LeRobot's histograms, but for the width of a bin
            expected = ordered[int(np.ceil(share * len(rec))) - 1]
            np.testing.assert_array_equal(np.float32(row[f"stats/{pose}/{name}"]), expected, err_msg=name)
        for name, summary in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
            np.testing.assert_allclose(row[f"stats/{pose}/{name}"], summary(rec.columns[pose], 0), atol=1e-5)
        assert row[f"stats/{pose}/count"] == [len(rec)]
        for feature, about in features.items():
            for name in ("min", "max", "mean", "std", *QUANTILE_SHARES):
                assert len(row[f"stats/{feature}/{name}"]) == about["shape"][0], (feature, name)
    for name in QUANTILE_SHARES:  # of the dataset the means weighted by counts, as LeRobot aggregates them
        mean = np.average([row[f"stats/{pose}/{name}"] for row in rows], axis=0, weights=[40, 200])
        np.testing.assert_allclose(stats[pose][name], mean, atol=1e-6)
    assert not [name for name in ds.episodes.column_names if name.startswith("stats/")], (
        "they are not read with episodes"
    )


def test_a_dataset_of_before_goes_on_without_statistics_of_episodes(tmp_path):
    """lerobot opens episode tables as one, which need the same columns."""
    rec = simple_recording(steps=8)
    schema = replace(written(tmp_path / "new", rec).schema, episode_stats=False)
    (tmp_path / "old/h3").mkdir(parents=True)
    (tmp_path / "old/h3/schema.json").write_bytes(schema.to_json())
    for _ in range(2):
        with DatasetWriter(tmp_path / "old", resume=True) as writer:
            writer.add(rec)
    ds = Dataset(tmp_path / "old")
    assert not ds.schema.episode_stats
    tables = [pq.read_schema(path) for path in sorted((tmp_path / "old/meta/episodes").rglob("*.parquet"))]
    assert len(tables) == 2
    assert not [name for table in tables for name in table.names if name.startswith("stats/")]


def test_moments_that_were_stored_without_quantiles_are_read():
    full = moments_of(np.arange(12.0).reshape(6, 2))
    old = replace(full, quantiles=None)
    assert unpack_moments(pack_moments({"x": old}).encode())["x"].quantiles is None
    assert merged(full, unpack_moments(pack_moments({"x": old}).encode())["x"]).quantiles is None
    again = unpack_moments(pack_moments({"x": full}).encode())["x"]
    np.testing.assert_array_equal(again.quantiles, full.quantiles)
    assert "q50" not in lerobot_stats(old, 6, (-1,))
    assert lerobot_stats(again, 6, (-1,))["q50"] == [4.0, 5.0]


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(values=st.lists(st.floats(width=32), min_size=1, max_size=20), cut=st.integers(0, 20))
def test_moments_merge(values, cut):
    x = np.array(values, np.float32)[:, None]
    a, b = moments_of(x), merged(moments_of(x[:cut]), moments_of(x[cut:]))
    finite = x[np.isfinite(x)].astype(float)
    assert a.count[0] == b.count[0] == len(finite)
    if len(finite):
        assert (a.low[0], a.high[0]) == (b.low[0], b.high[0]) == (finite.min(), finite.max())
        scale = np.abs(finite).max() + 1e-30
        assert abs(a.mean[0] - finite.mean()) <= 1e-6 * scale
        assert abs(b.mean[0] - finite.mean()) <= 1e-6 * scale


def test_every_dtype_in_parquet(tmp_path):
    rec = simple_recording(steps=8)
    rng = np.random.default_rng(0)
    more = {f"sim.{d}": rng.integers(0, 2, (8, 3)).astype(d) for d in DTYPES}
    rec = replace(rec, columns={**rec.columns, **more})
    assert recordings_equal(rec, written(tmp_path / "ds", rec).recording(0)) == []


def test_uint64_is_stored_as_int64(tmp_path):
    rec = simple_recording(steps=8)
    rng = np.random.default_rng(0)
    more = {n: rng.integers(0, 2**64, (8, *s), np.uint64) for n, s in (("state_hash", ()), ("sim.rng", (3,)))}
    rec = replace(rec, columns={**rec.columns, **more})
    ds = written(tmp_path / "new", rec)
    table = pads.dataset(ds.root / "data", format="parquet").to_table()
    info = json.loads((ds.root / "meta/info.json").read_text())
    assert table.schema.field("state_hash").type == table.schema.field("sim.rng").type.value_type == pa.int64()
    assert info["features"]["state_hash"]["dtype"] == info["features"]["sim.rng"]["dtype"] == "int64"
    assert (
        info["h3data"]["schema_version"] == table.schema.metadata[b"h3data.schema_version"].decode() == SCHEMA_VERSION
    )
    assert np.array_equal(table["state_hash"].to_numpy().view(np.uint64), more["state_hash"])
    assert recordings_equal(rec, ds.recording(0)) == []
    assert rebuild_meta(ds.root) == 1
    assert json.loads((ds.root / "meta/info.json").read_text()) == info


def test_attachments_are_stored_once(tmp_path):
    root = tmp_path / "ds"
    recs = [simple_recording(seed=k) for k in range(5)]
    recs[4] = replace(recs[4], attachments={"scene.glb": b"other", "übung": b"", "../evil.sh": b"#!"})
    ds = written(root, *recs)
    assert len(list((root / "h3/files").iterdir())) == 4
    assert ds.recording(4).attachments == recs[4].attachments
    assert not list(tmp_path.glob("**/evil*"))


def test_an_attachment_that_episodes_share_is_read_once(tmp_path, monkeypatch):
    shared, other = simple_recording(seed=0), replace(simple_recording(seed=1), attachments={"scene.glb": b"other"})
    ds = written(tmp_path / "ds", shared, other, replace(simple_recording(seed=2), attachments=shared.attachments))
    first = ds.recording(0).attachments["scene.glb"]
    assert ds.recording(2).attachments["scene.glb"] is first
    monkeypatch.setattr(file_store, "_KEPT_BYTES", 5)  # no more than the other one
    assert ds.recording(1).attachments["scene.glb"] == b"other"
    assert ds.recording(0).attachments["scene.glb"] is not first
    assert ds.recording(0).attachments["scene.glb"] == first


@SOME
@given(rec=recordings(max_steps=3))
def test_records_are_read_by_columns_as_they_are_row_by_row(tmp_path, rec):
    ds = written(tmp_path / "ds", rec)
    for kind, struct in SIDECARS.items():
        table = ds._records.table(kind, 0)
        found, expected = _records(struct, table), [struct_from_dict(struct, row) for row in table.to_pylist()]
        assert list(map(repr, found)) == list(map(repr, expected))
        assert all(a.flags.writeable for each in found for a in vars(each).values() if isinstance(a, np.ndarray))


def test_lists_with_nulls_are_refused_and_lost_fields_keep_their_defaults():
    rows = {"name": ["spot"], "kind": ["robot"], "joint_names": [["a", None]]}
    schema = pa.schema([(name, record_schema("Agent").field(name).type) for name in rows])
    with pytest.raises(ValueError, match="a list of string values has nulls"):
        _records("Agent", pa.table(rows, schema=schema))
    (agent,) = _records("Agent", pa.table({**rows, "joint_names": [["a", "b"]]}, schema=schema))
    assert agent == Agent(name="spot", kind="robot", joint_names=("a", "b"))
    with pytest.raises(TypeError):  # `of_episodes` says which file it is
        _records("Agent", pa.table({"episode_index": [0]}))


def test_an_attachment_that_is_not_what_its_name_says_is_refused(tmp_path):
    root, rec = tmp_path / "ds", simple_recording()
    written(root, rec)
    (file,) = (root / "h3/files").glob("*.glb")
    damaged = bytearray(file.read_bytes())
    damaged[-1] ^= 1
    file.write_bytes(damaged)
    with pytest.raises(FormatError, match="H3-RECORDING-005"):
        Dataset(root).recording(0)
    assert len(Dataset(root).recording(0, records=["agents"])) == len(rec), "metrics do not need it"
    file.unlink()
    with pytest.raises(FormatError, match=r"(?s)scene\.glb of episode 0.*Hint.*glb.*H3-RECORDING-004"):
        Dataset(root).recording(0)


def test_a_damaged_attachment_is_replaced_when_the_same_one_is_added(tmp_path):
    root, rec = tmp_path / "ds", simple_recording()
    written(root, rec)
    (file,) = (root / "h3/files").glob("*.glb")
    file.write_bytes(b"damaged")
    with DatasetWriter(root, resume=True) as writer:
        writer.add(rec)
    assert Dataset(root).recording(0).attachments == Dataset(root).recording(1).attachments == rec.attachments


# --- crashes, resuming, overwriting ------------------------------------------------------------------------------------
KILLED = """
import os, signal, sys
sys.path.insert(0, {repo!r})
from tests.recording.strategies import simple_recording
from h3data.recording import DatasetWriter
writer = DatasetWriter({root!r}, episodes_per_file=3)
for k in range(8):
    writer.add(simple_recording(seed=k))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow  # quick: test_crashes.py
def test_kill_9_loses_only_the_unfinished_file(tmp_path):
    root = tmp_path / "ds"
    code = KILLED.format(repo=str(ROOT), root=str(root))
    process = subprocess.run([sys.executable, "-c", code], check=False, timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert len(Dataset(root)) == 6
    assert pads.dataset(root / "data", format="parquet").count_rows() == 6 * 60
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == 6
    with pytest.raises(InputError, match="H3-RECORDING-096"):
        DatasetWriter(root)
    with DatasetWriter(root, resume=True, episodes_per_file=3) as writer:
        assert len(writer) == 6
        for k in range(6, 8):
            assert writer.add(simple_recording(seed=k)) == k
    straight = written(tmp_path / "straight", *(simple_recording(seed=k) for k in range(8)), episodes_per_file=3)
    resumed = Dataset(root)
    assert len(resumed) == 8
    for k in range(8):
        assert recordings_equal(straight.recording(k), resumed.recording(k)) == []
    for name in ("info.json", "stats.json", "tasks.parquet"):
        assert (root / "meta" / name).read_bytes() == (tmp_path / "straight/meta" / name).read_bytes()
    assert not list(root.glob("**/*.part"))


def test_a_crash_between_two_renames(tmp_path, monkeypatch):
    root = tmp_path / "ds"
    written(root, *(simple_recording(seed=k) for k in range(2)))
    real, calls = os.replace, []

    def replace_twice(a, b):
        calls.append(b)
        if len(calls) > 2:
            raise OSError(errno.EIO, "gone")
        real(a, b)

    writer = DatasetWriter(root, resume=True)
    writer.add(replace(simple_recording(seed=2), attachments={}))
    monkeypatch.setattr(os, "replace", replace_twice)
    with pytest.raises(InputError, match=r"(?s)gone.*H3-RECORDING-103"):
        writer.commit()
    monkeypatch.undo()
    assert len(Dataset(root)) == 2
    with DatasetWriter(root, resume=True) as writer:
        assert pads.dataset(root / "data", format="parquet").count_rows() == 2 * 60, "the orphan is gone"
        assert writer.add(simple_recording(seed=5)) == 2
    assert Dataset(root).recording(2).episode.seed == 5


def test_meta_can_be_rebuilt(tmp_path):
    root = tmp_path / "ds"
    written(root, *(simple_recording(seed=k) for k in range(3)), episodes_per_file=2)
    before = {p.name: p.read_bytes() for p in (root / "meta").iterdir() if p.is_file()}
    for name in before:
        (root / "meta" / name).unlink()
    assert rebuild_meta(root) == 3
    assert {p.name: p.read_bytes() for p in (root / "meta").iterdir() if p.is_file()} == before


class FullDisk(io.FileIO):
    def write(self, data) -> int:  # type: ignore[override]
        if self.tell() + len(data) > 30_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def test_a_full_disk_keeps_what_was_committed(tmp_path, monkeypatch):
    root = tmp_path / "ds"
    written(root, simple_recording(seed=0))
    monkeypatch.setattr(dataset_shard, "open_shard_file", lambda part: FullDisk(part, "xb"))

    def fill() -> None:
        with DatasetWriter(root, resume=True) as writer:
            for k in range(1, 40):
                writer.add(simple_recording(seed=k, steps=300))

    with pytest.raises(InputError, match=r"(?s)No space left.*H3-RECORDING-103"):
        fill()
    assert len(Dataset(root)) == 1
    assert not list(root.glob("**/*.part"))
    assert [p.name for p in (root / "data").glob("*/*")] == ["file-000.parquet"]


def test_an_exception_keeps_complete_episodes(tmp_path):
    def interrupted() -> None:
        with DatasetWriter(tmp_path / "ds") as writer:
            writer.add(simple_recording(seed=0))
            writer.add(simple_recording(seed=1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(Dataset(tmp_path / "ds")) == 2


def test_folders_that_exist_are_kept(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    for options in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(InputError, match="H3-RECORDING-095"):
            DatasetWriter(tmp_path / "mine", **options)
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "years of work"
    with pytest.raises(InputError, match="H3-RECORDING-094"):
        DatasetWriter(tmp_path / "mine" / "thesis.tex")
    with pytest.raises(InputError, match="H3-RECORDING-092"):
        DatasetWriter(tmp_path / "new", overwrite=True, resume=True)
    written(tmp_path / "ds", simple_recording(seed=0), simple_recording(seed=1))
    (tmp_path / "ds" / "notes.txt").write_text("keep")
    with DatasetWriter(tmp_path / "ds", overwrite=True) as writer:
        writer.add(simple_recording(seed=9))
    assert [r["seed"] for r in Dataset(tmp_path / "ds").episodes.to_pylist()] == [9]
    assert (tmp_path / "ds" / "notes.txt").read_text() == "keep"


# --- hostile folders ---------------------------------------------------------------------------------------------------
def test_damaged_files_are_named(tmp_path):
    """Bit flips and truncation in any file: the truth or a FormatError, never another exception, never other numbers."""
    root = tmp_path / "ds"
    recs = [simple_recording(seed=k, steps=40) for k in range(3)]
    written(root, *recs)
    rng, refused = random.Random(3), 0
    files = sorted(p for p in root.glob("**/*.*") if p.is_file() and p.name not in ("stats.json", "tasks.parquet"))
    for path in files:
        data = path.read_bytes()
        for trial in range(12):
            damaged = bytearray(data)
            if trial % 3 == 0:
                damaged = damaged[: rng.randrange(len(data))]
            else:
                damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            path.write_bytes(damaged)
            try:
                ds = Dataset(root)
                for k, rec in enumerate(recs):
                    back = ds.recording(k)
                    if path.parts[-3] == "data":
                        assert [d for d in recordings_equal(rec, back) if "values differ" in d] == []
            except FormatError:
                refused += 1
        path.unlink()
        if path.name != "info.json":
            with pytest.raises(FormatError):
                [Dataset(root).recording(k) for k in range(3) if len(Dataset(root)) == 3 or pytest.fail("lost")]
        path.write_bytes(data)
    assert refused > 30


def test_kinds_of_files_are_told_apart(tmp_path):
    root = tmp_path / "ds"
    written(root, simple_recording())
    assert isinstance(open_recording(root), Dataset)
    assert isinstance(open_recording(write_mcap(simple_recording(), tmp_path / "a.mcap")), Recording)
    info = json.loads((root / "meta/info.json").read_text())
    info["h3data"]["schema_version"] = "3.1"
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(FormatError, match=r"(?s)3\.1.*H3-RECORDING-110"):
        open_recording(root)
    (root / "h3/schema.json").unlink()
    with pytest.raises(FormatError, match="H3-RECORDING-063"):
        open_recording(root)
    cases = {
        "replay.json": (b'{"keyframes": []}', r"(?s)gfx-replay.*h3data import.*H3-RECORDING-048"),
        "any.json": (b'{"a": 1}', r"(?s)JSON of.*unknown kind.*H3-RECORDING-048"),
        "model.glb": (b"glTF\2\0\0\0", r"(?s)glTF model.*H3-RECORDING-048"),
        "empty.mcap": (b"", r"(?s)empty.*H3-RECORDING-048"),
        "text.mcap": (b"hello", r"(?s)text.*H3-RECORDING-048"),
        "bytes.mcap": (b"\0\1\2", r"(?s)binary data.*H3-RECORDING-048"),
        "x.mcap.part": (b"", "H3-RECORDING-050"),
        "x.rrd": (b"RRF2....", r"(?s)Rerun.*H3-RECORDING-048"),
        "x.parquet": (b"PAR1....", r"(?s)that it belongs to.*H3-RECORDING-048"),
        "bad.gz": (b"\x1f\x8b\x08\0", r"(?s)gzip.*H3-RECORDING-048"),
    }
    for name, (data, message) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FormatError, match=message):
            open_recording(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(FormatError, match="H3-RECORDING-062"):
        open_recording(tmp_path / "folder")
    with pytest.raises(InputError, match="H3-RECORDING-049"):
        open_recording(tmp_path / "nothing")


def test_a_real_gfx_replay_is_recognised():
    path = REAL / "hitl" / "my_session.gfx_replay.json"
    if not path.exists():
        pytest.skip(f"the real Habitat session is not on this machine: {path}")
    with pytest.raises(FormatError, match="H3-RECORDING-048"):
        open_recording(path)


# --- hashes and comparison ---------------------------------------------------------------------------------------------
def test_state_hash_runs_on():
    rec = simple_recording(steps=50)
    columns = dict(rec.columns)
    whole = state_hash(columns)
    assert whole.dtype == np.uint64
    assert len(set(whole.tolist())) == 50
    head = state_hash({n: a[:20] for n, a in columns.items()})
    tail = state_hash({n: a[20:] for n, a in columns.items()}, previous=int(head[-1]))
    assert np.array_equal(whole, np.concatenate([head, tail]))
    same = {**columns, "metrics.dist_agents": np.zeros(50), "state_hash": whole, "agent_0.action": np.ones((50, 1))}
    assert np.array_equal(state_hash({**same, "time_ns": columns["time_ns"] + 5}), whole)
    assert np.array_equal(state_hash(dict(reversed(columns.items()))), whole)
    moved = {**columns, "agent_1.base_pose": columns["agent_1.base_pose"].copy()}
    moved["agent_1.base_pose"][30, 0] = np.nextafter(moved["agent_1.base_pose"][30, 0], np.float32(9))
    differ = state_hash(moved) != whole
    assert not differ[:30].any()
    assert differ[30:].all()


def test_state_hash_is_what_the_format_says():
    """Written out by hand: BLAKE2b-8 of the last digest and the row's bytes, columns by name."""
    import hashlib

    columns = {
        "time_ns": np.arange(3),
        "b": np.array([1.5, -0.0, np.inf], "<f4"),
        "a": np.array([[1, 2], [3, 4], [5, 6]], "<i2"),
    }
    digest = bytes(8)
    for k, value in enumerate(state_hash(columns).tolist()):
        digest = hashlib.blake2b(digest + columns["a"][k].tobytes() + columns["b"][k].tobytes(), digest_size=8).digest()
        assert value == int.from_bytes(digest, "little")


def test_differences_are_found():
    rec = simple_recording()
    columns = {n: a.copy() for n, a in rec.columns.items()}
    columns["object_pose"][7, 1, 2] = -0.0
    rec = replace(rec, columns={**rec.columns, "object_pose": columns["object_pose"].copy()})
    columns["object_pose"][7, 1, 2] = 0.0
    others = {
        "object_pose: 1 of 840 values differ, first at (7, 1, 2)": replace(rec, columns=columns),
        "columns: metrics.collision only in the first": replace(
            rec, columns={n: a for n, a in rec.columns.items() if n != "metrics.collision"}
        ),
        "episode.seed": replace(rec, episode=replace(rec.episode, seed=4)),
        "events: 1 and 0": replace(rec, events=()),
        "inputs: 0 and 1": replace(rec, inputs=(InputEvent(time_ns=0, kind="text"),)),
        "agents[0].model": replace(rec, agents=(replace(rec.agents[0], model="x"), rec.agents[1])),
        "attachment scene.glb": replace(rec, attachments={"scene.glb": b""}),
        "metrics.dist_agents: float32 [60] and float64 [60]": replace(
            rec, columns={**rec.columns, "metrics.dist_agents": rec.columns["metrics.dist_agents"].astype(float)}
        ),
    }
    for start, other in others.items():
        (line,) = recordings_equal(rec, other)
        assert line.startswith(start)
    assert recordings_equal(rec, replace(rec, columns=dict(reversed(rec.columns.items())))) == []


def test_rows_of_the_episode_table_are_a_sequence():
    table = pa.table({"task": ["wander"] * 200, "schema_version": ["1.6"] * 200, "info": [str(k) for k in range(200)]})
    rows = EpisodeRows(table)
    expected = table.to_pylist()
    for some in (rows, pickle.loads(pickle.dumps(rows)), copy.copy(rows)):
        assert list(some) == expected
        assert len(some) == 200
        assert [some[k] for k in (0, 63, 64, 199, -1, -200)] == [expected[k] for k in (0, 63, 64, 199, -1, -200)]
        assert some[60:70] == expected[60:70]
        assert some[::-50] == expected[::-50]
    for index in (200, -201):
        with pytest.raises(IndexError, match="200 episodes"):
            rows[index]
    assert list(EpisodeRows(table.slice(0, 0))) == []


@pytest.mark.parametrize("reordered", [False, True], ids=["same order", "another order"])
def test_an_episode_table_that_another_program_wrote_again_is_read(tmp_path: Path, reordered: bool) -> None:
    recs = [simple_recording(steps=10 + k, seed=k) for k in range(3)]
    written(tmp_path / "ds", *recs)
    path = tmp_path / "ds/meta/episodes/chunk-000/file-000.parquet"
    before, table = Dataset(tmp_path / "ds").episodes, pq.read_table(path)
    assert not [name for name in before.column_names if name.startswith("stats/")]
    names = table.column_names[::-1] if reordered else table.column_names
    pq.write_table(table.select(names), path)
    assert Dataset(tmp_path / "ds").episodes.equals(before)
    pq.write_table(table.drop_columns(["scene"]), path)
    with pytest.raises(FormatError, match="H3-RECORDING-067"):
        len(Dataset(tmp_path / "ds"))


def test_pyarrow_makes_the_paths_of_columns_where_we_leave_them_out() -> None:
    """Where this fails, opening takes longer and reads the same: find what the method is called now."""
    assert "_build_nested_paths" in vars(pq.ParquetFile)
