"""The field profile: values by hand, laws, and the cases that are undefined."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from h3data.geometry import ground_pose
from h3data.metrics import measure, metrics_of, series_of
from h3data.recording.records import Agent, Episode, Recording
from h3data_social.field import with_clearance
from h3data_social.field.profile import GOAL, field_series, time_to_collision

SECOND = 1_000_000_000


def floor(robot, human, heading=None, *, step_ns=SECOND, **columns) -> Recording:
    """Positions (x, z) of both, one row a second unless said."""
    robot, human = np.asarray(robot, float).reshape(-1, 2), np.asarray(human, float).reshape(-1, 2)
    steps = len(robot)
    heading = np.zeros(steps) if heading is None else np.asarray(heading, float)
    return Recording(
        episode=Episode(uid="u", episode_id="e", task="social_nav", scene="x", dt_ns=step_ns),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(steps) * step_ns,
            "agent_0.base_pose": ground_pose(robot, heading).astype(np.float32),
            "agent_1.base_pose": ground_pose(human, np.zeros(steps)).astype(np.float32),
            **columns,
        },
    )


def test_a_straight_approach_by_hand():
    # 1 m a second towards a person 5 m ahead, from row 3 on standing 2 m away and facing them.
    robot = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 0)]
    values = measure(floor(robot, [(5, 0)] * 5), "field").values
    expected = {
        "PSC": 1,
        "Z_intimate": 0,
        "Z_personal": 0,
        "Z_social": 3 / 5,
        "Z_public": 2 / 5,
        "intrusions": 0,
        "D_min": 2,
        "TTC_min": 1.5,
        "PL": 3,
        "PE": 1,
        "SPL": 1,
        "STL": 1.2 / 3,
        "T_goal": 3,
        "T_stalled": 1,
        "V_mean": 0.75,
        "V_max": 1,
        "A_mean": 1 / 3,
        "A_max": 1,
        "J_mean": 0.5,
        "J_max": 1,
        "turning": 0,
    }
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, abs=1e-5), name
    assert math.isnan(values["C_min"])


def test_intrusions_are_counted_as_events():
    distances = [3, 1, 0.4, 1.5, 1.1, 1.1, 3, 1.19]
    values = measure(floor([(0, 0)] * 8, [(d, 0) for d in distances]), "field").values
    assert values["intrusions"] == 3
    assert values["Z_intimate"] == 1 / 8
    assert values["Z_personal"] == 4 / 8
    assert values["PSC"] == 7 / 8
    assert values["D_min"] == pytest.approx(0.4)


def test_a_detour_and_a_turn():
    robot = [(0, 0), (0, 1), (1, 1), (1, 0)]
    values = measure(floor(robot, [(9, 9)] * 4, [0, 1, -1, 3]), "field").values
    assert values["PL"] == pytest.approx(3)
    assert values["PE"] == pytest.approx(1 / 3)
    assert values["turning"] == pytest.approx(1 + 2 + (2 * math.pi - 4), abs=1e-5)
    assert (values["SPL"], values["STL"]) == (0, 0)
    assert math.isnan(values["T_goal"])


@pytest.mark.parametrize(
    ("offset", "velocity", "expected"),
    [
        ((5, 0), (-1, 0), 4.5),
        ((5, 0), (1, 0), math.inf),
        ((5, 0), (0, 0), math.inf),
        ((5, 0), (0, 1), math.inf),
        ((5, 0.5), (-1, 0), 5.0),  # just touches
        ((5, 0.51), (-1, 0), math.inf),
        ((0.3, 0), (1, 0), 0.0),
        ((0.5, 0), (1, 0), 0.0),
    ],
)
def test_time_to_collision(offset, velocity, expected):
    got = time_to_collision(np.array([offset], float), np.array([velocity], float), 0.5)
    assert got[0] == pytest.approx(expected, abs=1e-6)


@given(x=st.floats(-9, 9), z=st.floats(-9, 9), u=st.floats(-3, 3), v=st.floats(-3, 3), radius=st.floats(0.1, 1))
def test_at_the_time_of_collision_the_circles_touch(x, z, u, v, radius):
    offset, velocity = np.array([[x, z]]), np.array([[u, v]])
    time = time_to_collision(offset, velocity, radius)[0]
    if np.isfinite(time) and time > 0:
        assert np.linalg.norm(offset + velocity * time) == pytest.approx(radius, abs=1e-5)
        before = np.linspace(0, time * 0.999, 50)[:, None]
        assert np.linalg.norm(offset + velocity * before, axis=1).min() >= radius - 1e-6
    elif time == 0:
        assert np.linalg.norm(offset) <= radius + 1e-9


points = st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=2, max_size=20)


@given(points)
def test_bounds_and_zones(walk):
    values = measure(floor(walk, [(0, 0)] * len(walk)), "field").values
    ranges = {m.name: m.range for m in metrics_of("field")}
    for name, value in values.items():
        assert math.isnan(value) or ranges[name][0] <= value <= ranges[name][1], name
    assert sum(values[f"Z_{zone}"] for zone in ("intimate", "personal", "social", "public")) == pytest.approx(1)
    assert values["V_max"] >= values["V_mean"] - 1e-9


@given(points, points)
def test_lengths_of_joined_episodes_add_up(one, two):
    def length(walk):
        return measure(floor(walk, [(9, 9)] * len(walk)), "field").values["PL"]

    gap = math.dist(one[-1], two[0])
    assert length([*one, *two]) == pytest.approx(length(one) + gap + length(two), abs=1e-4)


@given(points, st.floats(-3, 3), st.floats(-5, 5))
def test_nothing_depends_on_where_the_home_stands(walk, turn, shift):
    distances = np.linalg.norm(np.array(walk), axis=1)
    for limit in (0.45, 1.0, 1.2, 3.6, 2.0, 0.5):
        assume(np.abs(distances - limit).min() > 1e-3)
    c, s = math.cos(turn), math.sin(turn)
    moved = [(c * x + s * z + shift, -s * x + c * z) for x, z in walk]
    heading = np.linspace(0, 1, len(walk))
    here = measure(floor(walk, [(0, 0)] * len(walk), heading), "field").values
    there = measure(floor(moved, [(shift, 0)] * len(walk), heading + turn), "field").values
    for name in set(here) - {"TTC_min", "T_stalled", "SPL", "STL", "T_goal"}:  # these sit on thresholds
        assert there[name] == pytest.approx(here[name], abs=1e-2, rel=1e-4, nan_ok=True), name


def test_a_robot_that_never_moves_has_no_efficiency():
    result = measure(floor([(0, 0)] * 4, [(3, 0)] * 4), "field")
    assert result.values["PL"] == 0
    assert math.isnan(result.values["PE"])
    assert "did not move" in result.notes["PE"]
    assert result.values["T_stalled"] == 3
    already = measure(floor([(0, 0)] * 4, [(1.5, 0)] * 4), "field")
    assert (already.values["SPL"], already.values["STL"], already.values["T_goal"]) == (1, 1, 0)


def test_gaps_short_and_empty_recordings():
    gone = measure(floor([(0, 0), (np.nan, 0), (1, 0), (2, 0)], [(9, 0)] * 4), "field")
    assert gone.values["PL"] == pytest.approx(1), "nobody knows the way through the gap"
    assert gone.values["V_mean"] == pytest.approx(1)
    assert gone.values["D_min"] == pytest.approx(7)
    one = measure(floor([(0, 0)], [(9, 0)]), "field")
    assert one.values["PL"] == 0
    assert math.isnan(one.values["V_mean"])
    empty = measure(floor([], []), "field")
    assert all(math.isnan(v) for v in empty.values.values())
    assert set(empty.notes) == set(empty.values)
    nowhere = measure(floor([(np.nan, 0)] * 3, [(9, 0)] * 3), "field")
    assert all(math.isnan(v) for v in nowhere.values.values())


def test_clearance_needs_its_column():
    class Wall:
        def signed_distance(self, points):
            return points[:, 0] - 1.0

    recording = floor([(2, 0), (1.5, 0), (0.5, 0)], [(9, 0)] * 3)
    assert "needs metrics.robot_clearance" in measure(recording, "field").notes["C_min"]
    values = measure(with_clearance(recording, Wall()), "field").values
    assert values["C_min"] == 0
    assert values["C_mean"] == pytest.approx(0.5)


def test_undefined_values_say_why_in_every_metric():
    result = measure(floor([(0, 0)], [(9, 0)]), "field")
    assert {n for n, v in result.values.items() if math.isnan(v)} <= set(result.notes)


def test_series_have_a_row_each():
    recording = floor([(0, 0)] * 7, [(3, 0)] * 7)
    assert {len(v) for v in series_of(recording, "field").values()} == {7}
    named = {name for m in metrics_of("field") for name in m.series} - {"clearance_m"}
    assert named <= set(series_of(recording, "field"))


def among(robot, *people, info=None, task="social_nav", **columns) -> Recording:
    """A robot among people, positions (x, z), one row a second."""
    alone = floor(robot, people[0], **columns)
    poses = {f"agent_{n}.base_pose": floor(robot, at).columns["agent_1.base_pose"] for n, at in enumerate(people, 1)}
    return replace(
        alone,
        episode=replace(alone.episode, task=task, info=info or {}),
        agents=(alone.agents[0], *(Agent(name=f"human_{n}", kind="human") for n in range(len(people)))),
        columns={**alone.columns, **poses},
    )


def test_everybody_counts_by_hand():
    # Fifteen rows: the first person is never nearer than 2.44 m, the last stands 0.73 m away in two rows.
    robot, apart = np.zeros((15, 2)), lambda d: np.stack([np.full(15, d), np.zeros(15)], 1)
    passing = apart(5.0)
    passing[[4, 9], 0] = 0.73
    people = (apart(2.44), apart(-3.0), apart(4.0), passing)
    measured = measure(among(robot, *people), "field")
    assert measured.values["PSC"] == pytest.approx(13 / 15, abs=1e-6)
    assert measured.values["D_min"] == pytest.approx(0.73, abs=1e-6)
    assert measured.values["Z_personal"] == pytest.approx(2 / 15, abs=1e-6)
    assert measured.values["Z_social"] == pytest.approx(13 / 15, abs=1e-6)
    assert measured.values["intrusions"] == 2
    assert measured.values["TTC_min"] == pytest.approx((0.73 - 0.5) / (5 - 0.73), abs=1e-6)
    assert measured.human == 4, "the one whom it comes nearest"
    assert [m.id for m in metrics_of("field") if m.name == "PSC"] == ["field/proxemics/PSC@2"]


crowds = st.lists(
    st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=6, max_size=6), min_size=1, max_size=4
)


@given(crowds, st.randoms(use_true_random=False))
def test_the_order_of_people_and_those_far_away_change_nothing(people, random):
    robot = [(0.1 * k, 0) for k in range(6)]
    shuffled = random.sample(people, len(people))
    away = [(1e4 + k, 0) for k in range(6)]
    info = {"goal": [0.5, 0.0]}
    here = measure(among(robot, *people, info=info), "field").values
    for other in (shuffled, [*people, away], [away, *people]):
        there = measure(among(robot, *other, info=info), "field").values
        np.testing.assert_equal({**there, "TTC_min": 0}, {**here, "TTC_min": 0})
        # somebody far away may be on a collision course, hours ahead
        assert there["TTC_min"] == here["TTC_min"] or there["TTC_min"] > 1e3 or math.isnan(here["TTC_min"])


def test_the_goal_is_the_episodes():
    robot, person = [(k, 0) for k in range(5)], [(9, 9)] * 5
    reached = np.arange(5) == 3
    point = among(robot, person, person, info={"goal": [3.0, 0.0]}, task="go", **{"metrics.success": reached})
    measured = measure(point, "field")
    assert (measured.values["SPL"], measured.values["T_goal"]) == (1, 3)
    assert measured.values["STL"] == pytest.approx(3 / 2.5 / 3)
    assert dict(measured.moments) == {"goal": 3}
    assert "no column metrics.goal_distance" in measured.notes["SPL"]
    length = np.array([6, 5, 4, 0, 1], np.float32)
    longer = replace(point, columns={**point.columns, "metrics.goal_distance": length})
    assert measure(longer, "field").values["SPL"] == 1, "shorter than the shortest path is as good"
    assert measure(longer, "field").values["STL"] == pytest.approx(6 / 2.5 / 3)
    near = among(robot, person, info={"extra": {"goal": [2.3, 0, 0.4]}}, task="go")
    measured = measure(near, "field")
    assert (measured.values["T_goal"], measured.values["SPL"]) == (2, 1)
    assert "reached from 0.5 m" in measured.notes["T_goal"]
    two = ([(9, 9)] * 5, [(4, 0)] * 5)
    for goal in (2, "human_1"):
        assert measure(among(robot, *two, info={"goal": goal}), "field").values["T_goal"] == 2
    for info, task, says in (
        ({}, "social_nav", "several people (2)"),
        ({}, "go", "undefined in the task 'go'"),
        ({"goal": "sofa"}, "go", "it is 'sofa'"),
        ({"goal": 0}, "go", "another agent; it is 0"),
        ({"goal": [1.0, math.nan]}, "go", "must be [x, z]"),
        ({"goal": True}, "go", "it is True"),
    ):
        measured = measure(among(robot, *two, info=info, task=task), "field")
        for name in GOAL:
            assert np.isnan(measured.values[name]), name
            assert says in measured.notes[name], name
        assert measured.values["PL"] == 4
        assert not field_series(among(robot, *two, info=info, task=task))["goal"].any()
