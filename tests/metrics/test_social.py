"""The social profile: values by hand, plain loops over its sources' formulas, laws, and what recordings do not tell."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.metrics import find_metric, measure, metrics_of, series_of
from h3data.metrics.registry import find_profile
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from h3data_pipelines.metric_texts import explain
from h3data_social.people.profile import social_force

SECOND = 1_000_000_000
ROBOT, STRANGER = Agent(name="robot", kind="robot"), Agent(name="other", kind="robot")


def crowd(robot, *people, heading=None, step_ns=SECOND, task="point_goal", info=None, extra=(), **columns) -> Recording:
    """A robot and people at places (x, z) on the floor, one row a second unless said; ``extra`` are further agents."""
    robot = np.asarray(robot, float).reshape(-1, 2)
    rows = len(robot)
    heading = np.zeros(rows) if heading is None else np.asarray(heading, float)
    places = [robot, *(np.asarray(place, float).reshape(-1, 2) for place in people)]
    poses = {
        f"agent_{n}.base_pose": ground_pose(at, heading if n == 0 else np.zeros(rows)).astype(np.float32)
        for n, at in enumerate(places)
    }
    humans = [Agent(name=f"person_{n}", kind="human") for n in range(len(people) - len(extra))]
    return Recording(
        episode=Episode(uid="u", episode_id="e", task=task, scene="x", dt_ns=step_ns, info=info or {}),
        agents=(ROBOT, *humans, *extra),
        columns={"time_ns": np.arange(rows) * step_ns, **poses, **columns},
    )


def still(x, z, rows):
    return [(x, z)] * rows


def assert_values(recording, **expected):
    values = measure(recording, "social").values
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, abs=1e-6, nan_ok=True), name


def test_four_people_by_hand():
    # Fifteen rows: the first person is never nearer than 2.44 m, the last stands 0.73 m away in two of them.
    passing = np.array(still(5.0, 0.0, 15))
    passing[[4, 9], 0] = 0.73
    people = (still(2.44, 0, 15), still(-3, 0, 15), still(0, 4, 15), passing)
    recording = crowd(still(0, 0, 15), *people)
    assert_values(
        recording,
        PSC=13 / 15,
        SC=13 / 15,
        SC_centre=1,
        DH_min=0.73,
        CP_min=0.73,
        DH_min_outline=0.23,
        CP_min_outline=0.48,
        CP_avg=(13 * 2.44 + 2 * 0.73) / 15,
        CP_avg_outline=(13 * 1.94 + 2 * 0.23) / 15,
        CP_max=2.44,
        CP_max_outline=4.75,
        Z_intimate=0,
        Z_personal=2 / 15,
        Z_social=13 / 15,
        Z_public=0,
        Z_personal_outline=2 / 15,
        Z_social_outline=13 / 15,
        RP_personal=0,
        PR_personal=2,
        TTC_min=0.23 / 4.27,
        PL=0,
        ST=14,
        V_people=4 * 4.27 / 14 / 4,
    )
    measured = measure(recording, "social")
    assert (measured.robot, measured.human) == (0, 4), "the one whom it comes nearest"
    assert series_of(recording, "social")["dist_m"][[0, 4]] == pytest.approx([2.44, 0.73], abs=1e-6)


def test_who_closes_the_gap():
    # The robot drives to the first person, and the second walks up to the robot, into both zones each.
    robot = [(0, 0), (1, 0), (2, 0), (2, 0), (2, 0), (2, 0)]
    first = still(2.25, 0, 6)
    second = [(2, 6), (2, 4), (2, 2), (2, 1), (2, 0.25), (2, 3)]
    assert_values(crowd(robot, first, second), RP_personal=1, PR_personal=1, RP_intimate=1, PR_intimate=1)
    assert_values(crowd(robot, still(2.5, 0, 6), second), RP_personal=1, RP_intimate=0)
    inside = crowd(still(0, 0, 3), still(0.3, 0, 3))
    assert_values(inside, RP_personal=0, PR_personal=0, RP_intimate=0, PR_intimate=0)
    both = crowd([(0, 0), (1, 0)], [(3, 0), (2, 0)])
    assert_values(both, RP_personal=1, PR_personal=0)  # steps of one length: the robot's


def test_reaching_a_point():
    robot = [(0, 0), (1, 0), (1, 0), (2, 1), (3, 1), (3, 1)]
    info = {"goal": [3.0, 0.0], "max_steps": 6, "ended": "success"}
    touches = np.zeros((6, 2), np.bool_)
    columns = {
        "metrics.success": np.arange(6) >= 4,
        "metrics.goal_distance": np.array([4, 3, 3, 2, 1, 1], np.float32),
        "metrics.robot_contact": np.array([0, 1, 1, 0, 1, 0], np.bool_),
        "metrics.collision_people": touches,
    }
    recording = crowd(robot, still(9, 9, 6), still(9, 5, 6), info=info, **columns)
    driven = 1 + math.sqrt(2) + 1
    expected = {
        "S": 0,  # it slides along furniture
        "SR": 1,
        "SPL": 1,
        "STL": (4 / 2.5) / 4,
        "total": 1,
        "T": 4,
        "TO": 0,
        "PL": driven,
        "path_ratio": driven / 4,
        "WC": 2,
        "AC": 0,
        "HC": 0,
        "C": 2,
        "completed": 1,
        "TD_min": 1,
        "TD_final": 1,
        "FP": 0,
        "ST": 2,
    }
    assert_values(recording, **expected)
    free = replace(recording, columns={**recording.columns, "metrics.robot_contact": np.zeros(6, np.bool_)})
    assert_values(free, S=1, C=0)
    late = touches.copy()
    late[5, 1] = True
    assert_values(
        replace(free, columns={**free.columns, "metrics.collision_people": late}), SR=1, S=1, HC=1, H_coll=1, C=1
    )
    early = touches.copy()
    early[[1, 2, 4], 1] = early[2, 0] = True
    touched = replace(free, columns={**free.columns, "metrics.collision_people": early})
    assert_values(touched, SR=0, S=0, SPL=0, STL=0, total=0.3, HC=3, HC_steps=3, H_coll=1, T=4)
    assert dict(measure(touched, "social").moments) == {"goal": 4, "collision": 1}
    never = replace(free, columns={**free.columns, "metrics.success": np.zeros(6, np.bool_)})
    assert_values(never, SR=0, S=0, T=math.nan, TO=0)
    in_time = replace(never, episode=replace(never.episode, info={**info, "ended": "max_steps"}))
    assert_values(in_time, TO=1)
    unsaid = replace(never, episode=replace(never.episode, info={"goal": [3.0, 0.0], "max_steps": 6}))
    assert_values(unsaid, TO=1)


def test_failures_to_progress_are_counted_as_events():
    # 20 rows at 1 Hz: two metres on, 8 s of standing, two metres on, and standing until the end.
    x = np.concatenate([[0, 1, 2], np.full(8, 2.0), [3, 4], np.full(7, 4.0)])
    robot = np.stack([x, np.zeros(20)], 1)
    recording = crowd(robot, still(0, 9, 20), info={"goal": [9.0, 0.0]})
    assert_values(recording, FP=2)
    assert series_of(recording, "social")["stuck"].nonzero()[0].tolist() == [7, 8, 9, 10, 17, 18, 19]
    assert_values(crowd(robot[:4], still(0, 9, 4), info={"goal": [9.0, 0.0]}), FP=0)
    assert_values(crowd(robot, still(0, 9, 20), info={"goal": [2.0, 0.0]}), FP=0, T=2)


def test_people_who_touch_each_other_do_not_touch_the_robot():
    rows, someone = 4, np.array([0, 1, 1, 0], np.bool_)
    places = (still(0, 0, rows), still(5, 0, rows), still(5.2, 0, rows))
    pairs = {"metrics.collision": someone, "metrics.collision_people": np.zeros((rows, 2), np.bool_)}
    assert_values(crowd(*places, **pairs), HC=0, H_coll=0, HC_steps=0, RPC=0, PRC=0)
    untold = measure(crowd(*places, **{"metrics.collision": someone}), "social")
    for name in ("HC", "H_coll", "HC_steps", "C", "RPC", "PRC"):
        assert math.isnan(untold.values[name]), name
        assert "metrics.collision does not say who of 3 agents" in untold.notes[name], name
    assert "collision" not in untold.moments
    assert_values(crowd(*places, **{"metrics.collision": someone & False}), HC=0, AC=0, H_coll=0)
    assert_values(crowd(*places[:2], **{"metrics.collision": someone}), HC=1, HC_steps=2, H_coll=1)
    missing = measure(crowd(*places), "social")
    assert "needs metrics.collision_people or metrics.collision" in missing.notes["HC"]
    wrong = measure(crowd(*places, **{"metrics.collision_people": np.zeros((rows, 3), np.bool_)}), "social")
    assert "is of 3 people; there are 2" in wrong.notes["HC"]
    robots = crowd(*places, extra=(STRANGER,), **{"metrics.collision": someone})
    assert "no column metrics.collision_robots" in measure(robots, "social").notes["AC"]
    told = {"metrics.collision_robots": someone[:, None], "metrics.collision_people": np.zeros((rows, 1), np.bool_)}
    assert_values(crowd(*places, extra=(STRANGER,), **told), AC=1, HC=0)


def test_contacts_are_of_who_closes_the_gap():
    robot, person = [(0, 0), (1, 0), (1, 0), (1, 0)], [(1.4, 0), (1.4, 0), (3, 0), (1.4, 0)]
    touches = np.array([[0], [1], [0], [1]], np.bool_)
    assert_values(crowd(robot, person, **{"metrics.collision_people": touches}), HC=2, RPC=1, PRC=1)


def test_motion_is_measured_at_a_fixed_rate():
    """The same drive, recorded at 30, 60 and 100 Hz, has the same jerk; rows farther apart are taken as they are."""

    def drive(step_ns):
        seconds = np.arange(int(6e9 / step_ns) + 1) * step_ns * 1e-9
        return np.stack([2 * np.sin(seconds), np.cos(0.5 * seconds)], 1)

    names = [f"{letter}_{how}" for letter in "VAJ" for how in ("min", "mean", "max")]
    by_rate = []
    for step_ns in (STEP_NS, 16_666_667, 10_000_000):
        robot = drive(step_ns)
        values = measure(crowd(robot, still(9, 9, len(robot)), step_ns=step_ns), "social").values
        by_rate.append([values[name] for name in names])
    for other in by_rate[1:]:
        assert other == pytest.approx(by_rate[0], rel=0.02, abs=0.02)
    t = np.arange(61) * 0.1
    at = np.stack([2 * np.sin(t), np.cos(0.5 * t)], 1)
    jerk = np.linalg.norm(np.diff(at, n=3, axis=0) / 0.1**3, axis=1)
    assert by_rate[2][names.index("J_mean")] == pytest.approx(jerk.mean(), rel=1e-3)
    slow = crowd([(0, 0), (1, 0), (3, 0), (3, 0)], still(9, 9, 4))
    assert_values(slow, V_min=0, V_mean=1, V_max=2, A_min=1, A_mean=1.5, A_max=2, J_min=3, J_mean=3, J_max=3)


def random_crowd(seed, people=3, rows=40):
    random = np.random.default_rng(seed)
    paths = np.cumsum(random.normal(0, 0.05, (people + 1, rows, 2)), axis=1) + random.uniform(-3, 3, (people + 1, 1, 2))
    heading = np.cumsum(random.normal(0, 0.1, rows))
    return (
        crowd(*paths, heading=heading, step_ns=100_000_000, info={"goal": [1.0, 1.0]}),
        paths.astype(np.float32),
        heading,
    )


@pytest.mark.parametrize("seed", range(10))
def test_the_formulas_of_hunavsim_in_plain_loops(seed):
    recording, (robot, *people), heading = random_crowd(seed)
    closest = [min(math.dist(r, p[k]) for p in people) for k, r in enumerate(robot)]
    rows = len(robot)
    zone = lambda low, high: sum(low <= d < high for d in closest) / rows  # noqa: E731
    force = []
    for k in range(1, rows):
        force.append(0.0)
        for p in people:
            e = (p[k] - robot[k]).astype(float)
            d = float(np.hypot(*e))
            e /= d
            w = ((robot[k] - robot[k - 1]) - (p[k] - p[k - 1])) / 0.1
            direction = 2 * w.astype(float) + e
            b = 0.35 * np.hypot(*direction)
            angle = math.remainder(math.atan2(direction[1], direction[0]) - math.atan2(e[1], e[0]), 2 * math.pi)
            velocity = -math.exp(-d / b - (3 * b * angle) ** 2)
            aside = -np.sign(angle) * math.exp(-d / b - (2 * b * angle) ** 2)
            unit = direction / np.hypot(*direction)
            force[-1] += 2.1 * math.hypot(*(velocity * unit + aside * np.array([-unit[1], unit[0]])))
    values = measure(recording, "social").values
    expected = {
        "CP_avg": sum(closest) / rows,
        "CP_min": min(closest),
        "CP_max": max(closest),
        "Z_intimate": zone(0, 0.45),
        "Z_personal": zone(0.45, 1.2),
        "Z_social": zone(1.2, 3.6),
        "Z_public": zone(3.6, math.inf),
        "PL": sum(math.dist(a, b) for a, b in pairwise(robot)),
        "CHC": sum(abs(math.remainder(b - a, 2 * math.pi)) for a, b in pairwise(heading)),
        "TD_min": min(math.dist(r, (1, 1)) for r in robot),
        "TD_final": math.dist(robot[-1], (1, 1)),
        "V_people": np.mean([math.dist(a, b) / 0.1 for p in people for a, b in pairwise(p)]),
        "SF": sum(force) / len(force),
    }
    for name, value in expected.items():
        tolerance = 1e-4 if name in ("SF", "V_people", "CHC", "PL") else 1e-6  # steps of float32 poses
        assert values[name] == pytest.approx(value, abs=tolerance), name


def test_the_social_force_by_hand():
    # Side by side and at rest: D = e, B = 0.35, a = 0.
    assert social_force(np.array([0.0, 0.7]), np.zeros(2)) == pytest.approx(2.1 * math.exp(-2))
    assert social_force(np.array([[1e4, 0.0]]), np.zeros((1, 2)))[0] == 0


grid = st.tuples(st.integers(-8, 8), st.integers(-8, 8))
crowds = st.lists(st.lists(grid, min_size=6, max_size=6), min_size=2, max_size=5)


@settings(deadline=None, max_examples=60)
@given(crowds, st.randoms(use_true_random=False))
def test_the_order_of_people_and_those_far_away_change_nothing(places, random):
    robot, *people = (np.array(place) / 2 + (0, 0.0 if k == 0 else 0.13) for k, place in enumerate(places))
    touches = np.stack([np.hypot(*(place - robot).T) < 0.5 for place in people], 1)

    def values(order, away=False):
        far = [[(1e6 + k, 0) for k in range(6)]] if away else []
        contact = np.concatenate([touches[:, order], np.zeros((6, len(far)), np.bool_)], 1)
        columns = {"metrics.collision_people": contact, "metrics.robot_contact": np.zeros(6, np.bool_)}
        shown = [*(people[k] for k in order), *far]
        return measure(crowd(robot, *shown, info={"goal": [1.0, 0.1]}, **columns), "social").values

    order = list(range(len(people)))
    here = values(order)
    shuffled, away = values(random.sample(order, len(order))), values(order, away=True)
    groups = {"GCR", "G_o", "G_p", "IG_intimate", "IG_personal", "IG_social"}
    unknown = {name for name, value in here.items() if math.isnan(value)}
    assert unknown <= {"T", "TO", "TTC_min", "CD_min", "CD_mean"} | groups
    for name, value in here.items():
        if name != "V_nearest":  # of two who are equally near it is that of one
            np.testing.assert_allclose(shuffled[name], value, rtol=1e-9, err_msg=name)
        if name == "TTC_min" and math.isnan(value):  # somebody far away may be on a collision course, hours ahead
            assert math.isnan(away[name]) or away[name] > 1e4
        elif name not in ("CP_max_outline", "V_people"):  # these are of people wherever they are
            np.testing.assert_allclose(away[name], value, rtol=1e-12, err_msg=name)


SAME = {
    "PSC": "PSC",
    "D_min": "DH_min",
    "TTC_min": "TTC_min",
    "PL": "PL",
    "T_stalled": "ST",
    "T_goal": "T",
    "SPL": "SPL",
    "STL": "STL",
    "turning": "CHC",
} | {f"Z_{zone}": f"Z_{zone}" for zone in ("intimate", "personal", "social", "public")}


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=2, max_size=12), st.floats(-3, 3))
def test_with_one_person_the_values_are_those_of_field(walk, turn):
    untouched = np.zeros(len(walk), np.bool_)
    recording = crowd(
        walk,
        still(0, 0, len(walk)),
        heading=np.linspace(0, turn, len(walk)),
        task="social_nav",
        **{"metrics.collision": untouched},
    )
    field, social = measure(recording, "field").values, measure(recording, "social").values
    for old, new in SAME.items():
        assert social[new] == pytest.approx(field[old], rel=1e-9, abs=1e-12, nan_ok=True), new


def test_episodes_that_differ_are_measured_together_as_alone():
    plain = random_crowd(3)[0]
    gone = plain.columns["agent_2.base_pose"].copy()
    gone[[0, 7, 8, -1]] = np.nan
    nobody = np.full_like(plain.columns["agent_0.base_pose"], np.nan)
    various = [
        random_crowd(1, people=1, rows=7)[0],
        random_crowd(2, people=5, rows=31)[0],
        replace(plain, columns={**plain.columns, "agent_2.base_pose": gone}),
        replace(plain, columns={**plain.columns, "agent_0.base_pose": nobody}),
        replace(plain, columns={name: column[:0] for name, column in plain.columns.items()}),
        replace(plain, columns={name: column[:1] for name, column in plain.columns.items()}),
        replace(plain, columns={**plain.columns, "metrics.collision": np.arange(40) % 5 == 3}),
        replace(plain, columns={**plain.columns, "metrics.robot_clearance": np.linspace(1, 2, 40, dtype=np.float32)}),
        crowd([(0, 0), (1, 0)], still(5, 0, 2), task="social_nav", step_ns=SECOND),
    ]
    profile = find_profile("social", "point_goal")
    for some in (various, various[::-1], various[4:5] * 2):
        together = profile.measure_many(some)
        assert [(e.to_dict(), e.moments) for e in together] == [
            (e.to_dict(), e.moments) for e in map(profile.measure, some)
        ]
    for measured in profile.measure_many(various):
        assert {name for name, value in measured.values.items() if math.isnan(value)} <= set(measured.notes)


def test_values_of_a_fixed_crowd():
    """Values as they were computed when the profile was written: a change of any is a new version of the metric."""
    recording = random_crowd(7)[0]
    touches = np.zeros((40, 3), np.bool_)
    touches[10:13, 1] = True
    columns = {
        **recording.columns,
        "metrics.collision_people": touches,
        "metrics.robot_contact": np.arange(40) % 9 == 0,
    }
    values = measure(replace(recording, columns=columns), "social").values
    assert {name: round(value, 6) for name, value in values.items() if not math.isnan(value)} == GOLDEN


GOLDEN: dict[str, float] = {
    "S": 0.0,
    "SR": 0.0,
    "H_coll": 1.0,
    "C": 6.0,
    "WC": 5.0,
    "AC": 0.0,
    "HC": 1.0,
    "HC_steps": 3.0,
    "FP": 0.0,
    "ST": 0.0,
    "PL": 2.229687,
    "SPL": 0.0,
    "STL": 0.0,
    "total": 0.3,
    "completed": 0.0,
    "TD_min": 3.55206,
    "TD_final": 3.691268,
    "path_ratio": 0.622013,
    "V_min": 0.061627,
    "V_mean": 0.571715,
    "V_max": 1.286883,
    "A_min": 0.616299,
    "A_mean": 8.309104,
    "A_max": 17.470392,
    "J_min": 20.218004,
    "J_mean": 146.399235,
    "J_max": 292.621243,
    "CHC": 2.886436,
    "PSC": 1.0,
    "SC": 1.0,
    "SC_centre": 1.0,
    "DH_min": 2.556084,
    "DH_min_outline": 2.056084,
    "CP_avg": 2.797774,
    "CP_min": 2.556084,
    "CP_max": 3.002981,
    "CP_avg_outline": 2.297774,
    "CP_min_outline": 2.306084,
    "CP_max_outline": 7.020672,
    "Z_intimate": 0.0,
    "Z_personal": 0.0,
    "Z_social": 1.0,
    "Z_public": 0.0,
    "Z_intimate_outline": 0.0,
    "Z_personal_outline": 0.0,
    "Z_social_outline": 1.0,
    "Z_public_outline": 0.0,
    "RP_personal": 0.0,
    "PR_personal": 0.0,
    "RP_intimate": 0.0,
    "PR_intimate": 0.0,
    "RPC": 1.0,
    "PRC": 0.0,
    "TTC_min": 3.28045,
    "V_people": 0.575746,
    "V_nearest": 0.580162,
    "SF": 0.024233,
}


def test_a_robot_and_a_person_are_needed_and_everything_is_explained():
    with pytest.raises(InputError, match="H3-METRIC-027"):
        measure(replace(crowd([(0, 0)], [(1, 0)]), agents=(ROBOT, STRANGER)), "social")
    text = explain(find_metric("DH_min"))
    for part in ("min c", "Francis", "unit       m", "c that to the nearest person", "social/space/DH_min@1"):
        assert part in text
    named = {name for m in metrics_of("social") for name in m.series}
    recording = crowd([(0, 0)] * 3, still(1, 0, 3), **{"metrics.collision": np.zeros(3, np.bool_)})
    recording = replace(recording, columns={**recording.columns, "metrics.robot_contact": np.zeros(3, np.bool_)})
    series = series_of(recording, "social")
    assert named <= set(series)
    assert {len(each) for each in series.values()} == {3}


def test_spaces_of_groups_by_hand():
    # Two people 1.2 m apart: their o-space has a radius of 0.6 m. The robot crosses it.
    robot = [(-3, 0), (-1.0, 0), (-0.5, 0), (0.2, 0), (1.0, 0), (4, 0)]
    info = {"people": {"person_0": {"group": "talk1"}, "person_1": {"group": "talk1"}, "person_2": {"group": ""}}}
    people = still(0, 0.6, 6), still(0, -0.6, 6), still(9, 9, 6)
    recording = crowd(robot, *people, info=info)
    assert_values(recording, GCR=1, G_o=2 / 6, G_p=2 / 6, IG_intimate=1 / 6, IG_personal=3 / 6, IG_social=1 / 6)
    assert series_of(recording, "social")["o_space"].tolist() == [False, False, True, True, False, False]
    before_they_meet = crowd(robot, still(0, 3, 6), still(0, -3, 6), still(9, 9, 6), info=info)
    assert_values(before_they_meet, GCR=0, G_o=0, G_p=0, IG_social=0)
    nobody = crowd(robot, *people)
    assert_values(nobody, GCR=math.nan, G_o=math.nan)
    assert not series_of(nobody, "social")["o_space"].any()


@pytest.mark.parametrize(
    "people", [3, [1], {"person_0": 4, "stranger": {"group": "walk1"}, "person_1": {"group": [2]}}]
)
def test_hostile_facts_about_people_are_no_groups(people):
    assert_values(crowd(still(0, 0, 3), still(1, 0, 3), still(2, 0, 3), info={"people": people}), GCR=math.nan)


def test_a_robot_alone_is_measured_but_for_what_needs_people():
    info = {"goal": [3.0, 0.0]}
    alone = crowd([(0, 0), (1, 0), (2, 0), (3, 0)], info=info, **{"metrics.robot_contact": np.zeros(4, np.bool_)})
    assert_values(alone, S=1.0, H_coll=0.0, PL=3.0, SPL=1.0, T=3.0, PSC=math.nan, TTC_min=math.nan, V_people=math.nan)
    # beside an episode with people it is the same, and so are they
    both = [alone, crowd([(0, 0), (1, 0)], [(3, 0), (3, 0)], info=info)]
    profile = find_profile("social", "point_goal")
    assert [each.to_dict() for each in profile.measure_many(both)] == [profile.measure(each).to_dict() for each in both]
    assert len(series_of(alone, "social")["dist_m"]) == 4
    with pytest.raises(InputError, match="H3-METRIC-029"):
        measure(alone, "field")
