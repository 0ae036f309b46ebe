"""``h3data sql``: the views say what the recordings say, over several datasets; nothing but reading; errors that help."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from h3data.geometry import ground_pose
from h3data.recording import Dataset, DatasetWriter, Recording
from h3data_pipelines.cli import main
from tests.recording.strategies import simple_recording

pytest.importorskip("duckdb")


def episode(seed: int, *, steps: int, policy: str, bodies: int = 2) -> Recording:
    """A robot and a person who walk at random and touch in some steps."""
    rng = np.random.default_rng(seed)
    plain = simple_recording(steps=steps, bodies=bodies, seed=seed)
    poses = {
        f"agent_{i}.base_pose": ground_pose(rng.normal(0, 2, (steps, 2)), rng.uniform(-3, 3, steps)).astype(np.float32)
        for i in range(2)
    }
    distance = np.linalg.norm(poses["agent_0.base_pose"][:, :3] - poses["agent_1.base_pose"][:, :3], axis=1)
    poses |= {"metrics.collision": rng.random(steps) < 0.2, "metrics.dist_agents": distance.astype(np.float32)}
    info = {"policy": policy, "max_steps": steps}
    return replace(plain, columns={**plain.columns, **poses}, episode=replace(plain.episode, info=info))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two datasets of different width: policies a and b in the first, a in the second, which has an empty episode."""
    first, second = (tmp_path_factory.mktemp("sql") / name for name in "xy")
    with DatasetWriter(first, episodes_per_file=2) as writer:
        for seed, (steps, policy) in enumerate([(9, "a"), (5, "b"), (12, "b")]):
            writer.add(episode(seed, steps=steps, policy=policy))
    with DatasetWriter(second) as writer:
        for seed, steps in enumerate([4, 0]):
            writer.add(episode(10 + seed, steps=steps, policy="a", bodies=3))
    return first, second


def ask(capsys: pytest.CaptureFixture[str], query: str, *arguments: object) -> list[list[Any]]:
    """Rows of a query."""
    assert main(["sql", query, *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["rows"]


def test_steps_and_episodes_agree_with_the_recordings(folders, capsys) -> None:
    first, second = folders
    expected: dict[str, list[float]] = {}
    for root in folders:
        for recording in map(Dataset(root).recording, range(len(Dataset(root)))):
            expected.setdefault(recording.episode.info["policy"], []).extend(recording.columns["metrics.dist_agents"])
    rows = ask(
        capsys,
        "select policy, count(*), avg(dist_agents) from steps join episodes using (dataset, episode_index) "
        "group by policy order by policy",
        first,
        second,
    )
    assert [row[:2] for row in rows] == [[policy, len(values)] for policy, values in sorted(expected.items())]
    np.testing.assert_allclose([row[2] for row in rows], [np.mean(v) for _, v in sorted(expected.items())], rtol=1e-6)


def test_episodes_with_collision_and_the_longest(folders, capsys) -> None:
    first, _ = folders
    collided = [k for k in range(3) if Dataset(first).recording(k).columns["metrics.collision"].any()]
    query = "select distinct episode_index from steps where collision order by 1"
    assert ask(capsys, query, first) == [[k] for k in collided]
    assert ask(capsys, "select episode_index, length, seed from episodes order by length desc limit 1", first) == [
        [2, 12, 2]
    ]


def test_short_names_of_a_pose(folders, capsys) -> None:
    first, _ = folders
    poses = Dataset(first).recording(1).columns["agent_1.base_pose"].astype(float)
    query = (
        'select agent_1_x, agent_1_y, agent_1_z, agent_1_heading, "agent_1.base_pose" from steps '
        "where episode_index = 1 order by frame_index"
    )
    rows = ask(capsys, query, first)
    np.testing.assert_array_equal([row[:3] for row in rows], poses[:, :3])
    np.testing.assert_array_equal([row[4] for row in rows], poses)
    made = ground_pose(np.array([row[0:3:2] for row in rows]), np.array([row[3] for row in rows]))
    np.testing.assert_allclose(made, poses, atol=1e-6)


def test_whole_numbers_without_sign_are_what_the_recordings_say(tmp_path: Path, capsys) -> None:
    largest = np.array([0, 1, 2**63 - 1, 2**63, 2**64 - 1], np.uint64)
    plain = simple_recording(steps=5, bodies=1, seed=0)
    pairs = np.stack([largest, largest[::-1]], 1)
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(replace(plain, columns={**plain.columns, "state_hash": largest, "sim.pair": pairs}))
    rows = ask(capsys, 'select state_hash, "sim.pair", typeof(state_hash) from steps order by index', tmp_path / "ds")
    assert [row[0] for row in rows] == largest.tolist()
    assert [row[1] for row in rows] == pairs.tolist()
    assert {row[2] for row in rows} == {"UBIGINT"}


def test_episodes_hold_the_metrics(folders, capsys) -> None:
    from h3data.metrics import measure

    first, second = folders
    rows = ask(capsys, "select dataset, episode_index, S, CR from episodes", first, second)
    assert len(rows) == 5
    for name, index, *values in rows:
        measured = measure(Dataset(name).recording(index)).to_dict()["values"]
        assert values == [measured["S"], measured["CR"]]


def test_records_and_sums(folders, capsys) -> None:
    first, second = folders
    query = "select dataset, kind, agent, sum(step) from events group by all order by 1"
    assert ask(capsys, query, first, second) == [[str(first), "collision", 0, 9], [str(second), "collision", 0, 6]]
    assert ask(capsys, "select count(*) from bodies", first, second) == [[12]]
    assert ask(capsys, "select list(distinct name) from skills", first) == [[["follow"]]]


def test_files_and_text(folders, tmp_path: Path, capsys) -> None:
    first, _ = folders
    query = 'select episode_index, dist_agents, "agent_0.action" as act from steps order by index'
    recordings = [Dataset(first).recording(k) for k in range(3)]
    actions = np.concatenate([r.columns["agent_0.action"] for r in recordings])
    for name in ("o.csv", "o.parquet"):
        assert main(["sql", query, str(first), "-o", str(tmp_path / name)]) == 0
        assert "26 rows" in capsys.readouterr().out
        assert main(["sql", query, str(first), "-o", str(tmp_path / name)]) == 2, "it is there already"
        capsys.readouterr()
    np.testing.assert_array_equal(np.stack(pq.read_table(tmp_path / "o.parquet")["act"].to_pylist()), actions)
    with open(tmp_path / "o.csv") as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_array_equal(np.array([json.loads(r["act"]) for r in rows], np.float32), actions)
    assert main(["sql", query, str(first)]) == 0
    assert "dist_agents" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("selec 1", "syntax error"),
        ("select speed from steps", "speed"),
        ("select * from runs", "runs"),
        ("select 1; select 2", "one query"),
        ("create table t as select 1", "one query"),
        ("copy steps to 'stolen.csv'", "one query"),
        ("select * from read_csv('/etc/hostname')", "disabled by configuration"),
        ("select 'x'::int", "Could not convert"),
    ],
)
def test_refusals_say_what_there_is(query: str, said: str, folders, capsys) -> None:
    assert main(["sql", query, str(folders[0])]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    if said not in ("one query", "syntax error"):
        assert 'h3data sql "describe steps" DATASET' in error


def test_a_folder_stands_for_the_datasets_below_it(folders, tmp_path: Path, capsys) -> None:
    for k, folder in enumerate(folders):
        shutil.copytree(folder, tmp_path / "kept" / f"{k:06d}")
    counts = ask(capsys, "select dataset, count(*) from steps group by 1 order by 1", tmp_path / "kept")
    assert [(Path(name).name, count) for name, count in counts] == [("000000", 26), ("000001", 4)]


def test_what_is_no_dataset(folders, tmp_path: Path, capsys) -> None:
    from h3data.recording import write_mcap

    write_mcap(simple_recording(), tmp_path / "e.mcap")
    for arguments, said in (
        (["select 1"], "Expected at least one dataset"),
        (["select 1", str(tmp_path / "e.mcap")], "h3data convert"),
        (["select 1", str(tmp_path / "nowhere")], "There is no such"),
        (["select 1", str(folders[0]), "-o", str(tmp_path / "o.xlsx")], ".csv or .parquet"),
    ):
        assert main(["sql", *arguments]) == 2
        assert said in capsys.readouterr().err


def test_without_duckdb(folders, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "duckdb", None)
    assert main(["sql", "select 1", str(folders[0])]) == 2
    assert 'pip install "h3data[sql]"' in capsys.readouterr().err


def test_only_episodes_of_committed_shards_count(tmp_path: Path, capsys) -> None:
    with DatasetWriter(tmp_path / "ds", episodes_per_file=1) as writer:
        for seed in range(2):
            writer.add(simple_recording(steps=5, seed=seed))
    (last,) = (tmp_path / "ds").glob("meta/episodes/*/file-001.parquet")
    last.unlink()  # as after a crash before the commit
    (tmp_path / "ds" / "meta" / "info.json").unlink()
    assert ask(capsys, "select count(*), count(distinct episode_index) from steps", tmp_path / "ds") == [[5, 1]]


def test_every_dtype_and_odd_names(tmp_path: Path, capsys) -> None:
    plain = simple_recording(steps=2)
    odd = {"h": np.full(2, 0.5, np.float16), "hv": np.ones((2, 3), np.float16), 'u "x"': np.full((2, 2), 7, np.uint64)}
    with DatasetWriter(tmp_path / "it's") as writer:
        writer.add(replace(plain, columns={**plain.columns, **odd}))
    rows = ask(capsys, 'select dataset, h, hv, "u ""x""" from steps limit 1', tmp_path / "it's")
    assert rows == [[str(tmp_path / "it's"), 0.5, [1.0, 1.0, 1.0], [7, 7]]]
