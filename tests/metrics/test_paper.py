"""The paper's formulas: ten written-out episodes with every value by hand, laws, and rearrangement on written-out tables."""

from __future__ import annotations

import dataclasses
import math
import uuid
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.metrics import MissingColumnsError, find_metric, measure, measure_many, series_of, tabulate
from h3data.metrics.paper import encounter
from h3data.metrics.paper.encounter_kernel import fill_series
from h3data.recording.records import STEP_NS, Agent, Episode, Event, Recording
from h3data_pipelines.metric_texts import explain_episode

ROBOT, HUMAN = Agent(name="spot", kind="robot"), Agent(name="alex", kind="human")
NAN = float("nan")
AWAY = math.pi


def social(robot, human, *, heading=0.0, oracle=3, limit=20, hits=(), reach=None) -> Recording:
    """Two agents on the x axis, positions in metres; row k after action k."""
    robot, human = np.asarray(robot, float), np.asarray(human, float)
    steps = len(robot)
    hit = np.zeros(steps, np.bool_)
    hit[list(hits)] = True

    def pose(x, heading):
        xz = np.stack([x, np.zeros(steps)], 1)
        return ground_pose(xz, np.broadcast_to(np.asarray(heading, float), steps)).astype(np.float32)

    info = {"max_steps": limit} | ({} if oracle is None else {"oracle_min_steps": oracle})
    return Recording(
        episode=Episode(
            uid=str(uuid.uuid4()), episode_id=uuid.uuid4().hex[:6], task="social_nav", scene="x", info=info
        ),
        agents=(ROBOT, HUMAN),
        columns={
            "time_ns": np.arange(1, steps + 1) * STEP_NS,
            "agent_0.base_pose": pose(robot, heading),
            "agent_1.base_pose": pose(human, 0.0),
            "metrics.collision": hit,
            "metrics.geodesic_agents": np.asarray(np.abs(human - robot) if reach is None else reach, np.float32),
        },
    )


# name: recording; S, SPS, F, CR, BYR, TD, FD. l = 3 and E = 20 unless said.
CASES = {
    # Stands 1.75 m away and looks at the person: found at once, w = 4 of 20 - 3; never nearer than 1.5 m.
    "found at once": (social([0] * 4, [1.75] * 4), 1, 1, 4 / 17, 0, 0, 1.75, 1.75),
    # 4, 3, 2, 2 m: found in row 2, p = 3 = l.
    "found in time": (social([0, 1, 2, 2], [4] * 4), 1, 1, 2 / 17, 0, 0, 11 / 4, 2),
    # 4, 4, 3, 3, 2 m: p = 5.
    "found late": (social([0, 0, 1, 1, 2], [4] * 5), 1, 3 / 5, 1 / 17, 0, 0, 16 / 5, 2),
    "never found": (social([0, 0, 0], [5, 6, 7]), 0, 0, 0, 0, 0, 6, NAN),
    # In reach all the time, but with its back to the person; at 1.6 m nothing counts as yielding.
    "faces away": (social([0] * 3, [1.6] * 3, heading=AWAY), 0, 0, 0, 0, 0, 1.6, NAN),
    # 1.25 m ahead, standing: every row but the first is a yield.
    "yields": (social([0] * 4, [1.25] * 4), 1, 1, 4 / 17, 0, 3 / 4, 1.25, 1.25),
    # Backs up by 0.125 m a step (3.75 m/s) from 1 m: rows 1 to 3 back up, row 4 ends at 1.5 m, which is not below.
    "backs up": (social(np.arange(5) * -0.125, [1.0] * 5), 1, 1, 5 / 17, 0, 3 / 5, 1.25, 1.25),
    # 3, 2, 0.5 m and contact in the last row; found in row 1 (p = 2 < l). Driving in fast is no yield.
    "drives into the person": (social([0, 1, 2.5], [3] * 3, hits=(2,)), 1, 1, 1 / 17, 1, 0, 5.5 / 3, 2.5 / 2),
    # 1.5 m through a wall that takes 6 m to walk around, then 1.5 m of way too.
    "behind a wall": (social([0] * 3, [1.5] * 3, reach=[6, 6, 1.5]), 1, 1, 1 / 17, 0, 0, 1.5, 1.5),
    # Follows longer than E - l = 2 steps: F = w / w = 1; without yields as the person is 2 m away.
    "follows to the end": (social([0] * 6, [2] * 6, oracle=4, limit=6), 1, 1, 1, 0, 0, 2, 2),
}


@pytest.mark.parametrize("name", CASES)
def test_ten_episodes_by_hand(name):
    recording, *expected = CASES[name]
    values = measure(recording).values
    for metric, value in zip(("S", "SPS", "F", "CR", "BYR", "TD", "FD"), expected, strict=True):
        assert values[metric] == pytest.approx(value, abs=1e-6, nan_ok=True), metric


@pytest.mark.parametrize("name", CASES)
def test_the_series_are_what_is_counted(name):
    recording = CASES[name][0]
    measured, series = measure(recording), series_of(recording)
    assert measured.values["S"] == series["found"].any()
    if measured.values["S"]:
        assert np.argmax(series["found"]) == measured.encounter_row
        assert measured.values["FD"] == pytest.approx(series["dist_m"][measured.encounter_row :].mean())
    assert measured.values["BYR"] == pytest.approx((series["backs_up"] | series["yields"]).mean())
    assert measured.values["TD"] == pytest.approx(series["dist_m"].mean())
    assert measured.values["CR"] == series["collision"].any()


walks = st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3, 3)), min_size=1, max_size=25)


def floor(walk, human=(0.0, 0.0), *, info=None) -> Recording:
    """A robot on the floor and a standing human, distances straight."""
    x, z, heading = np.array(walk, float).T
    base = social(np.zeros(len(x)), np.full(len(x), 1.0), oracle=4, limit=40)
    robot = ground_pose(np.stack([x, z], 1), heading).astype(np.float32)
    other = ground_pose(np.tile(human, (len(x), 1)), np.zeros(len(x))).astype(np.float32)
    reach = np.linalg.norm(robot[:, :3] - other[:, :3], axis=1)
    columns = {**base.columns, "agent_0.base_pose": robot, "agent_1.base_pose": other, "metrics.geodesic_agents": reach}
    return dataclasses.replace(base, columns=columns)


@given(walks)
def test_bounds(walk):
    values = measure(floor(walk)).values
    for name in ("S", "SPS", "F", "CR", "BYR"):
        assert 0 <= values[name] <= 1
    assert values["S"] >= values["SPS"]
    assert values["TD"] >= 0
    assert math.isnan(values["FD"]) == (values["S"] == 0)


@given(walks, walks)
def test_distances_of_joined_episodes_are_weighted_means(one, two):
    a, b, both = floor(one), floor(two), floor([*one, *two])
    mean = (len(a) * measure(a).values["TD"] + len(b) * measure(b).values["TD"]) / len(both)
    assert measure(both).values["TD"] == pytest.approx(mean, abs=1e-5)
    assert measure(both).values["S"] == max(measure(a).values["S"], measure(b).values["S"])
    if measure(a).values["S"]:
        assert measure(both).encounter_row == measure(a).encounter_row


@given(walks, st.integers(0, 24))
def test_one_more_found_row_never_lowers_s_sps_f(walk, k):
    before = measure(floor(walk)).values
    better = list(walk)
    better[k % len(walk)] = (-1.5, 0.0, 0.0)  # within reach, facing the person
    after = measure(floor(better)).values
    for name in ("S", "SPS", "F"):
        assert after[name] >= before[name]


@given(st.permutations(range(6)))
def test_means_do_not_depend_on_the_order_of_episodes(order):
    rows = [measure(case[0]) for case in list(CASES.values())[:6]]
    one, two = tabulate(rows).summary(resamples=200), tabulate(rows[k] for k in order).summary(resamples=200)
    for name, summary in one.items():
        assert two[name].mean == pytest.approx(summary.mean, abs=1e-12)
        assert two[name].count == summary.count


# --- what cannot share a table ----------------------------------------------------------------------------------------
def test_an_episode_counts_once():
    recording = social([0, 0], [1.5, 1.5])
    with pytest.raises(InputError, match="H3-METRIC-045"):
        measure_many([recording, recording])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dt_ns": 8_333_333}, r"(?s)33\.3 ms.*8\.3 ms.*H3-METRIC-047"),
        ({"info": {"units": "cm"}}, r"(?s)SI.*cm.*H3-METRIC-047"),
        ({"task": "rearrange"}, r"(?s)rearrange \(paper\), social_nav \(paper\).*H3-METRIC-046"),
    ],
)
def test_what_cannot_be_averaged_is_not_mixed(change, words):
    one = social([0, 0], [1.5, 1.5])
    two = social([0, 0], [1.5, 1.5])
    columns = {**two.columns, "metrics.at_goal": np.zeros((2, 1), np.bool_)}
    two = dataclasses.replace(two, episode=dataclasses.replace(two.episode, **change), columns=columns)
    with pytest.raises(InputError, match=words):
        measure_many([one, two])


# --- explanations -----------------------------------------------------------------------------------------------------
def test_an_explanation_says_why():
    lost = explain_episode(find_metric("S"), CASES["faces away"][0])
    assert "S = 0" in lost
    assert "in_reach: in 3 of 3 rows: 0-2" in lost
    assert "facing: in no row" in lost
    undefined = explain_episode(find_metric("FD"), CASES["never found"][0])
    assert "FD = undefined" in undefined
    assert "never finds" in undefined
    assert "dist_m: 5 (row 0) to 7 (row 2)" in undefined
    no_oracle = explain_episode(find_metric("SPS"), social([0] * 3, [1.5] * 3, oracle=None))
    assert "lacked     info:oracle_min_steps" in no_oracle
    found = explain_episode(find_metric("SPS"), CASES["found late"][0])
    assert "info:oracle_min_steps = 3" in found
    assert "found: in 1 of 5 rows: 4" in found
    assert "is not measured in episodes of task 'social_nav'" in explain_episode(find_metric("RC"), CASES["yields"][0])


# --- rearrangement: no simulator makes these yet, the tables are written out ------------------------------------------
def tidy(at_goal, robot=None, human=None, *, hits=(), drop=(), **info) -> Recording:
    """Objects 7 and 9; ``at_goal`` [T, 2]; who holds which body at each row."""
    at_goal = np.array(at_goal, np.bool_)
    steps = len(at_goal)
    hit = np.zeros(steps, np.bool_)
    hit[list(hits)] = True
    still = ground_pose(np.zeros((steps, 2)), np.zeros(steps)).astype(np.float32)
    columns = {
        "time_ns": np.arange(1, steps + 1) * STEP_NS,
        "agent_0.base_pose": still,
        "agent_1.base_pose": still,
        "agent_0.grasp_body": np.array([-1] * steps if robot is None else robot, np.int32),
        "agent_1.grasp_body": np.array([-1] * steps if human is None else human, np.int32),
        "metrics.at_goal": at_goal,
        "metrics.collision": hit,
    }
    said = {"max_steps": 10, "solo_steps": 8, "goal_objects": [7, 9], **info}
    return Recording(
        episode=Episode(uid=str(uuid.uuid4()), episode_id="tidy", task="rearrange", scene="x", info=said),
        agents=(ROBOT, HUMAN),
        columns={k: v for k, v in columns.items() if k not in drop},
    )


def test_rearrangement_by_hand():
    # The robot carries 7 (rows 0-1, placed in 2), the human 9 (rows 0-3, placed in 4): success after 5 steps.
    done = [[0, 0], [0, 0], [1, 0], [1, 0], [1, 1]]
    values = measure(tidy(done, [7, 7, -1, -1, -1], [9, 9, 9, 9, -1])).values
    assert values == {"SR": 1, "RE": 160.0, "CR": 0, "RC": 0.5, "TS": 5}
    # Nobody finishes: a contact after 5 rows gives no time to success, and RE takes E = 10.
    unfinished = measure(tidy([*done[:4], [1, 0]], [7, 7, -1, -1, -1], hits=(4,)))
    values = dict(unfinished.values)
    assert math.isnan(values.pop("TS"))
    assert unfinished.notes["TS"] == "the task is not completed"
    assert values == {"SR": 0, "RE": 80.0, "CR": 1, "RC": 1.0}


def test_a_person_alone_who_did_not_finish_makes_a_lower_bound():
    done = [[0, 0], [0, 0], [1, 1]]
    assert "RE" not in measure(tidy(done, solo_steps=9)).notes
    censored = measure(tidy(done, solo_steps=10))
    assert "censored" in censored.notes["RE"]
    assert "lower bound" in censored.notes["RE"]


def test_the_last_holder_gets_the_credit():
    carried_twice = [[0, 0], [1, 0], [0, 0], [1, 0]]  # the robot places 7, the human takes it up and puts it back
    assert measure(tidy(carried_twice, [7, -1, -1, -1], [-1, -1, 7, -1])).values["RC"] == 0
    untouched = measure(tidy([[1, 0]] * 3, [-1, 7, -1]))
    assert math.isnan(untouched.values["RC"]), "it has been there from the start"
    assert "no object was carried" in untouched.notes["RC"]


def test_without_a_robot_there_is_no_share_of_its():
    alone = dataclasses.replace(tidy([[0, 0], [1, 1]], [7, -1], [9, -1]), agents=(HUMAN, HUMAN))
    result = measure(alone)
    assert math.isnan(result.values["RC"])
    assert result.notes["RC"] == "there is no robot"
    assert result.values["SR"] == 1
    assert result.values["CR"] == 0
    del alone.columns["metrics.collision"]
    assert measure(alone).values["CR"] == 0
    assert "CR" not in measure(alone).notes


def test_success_after_the_limit_is_none():
    late = [[0, 0]] * 10 + [[1, 1]]
    values = measure(tidy(late)).values
    assert (values["SR"], values["RE"]) == (0, 80.0)
    assert math.isnan(values["TS"])


def test_what_rearrangement_needs_is_named():
    part = measure(tidy([[0, 1]], solo_steps=None))
    assert math.isnan(part.values["RE"])
    assert "info:solo_steps" in part.notes["RE"]
    with pytest.raises(
        MissingColumnsError, match=r"(?s)SR needs metrics\.success or metrics\.at_goal.*H3-METRIC-026"
    ) as caught:
        measure(tidy([[0, 1]], drop=("metrics.at_goal", "metrics.collision")))
    assert set(caught.value.needs) == {"SR", "RE", "CR", "RC", "TS"}
    with pytest.raises(InputError, match=r"(?s)2.*goal_objects.*1.*H3-METRIC-015"):
        measure(tidy([[0, 1]], goal_objects=[7]))
    empty = measure(tidy(np.zeros((0, 2)), [], []))
    assert all(math.isnan(v) for v in empty.values.values())
    with pytest.raises(InputError, match=r"(?s)'rearrange'.*H3-METRIC-023"):
        measure(tidy([[0, 1]]), "habitat")


# --- PARTNR -----------------------------------------------------------------------------------------------------------
def partnr(satisfied, events=(), **info) -> Recording:
    base = tidy([[0, 0]] * 6, satisfied_at=satisfied, **info)
    return dataclasses.replace(base, events=tuple(Event(step=s, agent=a, kind=k) for s, a, k in events))


def test_partnr_by_hand():
    acts = [(1, 0, "progress"), (1, 0, "place"), (2, 1, "progress"), (2, 1, "place"), (3, 1, "place"), (4, 0, "place")]
    values = measure(partnr([1, 2], acts), "partnr").values
    assert math.isnan(values.pop("exploration"))  # nobody took anything
    assert values == {"PC": 1, "state_success": 1, "steps": 6, "offloading": 0.5, "extraneous_effort": 0.5}
    part = measure(partnr([1, -1], acts, constraints=[[True, True]]), "partnr")
    assert part.values["PC"] == 0.5
    assert math.isnan(part.values["extraneous_effort"])
    assert "PC = 0.50" in part.notes["extraneous_effort"]
    assert measure(partnr([1, 2, 3], acts, constraints=[[1, 0, 1], [1, 1, 1]]), "partnr").values["PC"] == 2 / 3
    assert measure(partnr([], acts), "partnr").values["PC"] == 0
    assert series_of(partnr([1, -1]), "partnr")["satisfied_share"].tolist() == [0, 0.5, 0.5, 0.5, 0.5, 0.5]


def test_partnr_refusals():
    with pytest.raises(
        MissingColumnsError, match=r"(?s)PC needs info:evaluation_propositions or info:satisfied_at.*H3-METRIC-026"
    ):
        measure(tidy([[0, 0]]), "partnr")
    assert math.isnan(measure(partnr([1]), "partnr").values["offloading"])
    for info in ({"constraints": [[True]]}, {"constraints": "all"}):
        with pytest.raises(InputError, match=r"(?s)2.*H3-METRIC-017"):
            measure(partnr([1, 2], **info), "partnr")
    with pytest.raises(InputError, match="H3-METRIC-018"):
        measure(partnr("soon"), "partnr")


@pytest.mark.parametrize("seed", range(3))
def test_the_kernel_counts_as_numpy_does_to_the_last_bit(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    rows = 4_000
    poses = rng.normal(size=(2, rows, 7)).astype(np.float32)
    poses[1, :, :3] = poses[0, :, :3] + rng.normal(size=(rows, 3)) * [1, 0.1, 1]
    poses[:, :, 3:] /= np.linalg.norm(poses[:, :, 3:], axis=-1, keepdims=True)
    poses[0, 40:60] = poses[0, 40]  # stands still
    poses[1, 100:120] = poses[0, 100:120]  # on the same spot
    poses[0, 200:220, 3:] = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # upright
    poses[rng.integers(0, 2, 80), rng.integers(0, rows, 80)] = np.nan
    reach = np.where(rng.random(rows) < 0.05, np.nan, rng.uniform(0, 3, rows)).astype(np.float32)
    time_ns = np.cumsum(rng.integers(0, 9, rows) * 10_000_000)  # some steps take no time
    arguments: Any = (*poses, reach, time_ns)
    starts = np.array([0, 1, 700, 2_500])
    monkeypatch.setattr(encounter, "sys", SimpleNamespace(modules={}))
    monkeypatch.setattr(encounter, "_measured_rows", 0)
    plain = [encounter.encounter_series(*arguments, starts=s) for s in (0, starts)]
    monkeypatch.setattr(encounter, "MANY_ROWS", rows)
    compiled = [encounter.encounter_series(*arguments, starts=s) for s in (0, starts)]
    assert fill_series.signatures
    for one, other in zip(plain, compiled, strict=True):
        assert list(one) == list(other)
        for name, values in one.items():
            assert values.dtype == other[name].dtype, name
            np.testing.assert_array_equal(values, other[name], err_msg=name)
    for end in [*range(18), *rng.integers(18, rows, 8).tolist()]:  # a row counts the same in whichever eight rows it is
        part: Any = (poses[0, :end], poses[1, :end], reach[:end].astype(np.float64), time_ns[:end])
        for name, values in encounter.encounter_series(*part).items():
            np.testing.assert_array_equal(values, plain[0][name][:end], err_msg=f"{name} of {end} rows")
