"""Many recordings at once: datasets and logs, files of results, two runs compared, and the command."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.metrics import compare_tables, measure, measure_files, measure_many, measure_tables, series_of
from h3data.metrics.reading import chunks_of, recordings
from h3data.metrics.registry import profile_for
from h3data.recording import STEP_NS, Agent, AssetRef, Body, Dataset, DatasetWriter, Episode, Recording, write_mcap
from h3data_pipelines.cli import main
from h3data_pipelines.metric_files import events_of, write_events, write_series, write_table


def episode(number: int, *, run: str = "a", near: float = 1.0, drop: tuple[str, ...] = ()) -> Recording:
    """A robot that approaches a person, with furniture that metrics should not read."""
    random = np.random.default_rng(number)
    steps = 20 + number % 7
    robot = np.stack([np.linspace(0, 3 * near, steps), random.normal(0, 0.05, steps)], 1)
    pose = ground_pose(robot, random.normal(0, 0.2, steps)).astype(np.float32)
    human = ground_pose(np.full((steps, 2), [4.0, 0.0]), np.zeros(steps)).astype(np.float32)
    columns = {
        "time_ns": np.arange(1, steps + 1) * STEP_NS,
        "object_pose": random.normal(size=(steps, 1, 7)).astype(np.float32),
        "agent_0.base_pose": pose,
        "agent_1.base_pose": human,
        "metrics.collision": np.zeros(steps, np.bool_),
        "metrics.geodesic_agents": np.linalg.norm(pose[:, :3] - human[:, :3], axis=1),
    }
    return Recording(
        episode=Episode(
            uid=f"{run}-{number}",
            episode_id=f"e{number:03d}",
            task="social_nav",
            scene="home",
            info={"max_steps": 30, "oracle_min_steps": 5},
        ),
        assets=(AssetRef(name="box", uri="primitive:box"),),
        bodies=(Body(name="box", asset="box", pose=np.ones(7, np.float32), moving=0),),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={k: v for k, v in columns.items() if k not in drop},
    )


def write(root: Path, episodes: list[Recording], **options) -> Path:
    with DatasetWriter(root, **options) as out:
        for recording in episodes:
            out.add(recording)
    return root


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("metrics") / "ds", [episode(k) for k in range(70)], episodes_per_file=20)


@pytest.mark.parametrize("profile", ["paper", "habitat", "habitat@0.3.0", "field", "social"])
def test_a_dataset_measures_as_its_recordings_one_by_one(dataset, profile):
    plain = measure_many((episode(k) for k in range(70)), profile)
    for workers in (1, 3):
        table = measure_files([dataset], profile, workers=workers)
        assert table.episode_ids == plain.episode_ids
        assert [e.to_dict() for e in table.episodes] == [e.to_dict() for e in plain.episodes]


def test_episodes_that_differ_are_measured_together_as_alone():
    def changed(k: int, **arrays) -> Recording:
        columns = {**episode(k).columns, **arrays}
        return dataclasses.replace(episode(k), columns={name: c for name, c in columns.items() if c is not None})

    gone = episode(3).columns["agent_1.base_pose"].copy()
    gone[[0, 4, -1]] = np.nan
    unknown = episode(5).columns["metrics.geodesic_agents"].copy()
    unknown[2:6] = np.nan
    touching = np.arange(len(episode(6))) % 5 == 3
    various = [
        episode(0),
        changed(1, **{"metrics.geodesic_agents": None}),
        changed(2, **{"metrics.collision": None}),
        changed(3, **{"agent_1.base_pose": gone}),
        changed(4, **{name: column[:0] for name, column in episode(4).columns.items()}),
        changed(5, **{"metrics.geodesic_agents": unknown}),
        changed(6, **{"metrics.collision": touching}),
        changed(7, **{"agent_0.base_pose": np.full_like(episode(7).columns["agent_0.base_pose"], np.nan)}),
        dataclasses.replace(episode(8), agents=episode(8).agents[::-1]),
    ]
    profile = profile_for("social_nav", {}, "paper")
    for some in (various, various[::-1], various[4:5] * 2):
        together = profile.measure_many(some)
        assert [(e.to_dict(), e.moments) for e in together] == [
            (e.to_dict(), e.moments) for e in map(profile.measure, some)
        ]


@pytest.mark.parametrize(("episodes", "rows"), [(128, 50_000), (7, 50_000), (128, 60), (128, 1)])
def test_chunks_are_all_episodes_in_order_each_of_one_shard(dataset, monkeypatch, episodes, rows):
    monkeypatch.setattr("h3data.metrics.reading._CHUNK", episodes)
    monkeypatch.setattr("h3data.metrics.reading._CHUNK_ROWS", rows)
    opened = Dataset(dataset)
    chunks = list(chunks_of(opened, range(3, 70)))
    assert [k for chunk in chunks for k in chunk] == list(range(3, 70))
    assert all(len({opened.shard_of(opened.row(k)) for k in chunk}) == 1 for chunk in chunks)
    steps = [sum(opened.row(k)["length"] for k in chunk) for chunk in chunks]
    assert all(
        len(chunk) <= episodes and (n <= rows or len(chunk) == 1) for chunk, n in zip(chunks, steps, strict=True)
    )
    assert list(chunks_of(opened, range(5, 5))) == []


def test_only_what_the_profile_reads_is_read(dataset):
    first = next(recordings([dataset], "paper"))
    assert set(first.columns) == {
        "time_ns",
        "agent_0.base_pose",
        "agent_1.base_pose",
        "metrics.collision",
        "metrics.geodesic_agents",
    }
    assert not first.bodies
    assert set(next(recordings([dataset])).columns) == set(first.columns), "paper is the profile of the task"


def test_part_of_an_episode_is_read_as_asked(dataset):
    opened = Dataset(dataset)
    agents = opened.recording(3, columns=["metrics.collision"], records=("agents",))
    assert [a.kind for a in agents.agents] == ["robot", "human"]
    assert set(agents.columns) == {"time_ns", "agent_0.base_pose", "agent_1.base_pose", "metrics.collision"}
    everything = opened.recording(3, records=("agents", "bodies", "assets"))
    assert set(everything.columns) == set(opened.recording(3).columns)


def test_one_episode_is_named_by_its_number(dataset, tmp_path):
    log = write_mcap(episode(100), tmp_path / "log.mcap")
    table = measure_files([f"{dataset}#3", log])
    assert [e.to_dict() for e in table.episodes] == [measure(episode(k)).to_dict() for k in (3, 100)]
    for source, message in (
        (f"{dataset}#70", r"(?s)0.*69.*H3-RECORDING-053"),
        (f"{log}#0", "H3-RECORDING-052"),
        ("none#0", "H3-RECORDING-049"),
    ):
        with pytest.raises(InputError, match=message):
            measure_files([source])


def test_logs_folders_and_datasets_mix(dataset, tmp_path):
    for number in (100, 101):
        write_mcap(episode(number), tmp_path / f"{number}.mcap")
    table = measure_files([tmp_path, dataset])
    assert len(table) == 72
    assert table.episode_ids[:3] == ("e100", "e101", "e000")
    with pytest.raises(InputError, match="H3-METRIC-045"):
        measure_files([dataset, dataset])
    with pytest.raises(InputError, match="H3-METRIC-001"):
        measure_files([dataset], workers=0)
    with pytest.raises(InputError, match="H3-RECORDING-049"):
        measure_files([tmp_path / "none"])
    with pytest.raises(InputError, match=r"(?s)metrics profile.*H3-FILE-011"):
        measure_files([dataset], "papre")


def test_an_episode_that_cannot_be_measured_is_left_out_by_name(tmp_path, capsys):
    lonely = dataclasses.replace(episode(1), agents=episode(1).agents[:1])
    root = write(tmp_path / "ds", [episode(0), lonely])
    write_mcap(dataclasses.replace(episode(2), agents=()), tmp_path / "nobody.mcap")
    table = measure_files([tmp_path])
    assert table.episode_ids == ("e000",)
    assert table.left_out == {"needs a robot and a human": (str(tmp_path / "nobody.mcap"), f"{root}#1")}
    files = ("--series", str(tmp_path / "s.csv"), "--events", str(tmp_path / "e.csv"))
    assert main(["metrics", str(tmp_path), *files]) == 1  # as report: done, but something is left out
    assert main(["report", str(tmp_path), "-o", str(tmp_path / "r.html"), "--pictures", "0"]) == 1
    assert main(["metrics", f"{root}#0"]) == 0
    assert f"needs a robot and a human: {tmp_path / 'nobody.mcap'}, {root}#1" in capsys.readouterr().out
    assert "e001" not in (tmp_path / "s.csv").read_text()
    with pytest.raises(InputError, match=r"(?s)'e001'.*no.*H3-METRIC-027"):
        measure_files([f"{root}#1"])


def test_folders_are_walked_and_tasks_have_tables_of_their_own(tmp_path, capsys):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    write_mcap(episode(0), tmp_path / "deep" / "er" / "a.mcap")
    write(tmp_path / "deep" / "ds", [episode(1)])
    assert measure_files([tmp_path]).episode_ids == ("e000", "e001")
    other = episode(2)
    other = dataclasses.replace(other, episode=dataclasses.replace(other.episode, task="juggling"))
    write_mcap(other, tmp_path / "z.mcap")
    tables = measure_tables([tmp_path])
    assert [(t.profile, len(t)) for t in tables] == [("paper", 2), ("task", 1)]
    assert main(["metrics", str(tmp_path)]) == 0
    assert "juggling: 1 episodes" in capsys.readouterr().out
    assert main(["metrics", str(tmp_path), "-o", str(tmp_path / "t.csv")]) == 2
    assert "juggling (1 episodes, profile task)" in capsys.readouterr().err


def test_a_column_that_some_episodes_lack_is_undefined_there(tmp_path):
    root = write(tmp_path / "ds", [episode(0), episode(1, drop=("metrics.collision",))])
    table = measure_files([root])
    assert table.columns["CR"][0] == 0
    assert math.isnan(table.columns["CR"][1])
    assert "no column metrics.collision (1 of 2 episodes)" in table.to_text()


def test_results_are_the_same_in_every_kind_of_file(dataset, tmp_path):
    table = measure_files([dataset])
    for ending in ("json", "csv", "parquet"):
        write_table(table, tmp_path / f"t.{ending}")
    said = json.loads((tmp_path / "t.json").read_text())["episodes"]
    with open(tmp_path / "t.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    stored = pq.read_table(tmp_path / "t.parquet")
    assert stored["episode_id"].to_pylist() == [r["episode_id"] for r in rows] == list(table.episode_ids)
    for name, column in table.columns.items():
        expected = [None if math.isnan(v) else float(v) for v in column]
        assert stored[name].to_pylist() == expected
        assert [e["values"][name] for e in said] == expected
        assert [float(r[name]) if r[name] else None for r in rows] == expected
    assert json.loads(stored.schema.metadata[b"h3data.metrics"])["S"] == "paper/social_nav/S@1"
    with pytest.raises(InputError, match=r"(?s)json or \.csv or \.parquet.*H3-METRIC-048"):
        write_table(table, tmp_path / "t.xlsx")
    assert not list(tmp_path.glob("*.part"))


def test_series_and_events_of_many_episodes(dataset, tmp_path):
    rows = write_series(recordings([dataset], "paper"), tmp_path / "s.parquet")
    stored = pq.read_table(tmp_path / "s.parquet")
    assert rows == len(stored) == sum(len(episode(k)) for k in range(70))
    third = stored.filter(np.array(stored["episode_id"].to_pylist()) == "e003")
    for name, values in series_of(episode(3)).items():
        np.testing.assert_array_equal(third[name].to_numpy(), values, err_msg=name)
    count = write_events(recordings([dataset], "paper"), tmp_path / "e.csv")
    with open(tmp_path / "e.csv", newline="") as stream:
        events = list(csv.DictReader(stream))
    assert count == len(events) > 70
    found = [e for e in events if e["what"] == "found" and e["episode_id"] == "e003"]
    assert int(found[0]["first_row"]) == measure(episode(3)).encounter_row
    assert write_series([], tmp_path / "none.parquet") == 0
    assert write_events([], tmp_path / "none.csv") == 0


def test_events_are_runs_of_flags():
    recording = episode(4)
    flags = series_of(recording)["found"]
    runs = [e for e in events_of(recording) if e["what"] == "found"]
    covered = np.zeros(len(flags), np.bool_)
    for event in runs:
        covered[event["first_row"] : event["last_row"] + 1] = True
    np.testing.assert_array_equal(covered, flags)
    assert events_of(dataclasses.replace(recording, columns={k: v[:0] for k, v in recording.columns.items()})) == []


# --- two runs ---------------------------------------------------------------------------------------------------------
def test_a_run_compared_with_itself_and_with_another():
    one = measure_many(episode(k) for k in range(12))
    same = compare_tables(one, measure_many(episode(k, run="b") for k in reversed(range(12))))
    assert all(not same.changed(name) for name in one.columns)
    assert "No episode differs" in same.to_text()
    slow = measure_many(episode(k, run="b", near=0.3 if k == 5 else 1.0) for k in range(12))
    found = compare_tables(one, slow, names=("fast", "slow"))
    assert found.changed("S") == [("e005", 1.0, 0.0)]
    assert found.changed("FD")[0][0] == "e005"
    assert math.isnan(found.changed("FD")[0][2])
    assert found.tests["TD"].difference == pytest.approx(one.columns["TD"].mean() - slow.columns["TD"].mean())
    assert "e005 1.000 / 0.000" in found.to_text()
    assert json.loads(found.to_json())["metrics"]["S"]["changed"] == [["e005", 1.0, 0.0]]


def test_runs_that_cannot_be_paired_say_why():
    one = measure_many(episode(k) for k in range(6))
    with pytest.raises(InputError, match=r"(?s)only A has 2: 'e000', 'e001'; only B has 1: 'e006'.*H3-METRIC-005"):
        compare_tables(one, measure_many(episode(k) for k in range(2, 7)))
    with pytest.raises(InputError, match="H3-METRIC-004"):
        compare_tables(one, measure_many((episode(k) for k in range(6)), "field"))
    twice = measure_many([episode(1), episode(1, run="b")])
    with pytest.raises(InputError, match=r"(?s)A.*'e001'.*H3-METRIC-008"):
        compare_tables(twice, twice)


def test_a_gfx_replay_is_said_to_be_taken_for_a_task(tmp_path, capsys):
    """It may be one of rearrangement: the format does not say."""
    for k in range(2):
        found = dataclasses.replace(episode(k), episode=dataclasses.replace(episode(k).episode, task="gfx_replay"))
        write_mcap(found, tmp_path / f"{k}.mcap")
    said = run(capsys, tmp_path)
    assert "Taken for social_nav: 2 gfx-replays, which do not say their task." in said
    assert "--profile field" in said
    assert json.loads(run(capsys, tmp_path / "0.mcap", "--json"))["episodes"][0]["assumed_task"] == "social_nav"
    assert "Taken for" not in run(capsys, tmp_path, "--profile", "field")
    assert "Taken for" not in measure_many([episode(0)]).to_text()


def evaluated(number: int, policy: str, *partners: str, near: float = 1.0) -> Recording:
    """What ``h3data evaluate --save-recordings`` leaves of an episode: partners that do the same share it."""
    found = episode(number, run=f"{policy} {partners[0]}", near=near)
    info = {**found.episode.info, "policy": policy, "partner": partners[0], "partners": list(partners)}
    return dataclasses.replace(found, episode=dataclasses.replace(found.episode, info=info))


def test_a_recording_that_partners_share_counts_for_each_of_them(tmp_path):
    kept = [evaluated(k, "p", *who) for k in range(4) for who in (("both", "plan_pop_1"), ("still",))]
    alone = evaluated(0, "p", "x", near=0.3)
    table = measure_files([write(tmp_path / "ds", [*kept, alone])])
    assert len(table) == 13
    assert [e.partner for e in table.episodes[:3]] == ["both", "plan_pop_1", "still"]
    assert table.columns["S"].mean() == 12 / 13
    assert [e.to_dict() for e in measure_many([*kept, alone]).episodes] == [e.to_dict() for e in table.episodes]
    write_table(table, tmp_path / "t.csv")
    with open(tmp_path / "t.csv", newline="") as stream:
        assert [row["partner"] for row in csv.DictReader(stream)][:3] == ["both", "plan_pop_1", "still"]
    with pytest.raises(InputError, match="H3-METRIC-045"):
        measure_many([kept[0], kept[0]])


def test_evaluations_are_paired_by_partner_and_where_several_robots_play_by_policy():
    who = ("both", "plan_pop_1"), ("still",)
    first, second = (measure_many(evaluated(k, p, *w) for k in range(3) for w in who) for p in ("p", "q"))
    found = compare_tables(first, second)
    assert found.episode_ids[:3] == ("e000 with both", "e000 with plan_pop_1", "e000 with still")
    assert found.tests["TD"].difference == 0
    several = measure_many(evaluated(k, p, *w) for k in range(3) for p in ("p", "q") for w in who)
    assert compare_tables(several, several).episode_ids[3] == "e000 q with both"
    with pytest.raises(InputError, match=r"(?s)only B has 3: 'e000 with x'.*H3-METRIC-005"):
        compare_tables(first, measure_many(evaluated(k, "q", "both", "plan_pop_1", "still", "x") for k in range(3)))


# --- the command ------------------------------------------------------------------------------------------------------
def run(capsys, *arguments, code: int = 0) -> str:
    assert main(["metrics", *map(str, arguments)]) == code
    said = capsys.readouterr()
    return said.out if code == 0 else said.err


def test_the_command_measures_in_every_profile(dataset, tmp_path, capsys):
    assert "Minimum distance" in run(capsys, dataset, "--profile", "field", "-o", tmp_path / "t.csv")
    assert "frist_ecnounter_steps" in run(capsys, dataset, "--profile", "habitat@0.3.0", "--workers", "1")
    files = ["--series", tmp_path / "s.parquet", "--events", tmp_path / "e.csv"]
    assert json.loads(run(capsys, dataset, "--json", *files))["summary"]["S"]["count"] == 70
    assert (tmp_path / "s.parquet").exists()
    assert "exists" in run(capsys, dataset, "-o", tmp_path / "t.csv", code=2)
    assert "PC needs info:evaluation_propositions or info:satisfied_at" in run(
        capsys, dataset, "--profile", "partnr", code=2
    )


def test_the_command_compares(dataset, tmp_path, capsys):
    other = write(tmp_path / "other", [episode(k, run="b", near=0.9) for k in range(70)])
    text = run(capsys, dataset, other, "--paired", "-o", tmp_path / "d.json")
    assert "difference" in text
    assert json.loads((tmp_path / "d.json").read_text())["runs"] == ["ds", "other"]
    assert "compares two runs, got 1" in run(capsys, dataset, "--paired", code=2)
    assert "written as .json" in run(capsys, dataset, other, "--paired", "-o", tmp_path / "d.csv", code=2)


def test_the_command_lists_and_explains(dataset, capsys):
    listed = run(capsys, "list")
    assert "paper/social_nav/SPS@1" in listed
    assert "field/proxemics/TTC_min@2" in listed
    assert "S * l / max(l, p)" in run(capsys, "explain", "SPS")
    text = run(capsys, "explain", "SPS", f"{dataset}#3")
    assert "in episode 'e003'" in text
    assert "info:oracle_min_steps = 5" in text
    data = json.loads(run(capsys, "explain", "D_min", f"{dataset}#3", "--json"))
    assert data["value"] == pytest.approx(measure(episode(3), "field").values["D_min"])
    assert data["metric"]["id"] == "field/proxemics/D_min@2"
    assert "No metric 'XYZ'" in run(capsys, "explain", "XYZ", code=2)
    assert "Name one as" in run(capsys, "explain", "S", dataset, code=2)
