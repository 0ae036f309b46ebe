"""Orders, session manifests, anonymous ids, simulated studies and their power."""

from __future__ import annotations

import itertools
import runpy
import sys
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError
from h3data.metrics import anonymous_id
from h3data_studies.analysis import (
    latin_square,
    plan_sessions,
    read_session,
    simulate_power,
    simulate_study,
    study_rows,
    write_sessions,
)
from tests.paths import EXAMPLES

CONDITIONS = ["solo", "learn_single", "plan_pop3"]
EPISODES = {f"s{k}": [f"s{k}-{j}" for j in range(40)] for k in range(10)}


@given(st.integers(2, 9))
def test_orders_balance_positions_and_neighbours(count):
    conditions = [str(k) for k in range(count)]
    orders = latin_square(conditions)
    assert len(orders) == (2 * count if count % 2 else count)
    assert len(set(orders)) == len(orders)
    for position in range(count):
        assert set(Counter(o[position] for o in orders).values()) == {len(orders) // count}
    neighbours = Counter(pair for o in orders for pair in itertools.pairwise(o))
    assert len(neighbours) == count * (count - 1)
    assert len(set(neighbours.values())) == 1


def test_the_paper_s_study():
    sessions = plan_sessions(30, CONDITIONS, EPISODES)
    rows = study_rows(sessions)
    assert len(rows["participant"]) == 900
    assert set(Counter(zip(rows["participant"], rows["condition"], strict=True)).values()) == {10}
    assert set(Counter(zip(rows["condition"], rows["scene"], strict=True)).values()) == {30}
    orders = Counter(tuple(b.condition for b in s.blocks) for s in sessions)
    assert sorted(orders.values()) == [5] * 6
    assert rows["trial"][:11] == list(range(1, 12))
    assert rows["block"][29] == 3
    assert all(len({b.scene for b in s.blocks}) == 3 for s in sessions)


@given(st.integers(1, 12), st.integers(2, 4), st.integers(1, 5), st.integers(0, 99))
def test_nobody_sees_an_episode_twice(people, conditions, scenes, seed):
    episodes = {f"s{k}": [f"s{k}-{j}" for j in range(2 * conditions + 1)] for k in range(scenes)}
    names = [f"c{k}" for k in range(conditions)]
    sessions = plan_sessions(people, names, episodes, episodes_per_condition=2, seed=seed)
    for s in sessions:
        seen = [*s.training, *(e for b in s.blocks for e in b.episodes)]
        assert len(set(seen)) == len(seen) == 2 * conditions + 1
        assert sorted(b.condition for b in s.blocks) == names
        assert all(e in episodes[b.scene] for b in s.blocks for e in b.episodes)
        assert all(e in episodes[s.blocks[0].scene] for e in s.training)
    assert sessions == plan_sessions(people, names, episodes, episodes_per_condition=2, seed=seed)


def test_every_order_meets_every_scene():
    sessions = plan_sessions(6 * 4, CONDITIONS, {k: EPISODES[k] for k in ("s0", "s1", "s2", "s3")})
    met = Counter((tuple(b.condition for b in s.blocks), s.blocks[0].scene) for s in sessions)
    assert len(met) == 24


def test_manifests_are_read_back(tmp_path):
    sessions = plan_sessions(3, CONDITIONS, EPISODES, study="kitchen")
    paths = write_sessions(sessions, tmp_path)
    assert [p.name for p in paths] == ["P01.json", "P02.json", "P03.json"]
    assert tuple(read_session(p) for p in paths) == sessions
    assert '"format": "h3data/session@1"' in paths[0].read_text()


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"study": "x"}', '{"format": "h3data/session@9"}', "\x00\x01"], ids=range(5)
)
def test_other_files_are_no_manifests(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_text(content)
    with pytest.raises(FormatError, match="H3-METRIC-040"):
        read_session(path)
    with pytest.raises(InputError, match=r"(?s)No such.*H3-METRIC-039"):
        read_session(tmp_path / "nothing.json")


def test_plans_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"(?s)'s0'.*H3-METRIC-037"):
        plan_sessions(3, CONDITIONS, {"s0": EPISODES["s0"][:30]})
    with pytest.raises(InputError, match="H3-METRIC-033"):
        plan_sessions(3, ["a", "a"], EPISODES)
    with pytest.raises(InputError, match="H3-METRIC-033"):
        latin_square(["a"])
    with pytest.raises(InputError, match="H3-METRIC-034"):
        plan_sessions(["ann", "ann"], CONDITIONS, EPISODES)
    with pytest.raises(InputError, match="H3-METRIC-034"):
        plan_sessions(0, CONDITIONS, EPISODES)
    with pytest.raises(InputError, match="H3-METRIC-038"):
        plan_sessions(2, CONDITIONS, {"s": ["e"] * 40})
    with pytest.raises(InputError, match="H3-METRIC-035"):
        plan_sessions(2, CONDITIONS, {})
    with pytest.raises(InputError, match="H3-METRIC-036"):
        write_sessions(plan_sessions(["../ann"], CONDITIONS, EPISODES), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_anonymous_ids():
    key = bytes(range(32))
    one = anonymous_id("Ann@Example.org", key=key)
    assert one == anonymous_id("  ann@example.ORG ", key=key)
    assert one == anonymous_id("ａnn@example.org", key=key)
    assert one != anonymous_id("ann@example.org", key=bytes(32))
    assert len({anonymous_id(f"person {k}", key=key) for k in range(2000)}) == 2000
    assert one[:2] == "P-"
    assert len(one) == 12
    assert one[2:].isalnum()
    with pytest.raises(InputError, match=r"(?s)16.*3.*H3-FILE-017"):
        anonymous_id("ann", key=b"abc")
    with pytest.raises(InputError, match="H3-FILE-018"):
        anonymous_id("  ", key=key)


def test_simulated_studies_have_the_moments_they_were_asked_for():
    sessions = plan_sessions(200, CONDITIONS, EPISODES)
    means = {"solo": 400.0, "learn_single": 300.0, "plan_pop3": 320.0}
    table = simulate_study(sessions, means, "poisson", deviations={"participant": 0.3, "observation": 0.2}, seed=3)
    log = np.log(np.maximum(table["response"], 1))
    for condition, mean in means.items():
        rows = table["condition"] == condition
        assert log[rows].mean() == pytest.approx(np.log(mean), abs=0.06)
        assert log[rows].std() == pytest.approx(np.sqrt(0.3**2 + 0.2**2 + 1 / mean), rel=0.1)
    people = np.array([log[table["participant"] == p].mean() for p in np.unique(table["participant"])])
    assert people.std() == pytest.approx(0.3, rel=0.15)
    hits = simulate_study(sessions, dict.fromkeys(CONDITIONS, 0.2), "binomial", deviations={}, seed=1)
    assert hits["response"].mean() == pytest.approx(0.2, abs=0.02)
    assert set(hits["response"].tolist()) == {0, 1}


@pytest.mark.slow
def test_power_is_high_for_large_and_small_for_no_differences():
    sessions = plan_sessions(12, CONDITIONS, EPISODES, episodes_per_condition=4)
    means = {"solo": 40.0, "learn_single": 40.0, "plan_pop3": 80.0}
    rows = simulate_power(
        sessions, means, "poisson", deviations={"participant": 0.2, "scene": 0.1, "observation": 0.1}, runs=3, seed=1
    )
    power = {(p.first, p.second): p for p in rows}
    assert power["learn_single", "plan_pop3"].power == power["plan_pop3", "solo"].power == 1
    none = power["learn_single", "solo"]
    assert none.power < 1
    assert none.low <= none.power <= none.high
    assert none.failed == 0


def test_failed_fits_are_counted():
    sessions = plan_sessions(4, ["a", "b"], EPISODES, episodes_per_condition=2)
    rows = simulate_power(sessions, {"a": 1e-6, "b": 0.5}, "binomial", deviations={"participant": 0.5}, runs=3)
    assert [(p.power, p.failed, p.runs) for p in rows] == [(0.0, 3, 3)]


def test_simulations_refuse_nonsense():
    sessions = plan_sessions(4, ["a", "b"], EPISODES)
    with pytest.raises(InputError, match=r"(?s)b\).*H3-METRIC-042"):
        simulate_study(sessions, {"a": 3.0}, "poisson", deviations={})
    with pytest.raises(InputError, match=r"(?s)0.*1.*H3-METRIC-043"):
        simulate_study(sessions, {"a": 0.5, "b": 1.0}, "binomial", deviations={})
    with pytest.raises(InputError, match="H3-METRIC-041"):
        simulate_study(sessions, {"a": 0.5, "b": 0.5}, "binomial", deviations={"scene": -1})
    with pytest.raises(InputError, match="H3-METRIC-044"):
        simulate_power(sessions, {"a": 0.5, "b": 0.5}, "binomial", deviations={}, runs=0)


def test_the_example_runs_as_printed(tmp_path, monkeypatch, capsys):
    script = EXAMPLES / "user_study.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "means.png")])
    runpy.run_path(str(script))
    assert "RE learn_single: 134.1%" in capsys.readouterr().out
    assert (tmp_path / "means.png").stat().st_size > 2000
