"""Propositions over recordings: predicates by hand, dependencies against a slow reference, constraints, hostile input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import to_builtins

from h3data.errors import InputError
from h3data.metrics import measure, series_of
from h3data.recording import Agent, Episode, Event, Recording
from h3data_language.evaluation.engine import _asked, _relation, evaluate, rows_of
from h3data_language.evaluation.layout import FurnitureBox, Layout, Surface, ThingBox
from h3data_language.evaluation.predicates import Rows, truth_of
from h3data_language.evaluation.records import (
    CONSTRAINTS,
    DEPENDENCIES,
    PROPOSITIONS,
    Dependency,
    Evaluation,
    Proposition,
)

LAYOUT = Layout(
    things={name: ThingBox(k, (0, 0.05, 0), (0.04, 0.05, 0.04)) for k, name in enumerate(("mug_0", "mug_1", "can_0"))},
    furniture={
        "table_0": FurnitureBox((0, 0.4, 0), (0.5, 0.4, 0.5), (Surface((0, 0.8, 0), (0.5, 0.5), 0.0, 1.0),)),
        "shelf_0": FurnitureBox((3, 0.5, 0), (0.5, 0.5, 0.2), (Surface((3, 1.0, 0), (0.5, 0.2), np.pi / 2, 1.0),)),
        "fridge_0": FurnitureBox((6, 1, 0), (0.3, 1, 0.3), (Surface((6, 1.0, 0), (0.3, 0.3), 0.0, 0.3, True),)),
    },
    rooms={"kitchen_0": ((-2, -2, 2, 2),), "hall_0": ((2, -2, 8, 2),)},
)
PLACES = {
    "table": (0.0, 0.8, 0.0),
    "table's edge": (0.45, 0.8, 0.0),
    "shelf": (3.0, 1.0, 0.3),
    "fridge": (6.0, 1.0, 0.0),
    "floor": (1.0, 0.0, 1.0),
    "air": (1.0, 1.3, 1.0),
    "above the table": (0.0, 1.5, 0.0),
}
EVERYWHERE = ("table_0", "shelf_0", "fridge_0")


def told(*propositions: Any, dependencies: Any = (), constraints: Any = (), bugs: bool = False) -> Evaluation:
    return Evaluation.of(
        {
            "evaluation_propositions": [{"function_name": name, "args": args} for name, args in propositions],
            "evaluation_proposition_dependencies": list(dependencies),
            "evaluation_constraints": list(constraints),
        },
        bugs=bugs,
    )


def on(things: Any, where: Any = ("table_0",), number: int = 1, name: str = "is_on_top", **more: Any) -> Any:
    return name, {"object_handles": list(things), "receptacle_handles": list(where), "number": number, **more}


def rows(*places: tuple[str, str, str], held: Any = None, bugs: bool = False, **states: Any) -> Rows:
    poses = np.zeros((len(places), 3, 7), np.float32)
    poses[..., 6] = 1
    poses[..., :3] = [[PLACES[p] for p in row] for row in places]
    held = np.zeros((len(places), 3), np.bool_) if held is None else np.array(held, np.bool_)
    return Rows(LAYOUT, poses, held, {name: np.array(s, np.bool_) for name, s in states.items()}, bugs)


def terminal(*indices: int) -> Any:
    return {"type": "TerminalSatisfactionConstraint", "args": {"proposition_indices": list(indices)}}


def order(*edges: tuple[int, int]) -> Any:
    return {"type": "TemporalConstraint", "args": {"dag_edges": [list(e) for e in edges]}}


def test_things_are_on_furniture_inside_it_in_rooms_and_on_the_floor() -> None:
    at = rows(("table", "shelf", "fridge"), ("air", "above the table", "floor"))
    where = {
        name: [
            [truth_of(Proposition(name, {"object_handles": [thing], key: [place]}), at)[0].tolist() for place in places]
            for thing in LAYOUT.things
        ]
        for name, key, places in (
            ("is_on_top", "receptacle_handles", EVERYWHERE),
            ("is_inside", "receptacle_handles", EVERYWHERE),
            ("is_in_room", "room_ids", ("kitchen_0", "hall_0")),
        )
    }
    yes, no = [True, False], [False, False]
    assert where["is_on_top"] == [[yes, no, no], [no, yes, no], [no, no, no]]  # the shelf is turned: z is its long side
    assert where["is_inside"] == [[no, no, no], [no, no, no], [no, no, yes]]
    assert where["is_in_room"] == [[[True, True], no], [[False, True], yes], [[False, True], yes]]
    floor = [truth_of(Proposition("is_on_floor", {"object_handles": [t]}), at)[0].tolist() for t in LAYOUT.things]
    assert floor == [no, no, [False, True]]


def test_nothing_is_at_a_place_while_somebody_holds_it_except_for_partnr() -> None:
    p = Proposition(*on(["mug_0"]))
    held = [[True, False, False], [False] * 3]
    places = (("above the table", "shelf", "shelf"), ("table", "shelf", "shelf"))
    assert truth_of(p, rows(*places, held=held))[0].tolist() == [False, True]
    assert truth_of(p, rows(*places, held=held, bugs=True))[0].tolist() == [True, True]


def test_counts_are_of_things_and_partnr_counts_pairs() -> None:
    p = Proposition(*on(["mug_0", "mug_1"], EVERYWHERE, 2))
    same = Proposition(*on(["mug_0", "mug_1"], EVERYWHERE, 2, is_same_receptacle=True))
    at = rows(("table", "air", "air"), ("table", "shelf", "air"), ("table", "table's edge", "air"))
    assert truth_of(p, at)[0].tolist() == [False, True, True]
    assert truth_of(same, at)[0].tolist() == [False, False, True]
    twice = Proposition(*on(["mug_0", "mug_1"], ["table_0", "table_0"], 2))
    assert truth_of(twice, rows(("table", "air", "air")))[0].tolist() == [False]
    assert truth_of(twice, rows(("table", "air", "air"), bugs=True))[0].tolist() == [True]


def test_next_to_and_clusters_are_distances_between_boxes() -> None:
    near = Proposition("is_next_to", {"entity_handles_a": ["mug_0"], "entity_handles_b": ["mug_1", "shelf_0"]})
    at = rows(("table", "table's edge", "air"), ("table", "shelf", "air"), ("shelf", "air", "air"))
    assert truth_of(near, at)[0].tolist() == [True, False, True]
    close = Proposition("is_next_to", {**near.args, "l2_threshold": 0.1})
    assert truth_of(close, at)[0].tolist() == [False, False, True]
    three = Proposition("is_clustered", {"*args": [["mug_0", "mug_1"], ["can_0"]], "number": [2, 1]})
    row = rows(("table", "table's edge", "table"), ("table", "table", "shelf"))
    assert truth_of(three, row)[0].tolist() == [True, False]


def test_states_are_columns_and_false_without() -> None:
    clean = Proposition("is_clean", {"object_handles": ["mug_0"]})
    dirty = Proposition("is_dirty", {"object_handles": ["mug_0"]})
    at = rows(*[("table",) * 3] * 2, clean=[[0, 0, 0], [1, 0, 0]])
    assert truth_of(clean, at)[0].tolist() == [False, True]
    assert truth_of(dirty, at)[0].tolist() == [True, False]
    assert truth_of(clean, rows(("table",) * 3))[0].tolist() == [False]


def test_a_count_is_unrolled_and_counts_towards_the_share() -> None:
    two = told(on(["mug_0", "mug_1"], number=2), constraints=[terminal(0)])
    assert [p.number for p in two.propositions] == [2, 1]
    verdict = evaluate(two, rows(("table", "shelf", "air")))
    assert verdict.percent_complete == 0.5
    assert "is on top (2 of mug_0, mug_1; table_0) was never satisfied" in verdict.explanation


def test_partnr_renumbers_dependencies_by_its_loop_counter() -> None:
    listed = (on(["can_0"]), on(["mug_0", "mug_1"], number=2))
    after = {"proposition_indices": [1], "depends_on": [0], "relation_type": "after_satisfied"}
    assert told(*listed, dependencies=[after]).dependencies[0].proposition_indices == [1, 2]
    assert told(*listed, dependencies=[after], bugs=True).dependencies[0].proposition_indices == [1, 1]
    # the wrong number is that of another proposition, whose copies then depend on it too
    after = {**after, "proposition_indices": [0], "depends_on": [2]}
    listed = (on(["mug_0", "mug_1"], number=2), on(["mug_1", "can_0"], number=2), on(["can_0"]))
    assert told(*listed, dependencies=[after]).dependencies[0].proposition_indices == [0, 3]
    assert told(*listed, dependencies=[after], bugs=True).dependencies[0].proposition_indices == [0, 1, 1]


def test_what_depends_on_a_count_depends_on_all_of_it() -> None:
    listed = (on(["mug_0", "mug_1"], number=2), on(["can_0"]))
    before = {"proposition_indices": [1], "depends_on": [0], "relation_type": "before_satisfied"}
    assert told(*listed, dependencies=[before]).dependencies[0].depends_on == [0]
    one_mug_first = rows(("table", "air", "air"), ("table", "air", "table"))
    assert evaluate(told(*listed, dependencies=[before]), one_mug_first).satisfied_at.tolist() == [-1, 1, 0]


def test_after_something_became_false_also_means_when_it_is_true_again() -> None:
    listed = (on(["mug_0"]), on(["can_0"]))
    after = {"proposition_indices": [1], "depends_on": [0], "relation_type": "after_unsatisfied"}
    at = rows(*[(mug, "air", can) for mug, can in (("table", "table"), ("air", "table"), ("table", "table"))])
    assert evaluate(told(*listed, dependencies=[after]), at).satisfied_at.tolist() == [0, 2]


def test_an_order_voids_what_came_too_early_also_in_the_same_row() -> None:
    listed = (on(["mug_0"]), on(["mug_1"]), on(["can_0"]))
    chain = told(*listed, constraints=[order((0, 1), (1, 2))])
    one_by_one = rows(("table", "air", "air"), ("table", "table", "air"), ("table",) * 3)
    assert evaluate(chain, one_by_one).percent_complete == 1
    at_once = rows(("table", "table", "air"), ("table",) * 3)
    assert evaluate(chain, at_once).complete.tolist() == [True, False, True]
    never = rows(("air", "table", "air"), ("air", "table", "table"))
    assert evaluate(chain, never).complete.tolist() == [False, False, False]


def test_what_has_to_stay_must_be_there_at_the_end() -> None:
    moved = rows(("table", "air", "air"), ("shelf", "air", "air"))
    verdict = evaluate(told(on(["mug_0"]), constraints=[terminal(0)]), moved)
    assert verdict.satisfied_at.tolist() == [0]
    assert verdict.percent_complete == 0
    assert "not any more at the end" in verdict.explanation


def arguments(kind: str, *indices: int, name: str = "receptacle_handles") -> Any:
    return {
        "type": f"{kind}ArgConstraint",
        "args": {"proposition_indices": list(indices), "arg_names": [name] * len(indices)},
    }


def test_the_first_to_come_true_decides_which_arguments_are_the_same_or_different() -> None:
    listed = (on(["mug_0"], EVERYWHERE), on(["mug_1"], EVERYWHERE))
    for kind, place, whole in (("Same", "table", True), ("Same", "shelf", False), ("Different", "table", False)):
        asked = told(*listed, constraints=[arguments(kind, 0, 1)])
        assert evaluate(asked, rows(("table", "air", "air"), ("table", place, "air"))).complete.tolist() == [
            True,
            whole,
        ]
        assert evaluate(asked, rows(("air", place, "air"), ("table", place, "air"))).complete.tolist() == [whole, True]


def test_counts_of_one_proposition_need_not_differ_among_themselves() -> None:
    asked = told(
        on(["mug_0", "mug_1"], EVERYWHERE, 2), on(["can_0"], EVERYWHERE), constraints=[arguments("Different", 0, 1)]
    )
    apart = rows(("table", "air", "air"), ("table", "table", "air"), ("table", "table", "shelf"))
    assert evaluate(asked, apart).percent_complete == 1
    together = rows(("table", "air", "air"), ("table", "table", "air"), ("table", "table", "table"))
    assert evaluate(asked, together).complete.tolist() == [True, False, True]


def test_partnr_compares_handles_by_their_letters() -> None:
    asked = [on(["mug_0"], EVERYWHERE), on(["mug_1"], EVERYWHERE)]
    at = rows(("table", "air", "air"), ("table", "shelf", "air"))
    for kind, right, theirs in (("Same", False, True), ("Different", True, False)):
        for bugs, whole in ((False, right), (True, theirs)):
            evaluation = told(*asked, constraints=[arguments(kind, 0, 1)], bugs=bugs)
            verdict = evaluate(evaluation, Rows(at.layout, at.poses, at.held, {}, bugs))
            assert verdict.complete.tolist() == [True, whole]


def test_arguments_of_clusters_are_their_members() -> None:
    close = ("is_clustered", {"*args": [["mug_0", "mug_1"], ["can_0"]], "number": [1, 1]})
    names = {"proposition_indices": [0, 1], "arg_names": ["*args_0", "object_handles"]}
    asked = told(close, on(["mug_0", "mug_1"]), constraints=[{"type": "SameArgConstraint", "args": names}])
    assert evaluate(asked, rows(("air", "shelf", "shelf"), ("table", "shelf", "shelf"))).complete.tolist() == [
        True,
        False,
    ]
    assert evaluate(asked, rows(("air", "shelf", "shelf"), ("air", "table", "table"))).complete.tolist() == [True, True]


def test_nothing_is_next_to_itself_except_for_partnr() -> None:
    alone = Proposition("is_next_to", {"entity_handles_a": ["mug_0"], "entity_handles_b": ["mug_0"]})
    assert truth_of(alone, rows(("table", "air", "air")))[0].tolist() == [False]
    assert truth_of(alone, rows(("table", "air", "air"), bugs=True))[0].tolist() == [True]


def test_a_thing_may_have_to_move_twice() -> None:
    """The example of dependencies: after the mug was on the table, it has to be on the shelf."""
    listed = (on(["mug_0"]), on(["mug_0"], ["shelf_0"]))
    after = {"proposition_indices": [1], "depends_on": [0], "relation_type": "after_satisfied"}
    at = rows(*[(p, "air", "air") for p in ("shelf", "air", "table", "air", "air", "shelf")])
    assert evaluate(told(*listed), at).satisfied_at.tolist() == [2, 0]
    assert evaluate(told(*listed, dependencies=[after]), at).satisfied_at.tolist() == [2, 5]


RELATIONS = ("while_satisfied", "after_satisfied", "after_unsatisfied", "before_satisfied")


@given(st.data())
def test_dependencies_are_those_of_a_loop_over_rows(data: st.DataObject) -> None:
    count, steps = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 8))
    truth = np.array(data.draw(st.lists(st.booleans(), min_size=count * steps, max_size=count * steps)))
    truth = truth.reshape(steps, count)
    indices = st.lists(st.integers(0, count - 1), min_size=1, max_size=2)
    needs = [
        Dependency(data.draw(indices), data.draw(indices), data.draw(st.sampled_from(RELATIONS)), mode)
        for mode in data.draw(st.lists(st.sampled_from(("all", "any")), max_size=3))
    ]
    slow = np.zeros_like(truth)
    for t in range(steps):
        for k in range(count):
            asked = [_relation(d, slow[:t])[-1] for d in needs if k in d.proposition_indices]
            slow[t, k] = truth[t, k] and all(asked)
    evaluation = Evaluation(tuple(Proposition(*on(["mug_0"])) for _ in range(count)), tuple(needs))
    assert (_asked(evaluation, truth) == slow).all()


@pytest.mark.parametrize(
    ("info", "words"),
    [
        ({"evaluation_propositions": "many"}, "H3-LANGUAGE-006"),
        (
            {"evaluation_propositions": [{"function_name": "is_tasty"}]},
            "(?s)Unknown proposition 'is_tasty'.*H3-LANGUAGE-007",
        ),
        ({"evaluation_propositions": [{"function_name": "is_clean"}]}, "(?s)object_handles.*H3-LANGUAGE-006"),
        (
            {"evaluation_propositions": [{"function_name": "is_clean", "args": {"object_handles": "mug"}}]},
            "(?s)a list.*H3-LANGUAGE-006",
        ),
        (
            {
                "evaluation_propositions": [
                    {"function_name": "is_clean", "args": {"object_handles": ["a"], "number": 2}}
                ]
            },
            "(?s)asks for 2 of 1.*H3-LANGUAGE-006",
        ),
    ],
)
def test_malformed_propositions_are_refused(info: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        Evaluation.of(info)
    assert refused.value.code.startswith("H3-LANGUAGE-")


@pytest.mark.parametrize(
    "constraints",
    [
        [order((0, 1), (1, 0))],
        [order((0, 0))],
        [terminal(7)],
        [{"type": "TemporalConstraint", "args": {"dag_edges": 3}}],
        [arguments("Same", 0, 1, name="room_ids")],
    ],
)
def test_an_order_in_a_circle_and_propositions_that_do_not_exist_are_refused(constraints: Any) -> None:
    with pytest.raises(InputError) as refused:
        told(on(["mug_0"]), on(["mug_1"]), constraints=constraints)
    assert refused.value.code.startswith("H3-LANGUAGE-")


@pytest.mark.parametrize(
    "asked", [on(["spoon_0"]), on(["mug_0"], ["tabel_0"]), ("is_on_floor", {"object_handles": ["?"]})]
)
def test_names_that_are_not_in_the_home_are_refused(asked: Any) -> None:
    with pytest.raises(InputError, match="H3-LANGUAGE-004") as refused:
        evaluate(told(asked), rows(("table",) * 3))
    assert refused.value.code.startswith("H3-LANGUAGE-")


def json_of(evaluation: Evaluation) -> dict[str, Any]:
    parts = (evaluation.propositions, evaluation.dependencies, evaluation.constraints)
    return dict(zip((PROPOSITIONS, DEPENDENCIES, CONSTRAINTS), map(to_builtins, parts), strict=True))


def recording(evaluation: Evaluation, at: Rows, events: Any = (), **info: Any) -> Recording:
    steps, columns = len(at.poses), {}
    for k in range(2):
        columns[f"agent_{k}.base_pose"] = np.zeros((steps, 7), np.float32)
        held = at.held[:, 0] if k else np.zeros(steps, np.bool_)
        columns[f"agent_{k}.grasp_body"] = np.where(held, 0, -1).astype(np.int32)
    from h3data.recording import AssetRef, Body

    return Recording(
        episode=Episode(
            uid="u",
            episode_id="e",
            task="language",
            scene="s",
            info={**json_of(evaluation), "evaluation_layout": to_builtins(LAYOUT), **info},
        ),
        assets=(AssetRef(name="mug", uri="primitive:box"),),
        bodies=tuple(
            Body(name=name, asset="mug", pose=at.poses[0, k], moving=k) for k, name in enumerate(LAYOUT.things)
        ),
        agents=(Agent(name="robot", kind="robot"), Agent(name="person", kind="human")),
        columns={"time_ns": np.arange(steps, dtype=np.int64) * 33_333_333, "object_pose": at.poses, **columns},
        events=tuple(events),
    )


def test_the_profile_evaluates_propositions_and_says_who_helped() -> None:
    asked = told(on(["mug_0"]), on(["mug_1"]), constraints=[terminal(0, 1)])
    held = [[True, False, False], [False] * 3, [False] * 3]
    at = rows(("above the table", "air", "air"), ("table", "air", "air"), ("table", "table", "air"), held=held)
    events = [
        Event(step=0, agent=1, kind="pick", target="mug_0"),
        Event(step=1, agent=1, kind="place", target="mug_0"),
        Event(step=2, agent=0, kind="place", target="mug_1"),
        Event(step=2, agent=1, kind="place", target="can_0"),
    ]
    one = recording(asked, at, events)
    values = measure(one, "partnr").values
    assert values == {
        "PC": 1,
        "state_success": 1,
        "steps": 3,
        "exploration": 0,
        "offloading": 0.5,
        "extraneous_effort": pytest.approx(1 / 3),
    }
    assert series_of(one, "partnr")["satisfied_share"].tolist() == [0, 0.5, 1]
    assert measure(one, "partnr@habitat").values["PC"] == 1
    assert series_of(one, "partnr@habitat")["satisfied_share"].tolist() == [0.5, 0.5, 1]


def test_a_recording_without_what_propositions_need_is_refused() -> None:
    asked = told(on(["mug_0"]))
    one = recording(asked, rows(("table",) * 3))
    for columns in ({"object_pose": None}, {"object_state.clean": np.zeros((1, 9), np.bool_)}):
        changed = {k: v for k, v in {**one.columns, **columns}.items() if v is not None}
        fake = type("Fake", (), {"columns": changed, "agents": one.agents, "episode": one.episode})
        with pytest.raises(InputError, match=r"H3-LANGUAGE-00[12]"):
            rows_of(fake, LAYOUT)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"(?s)evaluation_layout.*H3-LANGUAGE-005"):
        measure(recording(asked, rows(("table",) * 3), evaluation_layout={"things": 3}), "partnr")
