"""Metrics of single recordings: formulas by hand, laws, what is missing, and the array form against a plain loop."""

from __future__ import annotations

import dataclasses
import json
import math
import uuid

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.geometry import ground_pose, heading_direction, heading_from_quat
from h3data.metrics import (
    EpisodeMetrics,
    all_metrics,
    all_profiles,
    find_metric,
    measure,
    measure_many,
    metrics_of,
    series_of,
)
from h3data.metrics.episode import NEVER
from h3data.metrics.paper.encounter import PAPER, encounter_series
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from h3data_pipelines.metric_texts import explain
from h3data_viewers.rerun.timeseries import following_rows
from tests.paths import ROOT
from tests.random_cases import examples

ROBOT = Agent(name="spot", kind="robot")
HUMAN = Agent(name="alex", kind="human")
LIMIT = {"max_steps": 100, "oracle_min_steps": 2}


def recording(robot_x, human_x, *, heading=0.0, info=LIMIT, agents=(ROBOT, HUMAN), drop=(), **columns) -> Recording:
    """Two agents on the x axis; the geodesic distance is the straight one unless given."""
    robot_x, human_x = np.asarray(robot_x, float), np.asarray(human_x, float)
    steps = len(robot_x)
    facing = np.broadcast_to(np.asarray(heading, float), steps)

    def pose(x, h):
        return ground_pose(np.stack([x, np.zeros(steps)], 1), h).astype(np.float32)

    every = {
        "time_ns": np.arange(steps) * STEP_NS,
        "agent_0.base_pose": pose(robot_x, facing),
        "agent_1.base_pose": pose(human_x, np.zeros(steps)),
        "metrics.collision": np.zeros(steps, np.bool_),
        "metrics.geodesic_agents": np.abs(human_x - robot_x).astype(np.float32),
        **columns,
    }
    return Recording(
        episode=Episode(uid=str(uuid.uuid4()), episode_id="e", task="social_nav", scene="none", info=info),
        agents=agents,
        columns={k: v for k, v in every.items() if k not in drop},
    )


def values_of(rec: Recording) -> dict[str, float]:
    return dict(measure(rec).values)


def test_an_episode_by_hand():
    # The robot walks 0.08 m per step towards a standing human 2.2 m ahead, and stands still from row 5 on.
    robot = np.minimum(np.arange(8), 5) * 0.08
    result = measure(recording(robot, np.full(8, 2.2)))
    distance = 2.2 - robot
    assert result.encounter_row == 3  # 2.2 - 3 * 0.08 = 1.96
    assert result.values["S"] == 1
    assert result.values["SPS"] == 2 / 4  # p = 4 steps, l = 2
    assert result.values["F"] == 5 / (100 - 2)
    assert result.values["CR"] == 0
    assert result.values["BYR"] == 0  # never below 1.5 m
    assert result.values["TD"] == pytest.approx(distance.mean(), abs=1e-6)
    assert result.values["FD"] == pytest.approx(distance[3:].mean(), abs=1e-6)
    assert result.notes == {}


def test_backing_up_and_yielding_count_over_all_rows():
    # Rows 0-1 far; then 1.2 m away: stands (2), backs up 0.02 m (3), creeps 3 mm = 0.09 m/s (4), walks 0.08 m (5).
    robot = np.cumsum([0.0, 0.0, 0.0, -0.02, 0.003, 0.08])
    gap = np.array([5.0, 5.0, 1.2, 1.2, 1.2, 1.2])
    assert values_of(recording(robot, robot + gap))["BYR"] == 3 / 6
    # The same motion out of reach of the human is no yield.
    assert values_of(recording(robot, robot + 1.6))["BYR"] == 0


def test_a_fast_sideways_or_turning_robot_does_not_back_up():
    sideways = np.arange(5) * 0.08
    rec = recording(sideways, sideways + 1.2, heading=np.pi / 2)  # faces -z, moves along +x
    assert values_of(rec)["BYR"] == 0
    # Turning on the spot has no speed: a yield, in every row but the first, which has no velocity.
    turning = recording(np.zeros(5), np.full(5, 1.2), heading=np.arange(5) * 0.1)
    assert values_of(turning)["BYR"] == 4 / 5


@pytest.mark.parametrize(
    ("gap", "heading", "found"),
    [
        (1.0, 0.0, 1),
        (2.0, 0.0, 1),
        (0.999, 0.0, 0),
        (2.001, 0.0, 0),
        (1.5, math.radians(59), 1),
        (1.5, math.radians(61), 0),
        (1.5, math.pi, 0),
    ],
)
def test_finding_needs_distance_and_facing(gap, heading, found):
    assert values_of(recording(np.zeros(3), np.full(3, gap), heading=heading))["S"] == found


def test_finding_goes_by_geodesic_distance():
    behind_a_wall = recording(
        np.zeros(4), np.full(4, 1.5), **{"metrics.geodesic_agents": np.array([9, 9, 1.7, 9], np.float32)}
    )
    assert measure(behind_a_wall).encounter_row == 2
    assert values_of(behind_a_wall)["F"] == 1 / 98
    unreachable = recording(np.zeros(2), np.full(2, 1.5), **{"metrics.geodesic_agents": np.full(2, np.inf, np.float32)})
    assert values_of(unreachable)["S"] == 0


def test_a_human_who_is_never_found():
    for info in ({}, LIMIT, {"oracle_min_steps": None, "max_steps": 100}):
        result = measure(recording(np.zeros(4), np.full(4, 6.0), info=info))
        assert (result.values["S"], result.values["SPS"], result.values["F"]) == (0, 0, 0)
        assert math.isnan(result.values["FD"]), "undefined, not 0 as in Habitat"
        assert "never finds" in result.notes["FD"]
        assert result.values["TD"] == pytest.approx(6)
        assert result.encounter_row == NEVER


@pytest.mark.parametrize(
    ("info", "reason"),
    [
        ({"max_steps": 100}, "not recorded"),
        ({"max_steps": 100, "oracle_min_steps": None}, "never reached"),
        ({"max_steps": 100, "oracle_min_steps": "twelve"}, "whole number"),
        ({"max_steps": 100, "oracle_min_steps": 0}, "whole number"),
        ({"max_steps": 100, "oracle_min_steps": float("nan")}, "whole number"),
        ({"max_steps": 100, "oracle_min_steps": True}, "whole number"),
    ],
)
def test_without_the_oracle_there_is_no_sps_and_no_f(info, reason):
    result = measure(recording(np.zeros(4), np.full(4, 1.5), info=info))
    assert math.isnan(result.values["SPS"])
    assert math.isnan(result.values["F"])
    assert reason in result.notes["SPS"]
    assert result.values["S"] == 1


def test_the_following_rate_never_exceeds_one():
    rec = recording(np.zeros(50), np.full(50, 1.5), info={"max_steps": 50, "oracle_min_steps": 30})
    assert values_of(rec)["F"] == 1
    no_limit = measure(recording(np.zeros(50), np.full(50, 1.5), info={"oracle_min_steps": 10}))
    assert no_limit.values["F"] == 1  # 50 / max(50 - 10, 50)
    assert "50 rows taken" in no_limit.notes["F"]


def test_collisions():
    hit = np.zeros(6, np.bool_)
    hit[5] = True
    rec = recording(np.zeros(6), np.full(6, 3.0), **{"metrics.collision": hit})
    assert measure(rec).values["CR"] == 1
    assert "CR" not in measure(rec).notes
    hit = np.roll(hit, -2)
    rec = recording(np.zeros(6), np.full(6, 3.0), **{"metrics.collision": hit})
    assert measure(rec).values["CR"] == 1
    assert "after the first contact in row 3" in measure(rec).notes["CR"]
    unknown = measure(recording(np.zeros(6), np.full(6, 3.0), drop=("metrics.collision",)))
    assert math.isnan(unknown.values["CR"])
    assert "metrics.collision" in unknown.notes["CR"]


def test_a_foreign_recording_has_distances_and_says_what_it_lacks():
    rec = recording(
        np.zeros(5),
        np.linspace(3, 1.2, 5),
        info={},
        drop=("metrics.collision", "metrics.geodesic_agents"),
        agents=(HUMAN, dataclasses.replace(ROBOT, name="later")),
        heading=0.0,
    )
    result = measure(rec)
    assert (result.robot, result.human) == (1, 0)
    assert result.values["TD"] == pytest.approx(np.linspace(3, 1.2, 5).mean(), abs=1e-6)
    assert math.isnan(result.values["CR"])
    for name in ("S", "SPS", "F", "FD"):
        assert "L2" in result.notes[name]


def test_missing_poses_are_left_out_and_counted():
    rec = recording(np.zeros(4), np.array([2.0, np.nan, 1.0, 1.0]))
    result = measure(rec)
    assert result.values["TD"] == pytest.approx(4 / 3)
    assert "1 of 4 rows" in result.notes["TD"]
    gone = measure(recording(np.zeros(3), np.full(3, np.nan)))
    assert all(math.isnan(gone.values[k]) for k in ("S", "SPS", "F", "BYR", "TD", "FD"))
    empty = measure(recording(np.zeros(0), np.zeros(0)))
    assert all(math.isnan(v) for v in empty.values.values())
    assert set(empty.notes) == set(empty.values)


@pytest.mark.parametrize(
    ("agents", "words"),
    [
        ((), "no agents at all"),
        ((ROBOT,), "no human"),
        ((HUMAN,), "no robot"),
        ((ROBOT, ROBOT), "spot (robot), spot (robot)"),
    ],
)
def test_wrong_agents_are_refused_by_name(agents, words):
    with pytest.raises(InputError, match="H3-METRIC-027") as caught:
        measure(recording(np.zeros(2), np.ones(2), agents=agents))
    assert words in str(caught.value)


def test_registry_and_results_agree():
    metrics = metrics_of("paper")
    assert [m.name for m in metrics] == ["S", "SPS", "F", "CR", "BYR", "TD", "FD"]
    assert len({m.id for m in metrics}) == len(metrics)
    result = measure(recording(np.zeros(2), np.ones(2) * 1.5))
    assert list(result.values) == [m.name for m in metrics]
    for metric in metrics:
        assert find_metric(metric.id) is find_metric(metric.name.lower()) is metric
        assert metric.formula in explain(metric)
        low, high = metric.range
        assert low <= result.values[metric.name] <= high
    with pytest.raises(InputError, match="H3-METRIC-024"):
        find_metric("nope")
    with pytest.raises(InputError, match=r"(?s)'habitat'.*H3-FILE-011"):
        measure(recording(np.zeros(2), np.ones(2)), profile="habitat7")


# --- the array form against a plain loop ------------------------------------------------------------------------------
def random_columns(seed: int, rows: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)

    def walk(spread):
        heading = np.cumsum(random.normal(0, 0.2, rows))
        pose = ground_pose(np.cumsum(random.normal(0, spread, (rows, 2)), 0), heading, random.normal(0, 0.1, rows))
        return pose.astype(np.float32)

    robot, human = walk(0.03), walk(0.01)
    human[:, :3] += np.float32(0.8) * random.normal(size=3).astype(np.float32)
    human[random.random(rows) < 0.03] = np.nan
    for k in np.flatnonzero(random.random(rows - 1) < 0.3) + 1:
        robot[k] = robot[k - 1]
    reach = np.linalg.norm(robot[:, :3] - human[:, :3], axis=1) * random.uniform(1, 1.3, rows)
    return {
        "robot_pose": robot,
        "human_pose": human,
        "reach_m": reach.astype(np.float32),
        "time_ns": np.cumsum(random.integers(STEP_NS // 2, STEP_NS * 2, rows)),
    }


def plain_row(c: dict[str, np.ndarray], k: int) -> tuple[float, bool, bool]:
    """Distance, found, and avoiding (backing up or yielding) in row k."""
    robot, human = c["robot_pose"].astype(float), c["human_pose"].astype(float)
    gap = human[k, :3] - robot[k, :3]
    if np.isnan(gap).any():
        return math.nan, False, False
    distance = float(np.linalg.norm(gap))
    towards = gap[[0, 2]] / np.linalg.norm(gap[[0, 2]])
    facing = heading_direction(heading_from_quat(robot[k, 3:])) @ towards
    found = PAPER.near_m <= c["reach_m"][k] <= PAPER.far_m and facing > PAPER.facing
    if distance >= PAPER.avoid_m or k == 0:
        return distance, found, False
    velocity = (robot[k] - robot[k - 1])[[0, 2]] / ((c["time_ns"][k] - c["time_ns"][k - 1]) * 1e-9)
    ahead = velocity @ heading_direction(heading_from_quat(robot[k - 1, 3:]))
    return distance, found, bool(ahead < -PAPER.still_m_s or np.linalg.norm(velocity) < PAPER.yield_m_s)


@settings(max_examples=examples(12), derandomize=True, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 60))
def test_the_series_equal_a_plain_loop(seed, rows):
    columns = random_columns(seed, rows)
    got = encounter_series(**columns)
    distance, found, avoiding = map(list, zip(*(plain_row(columns, k) for k in range(rows)), strict=True))
    assert got["dist_m"] == pytest.approx(distance, nan_ok=True)
    assert got["found"].tolist() == found
    assert (got["backs_up"] | got["yields"]).tolist() == avoiding
    assert not (got["backs_up"] & got["yields"]).any()


def test_values_follow_from_the_series():
    columns = random_columns(5, 400)
    rec = recording(
        np.zeros(400),
        np.zeros(400),
        **{
            "agent_0.base_pose": columns["robot_pose"],
            "agent_1.base_pose": columns["human_pose"],
            "metrics.geodesic_agents": columns["reach_m"],
        },
    )
    rows = following_rows(rec, 0, 1)
    assert rows.sum() > 0
    assert np.flatnonzero(rows)[0] == measure(rec).encounter_row
    distance = series_of(rec)["dist_m"]
    assert measure(rec).values["TD"] == pytest.approx(np.nanmean(distance))
    assert measure(rec).values["FD"] == pytest.approx(np.nanmean(distance[measure(rec).encounter_row :]))


@settings(max_examples=examples(10), derandomize=True, deadline=None)
@given(seed=st.integers(0, 1000), turn=st.floats(-3, 3), shift=st.floats(-5, 5))
def test_metrics_do_not_depend_on_where_the_home_stands(seed, turn, shift):
    random = np.random.default_rng(seed)
    steps = 40
    here = [random.normal(0, 0.05, (steps, 2)).cumsum(0) + offset for offset in (0.0, 1.1)]
    headings = random.normal(0, 0.3, (2, steps)).cumsum(1)
    c, s = np.cos(turn), np.sin(turn)
    results = []
    for rotation, move, add in ((np.eye(2), 0.0, 0.0), (np.array([[c, -s], [s, c]]), shift, turn)):
        poses = [
            ground_pose(p @ rotation + move, h + add).astype(np.float32) for p, h in zip(here, headings, strict=True)
        ]
        rec = recording(np.zeros(steps), np.zeros(steps), drop=("metrics.geodesic_agents",), info=LIMIT)
        rec = dataclasses.replace(
            rec, columns={**rec.columns, "agent_0.base_pose": poses[0], "agent_1.base_pose": poses[1]}
        )
        results.append(measure(rec))
    first, second = results
    for name, value in first.values.items():
        assert second.values[name] == pytest.approx(value, abs=1e-4, nan_ok=True), name


def test_a_table_of_episodes():
    gaps = [1.5, 6.0, 1.5, 1.5]
    table = measure_many(recording(np.zeros(4), np.full(4, gap)) for gap in gaps)
    assert len(table) == 4
    assert table.columns["S"].tolist() == [1, 0, 1, 1]
    summary = table.summary()
    assert summary["S"].mean == 0.75
    assert summary["S"].method == "wilson"
    assert summary["S"].low < 0.75 < summary["S"].high < 1
    assert summary["FD"].count == 3
    assert summary["FD"].mean == pytest.approx(1.5)
    assert summary["TD"].mean == pytest.approx((3 * 1.5 + 6) / 4)
    assert summary == table.summary(), "the bootstrap is seeded"
    text = table.to_text()
    assert "3 of 4" in text
    assert "never finds the human (1 of 4 episodes)" in text
    assert len({line.index("up") for line in text.splitlines()[1:4]}) == 1, "columns are aligned"
    back = json.loads(table.to_json())
    assert back["episodes"][1]["values"]["FD"] is None
    assert back["summary"]["S"]["mean"] == 0.75


def test_an_empty_table_and_a_single_episode():
    empty = measure_many([])
    assert all(math.isnan(s.mean) and s.count == 0 for s in empty.summary().values())
    assert "undefined" in empty.to_text()
    one = measure_many([recording(np.zeros(4), np.full(4, 1.5))])
    assert math.isnan(one.summary()["TD"].low), "one episode has no bootstrap interval"
    assert not math.isnan(one.summary()["S"].low)
    assert isinstance(one.episodes[0], EpisodeMetrics)


def test_the_documentation_says_the_same():
    text = (ROOT / "docs" / "metrics.md").read_text()
    for metric in all_metrics():
        if metric.profile in ("habitat@0.3.0", "partnr@habitat"):
            continue  # the page says where they differ from habitat and partnr
        row = next(line for line in text.splitlines() if f"`{metric.id}`" in line)
        formula = metric.formula.replace("|", "\\|")
        assert f"| {formula} |" in row
        assert row.startswith(f"| {metric.name}, {metric.title.lower()} |")


def test_every_metric_is_described_in_full():
    every = all_metrics()
    assert len({m.id for m in every}) == len(every)
    for profile in all_profiles():
        assert len({m.name for m in profile.metrics}) == len(profile.metrics)
    for metric in every:
        assert metric.id.startswith(f"{metric.profile}/{metric.task}/{metric.name}@")
        assert metric.title
        assert metric.formula
        assert metric.source
        assert metric.columns
        assert metric.undefined
        assert metric.range[0] < metric.range[1]
        assert not metric.binary or metric.range == (0.0, 1.0)
