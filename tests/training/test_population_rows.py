"""The table of rearrangement beside populations over seeds: who counts, means, intervals, rows beside the paper's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bake.populations_rows import crossed_interval, learned_beside, markdown, read_results, values_of
from h3data.errors import FormatError, InputError
from h3data_pipelines.jobs.cross_play import METRICS

SR = next(m for m in METRICS if m.name == "SR")
TEN = ("both", "object_1", "still", "weights:/t/learn_pop.0/partner_0.npz@0123456789ab")


def evaluation(out: Path, run: str, values: dict[str, list[float | None]], *, walk: str = "paper") -> Path:
    """A folder as ``h3data evaluate`` leaves it, with SR by partner and episode."""
    folder = out / walk / run
    (folder / "episodes").mkdir(parents=True)
    count = max(map(len, values.values()))
    for index in range(count):
        rows = [
            {
                "index": index,
                "policy": f"weights:{run}",
                "partner": partner,
                "values": {"SR": value, "RE": None if value is None else 150.0 * value, "CR": 0.0, "RC": None},
            }
            for partner, value in ((partner, of[index]) for partner, of in values.items() if index < len(of))
        ]
        text = json.dumps({"job": {"episode": {"index": index}}, "rows": rows, "failed": []})
        (folder / "episodes" / f"{index:06d}.json").write_text(text)
    table: dict[str, Any] = {"episodes": count, "failed": [], "job": {"task": "rearrange", "zsc": list(TEN)}}
    (folder / "table.json").write_text(json.dumps(table))
    return folder


def test_each_robot_counts_with_whom_it_learned() -> None:
    weights = {s: f"weights:/t/learn_pop.{s}/partner_1.npz@0123456789ab" for s in (0, 1)}
    assert learned_beside("learn_pop", 1)(weights[1])
    assert not learned_beside("learn_pop", 0)(weights[1])
    assert not learned_beside("learn_single", 1)(weights[1])
    assert learned_beside("learn_single", 2)("learn_single_partner_2")
    assert not learned_beside("learn_single", 1)("learn_single_partner_2")
    for run in ("plan_pop_2", "plan_pop_2_no_gps", "plan_pop_2_learned_skills"):
        counts = [
            name for name in ("object_1", "object_2", "both", "still", weights[0]) if learned_beside(run, 0)(name)
        ]
        assert counts == ["object_1", "object_2"]
    assert not learned_beside("untrained", 0)("both")


def test_values_are_means_over_partners(tmp_path: Path) -> None:
    one = read_results(
        evaluation(tmp_path, "plan_pop_1.0", {"object_1": [1, 0, None], "both": [1, 1, 1], "still": [0, 1, None]})
    )
    other = read_results(evaluation(tmp_path, "plan_pop_1.1", {"object_1": [0, 0], "elsewhere": [1, 1]}))
    nan = np.nan
    np.testing.assert_array_equal(values_of([one, other], SR, "train"), [[1, 0, nan], [0, 0, nan]])
    np.testing.assert_allclose(values_of([one, other], SR, "zsc"), [[2 / 3, 2 / 3, 1], [0, 0, nan]])


def test_intervals_tell_of_seeds_and_of_episodes() -> None:
    rng = np.random.default_rng(0)
    seeds, episodes = rng.normal(0, 1, (6, 1)), rng.normal(0, 1, (1, 80))
    mean, low, high = crossed_interval(seeds + 0 * episodes, binary=False)
    assert mean == pytest.approx(seeds.mean())
    assert high - low == pytest.approx(2 * 1.96 * seeds.std() / np.sqrt(6), rel=0.15)
    mean, low, high = crossed_interval(0 * seeds + episodes, binary=False)
    assert high - low == pytest.approx(2 * 1.96 * episodes.std() / np.sqrt(80), rel=0.1)  # not of 480 plays
    holes = np.where(rng.random((6, 80)) < 0.3, np.nan, seeds + episodes)
    mean, low, high = crossed_interval(holes, binary=False)
    assert low < mean < high
    assert mean == pytest.approx(np.nanmean(holes))
    assert crossed_interval(holes, binary=False) == (mean, low, high)


def test_certainty_takes_more_than_success() -> None:
    mean, low, high = crossed_interval(np.ones((3, 50)), binary=True)
    assert (mean, high) == (1.0, 1.0)
    assert low == pytest.approx(0.929, abs=1e-3)
    assert np.isnan(crossed_interval(np.full((2, 3), np.nan), binary=True)).all()


def test_rows_stand_beside_the_papers(tmp_path: Path) -> None:
    for seed in range(3):
        for run in ("learn_pop", "plan_pop_3", "plan_pop_3_no_gps", "my_own"):
            evaluation(
                tmp_path, f"{run}.{seed}", {"both": [1, 1, 0, 1], "object_1": [1, 1, 1, 1], "still": [0, 1, 0, 1]}
            )
    (tmp_path / "natural" / "plan_pop_3.0" / "episodes").mkdir(parents=True)
    lines = markdown(tmp_path).splitlines()
    table = {line.split(" | ")[0].removeprefix("| "): line.strip("| ").split(" | ") for line in lines if " | " in line}
    head, _ = table.pop("robot"), table.pop("---")
    assert list(table) == ["Plan-Pop 3", "Learn-Pop", "Plan-Pop 3, no humanoid GPS", "my_own"]
    row = dict(zip(head, table["Plan-Pop 3, no humanoid GPS"], strict=True))
    assert (row["seeds"], row["episodes"]) == ("3", "4")
    assert row["SR train-pop"].startswith("88 [")
    assert row["SR ZSC"].startswith("75 [")
    assert row["CR ZSC"].startswith("0.00 [0.00, 0.49")
    assert row["RC ZSC"] == "-"
    assert row["paper: SR / RE train-pop"] == "76.5 / 109"
    assert row["paper: SR / RE ZSC"] == "68.7 / 99"
    assert table["Learn-Pop"][3] == "-"  # none of its own people played
    assert lines[-1] == "Unfinished: natural/plan_pop_3.0."


def test_other_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Expected folders of populations_table"):
        markdown(tmp_path)
    folder = evaluation(tmp_path, "plan_pop_3.0", {"both": [1]})
    for text in ("{", "[]", '{"episodes": 1, "failed": [], "job": {}}'):
        (folder / "table.json").write_text(text)
        with pytest.raises(FormatError, match="Expected an evaluation of rearrange"):
            markdown(tmp_path)
