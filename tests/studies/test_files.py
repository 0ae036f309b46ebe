"""Study files: what is accepted, and what the errors say."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import h3data_studies as package
from h3data.errors import InputError
from h3data.recording import read_mcap
from h3data_play.live import EpisodeFactory
from h3data_play.plan import GameOrder, PlayPlan
from h3data_studies.files import make_plan, read_design, study_folder
from h3data_studies.forms import BUILTIN, checked_answers, forms_after, resolved, score
from sim_kinematic.tasks.registry import find_task
from tests.paths import ROOT
from tests.studies.tiny import TINY, tiny, write_tiny

WEIGHTS = ROOT / "datasets" / "policies" / "learned_follower.npz"


def test_the_example_is_a_study_and_its_comments_name_the_defaults(tmp_path: Path) -> None:
    text = (Path(package.__path__[0]) / "example.toml").read_text()
    path = tmp_path / "study.toml"
    path.write_text(text)
    design = read_design(path)
    assert design.participants == 30
    assert [c.name for c in design.conditions] == ["solo", "complement", "same_object"]
    settings = (
        "attempts",
        "skip",
        "max_ping_ms",
        "min_width",
        "min_fps",
        "touch",
        "idle_minutes",
        "total_minutes",
        "max_slip",
    )
    for name in settings:
        text = text.replace(f"# {name} = ", f"{name} = ", 1)
    for section in ("device", "dropout"):
        text = text.replace(f"# [{section}]", f"[{section}]")
    path.write_text(text)
    assert read_design(path) == design


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"participant": 3}, r"(?s)Unknown setting 'participant'.*H3-STUDY-032"),
        ({"device": {"min_with": 3}}, r"(?s)Unknown setting 'min_with' in device.*H3-STUDY-032"),
        (
            {"conditions": [{"name": "solo", "patner": "x"}]},
            r"(?s)Unknown setting 'patner' in conditions number 1.*H3-STUDY-032",
        ),
        ({"participants": "many"}, r"(?s)Expected 'int', got 'str' in participants.*H3-STUDY-032"),
        ({"participants": 0}, r"(?s)Expected 'int' >= 1 in participants.*H3-STUDY-032"),
        ({"conditions": []}, "H3-STUDY-017"),
        ({"conditions": [{"name": "a"}, {"name": "a"}]}, r"(?s)conditions.*'a'.*H3-STUDY-028"),
        ({"scenes": []}, "H3-STUDY-018"),
        ({"consent": {"version": "1"}}, "H3-STUDY-016"),
        ({"consent": {"version": "1", "file": "none.txt"}}, "H3-STUDY-045"),
        ({"forms": [{"builtin": "nasa_tlxx"}]}, r"(?s)Did you mean 'nasa_tlx'.*H3-STUDY-027"),
        ({"forms": [{"id": "mine"}]}, "H3-STUDY-035"),
        ({"forms": [{"builtin": "trust", "conditions": ["x"]}]}, r"(?s)x.*H3-STUDY-036"),
        ({"texts": {"de": {}}}, "H3-STUDY-033"),
        ({"texts": {"en": {"agre": "x"}}}, r"(?s)Did you mean 'agree'.*H3-STUDY-034"),
        ({"title": {"de": "x"}}, r"(?s)'de'.*H3-STUDY-038"),
        ({"title": {"de": "x"}, "languages": ["en", "de"]}, r"(?s)'en'.*H3-STUDY-039"),
        (
            {"forms": [{"id": "f", "items": [{"id": "a", "text": "?", "kind": "choice", "options": ["x"]}]}]},
            "H3-STUDY-046",
        ),
    ],
)
def test_errors_name_the_place_and_what_was_expected(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_design(write_tiny(tmp_path, **changes))


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-STUDY-030"):
        read_design(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("name = ")
    with pytest.raises(InputError, match="H3-STUDY-031"):
        read_design(tmp_path / "bad.toml")


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ({"name": "a", "app": "nothing"}, "(?s)nothing.*H3-STUDY-042"),
        ({"name": "a", "partner": "nobody"}, r"(?s)condition a.*Unknown policy 'nobody'.*H3-STUDY-042"),
        ({"name": "a", "rules": {"nonsense": 1}}, r"(?s)condition a.*nonsense.*H3-STUDY-042"),
    ],
)
def test_what_cannot_be_played_is_said_before_anybody_comes(tmp_path: Path, condition: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_plan(tiny(conditions=[condition]), tmp_path)


def test_places_are_balanced_and_nobody_gets_an_episode_twice(tmp_path: Path) -> None:
    path = write_tiny(tmp_path, participants=8, episodes=3)
    design = read_design(path)
    folder = study_folder(path, design)
    assert folder == tmp_path / "tiny-1"
    plan = make_plan(design, folder)
    assert len(plan.places) == 8
    for place in plan.places:
        assert sorted(block.condition for block in place.blocks) == ["solo", "still"]
        played = [(block.scene, e) for block in place.blocks for e in block.episodes]
        played += [(place.blocks[0].scene, e) for e in place.practice]
        assert len(set(played)) == len(played) == 7
        for block in place.blocks:
            assert plan.plans[plan.number(block.condition, block.scene)].scenes == block.scene
    orders = Counter(tuple(block.condition for block in place.blocks) for place in plan.places)
    assert set(orders.values()) == {4}
    scenes = Counter((block.condition, block.scene) for place in plan.places for block in place.blocks)
    assert set(scenes.values()) == {4}
    assert make_plan(design, folder) == plan
    assert not str(plan.key_file).startswith(str(folder) + "/"), "whoever gets the folder must not get the key"


def test_weights_are_found_beside_the_study_and_are_part_of_it(tmp_path: Path) -> None:
    condition = {"name": "net", "app": "social_nav", "partner": "weights:net.npz"}
    with pytest.raises(InputError, match=r"(?s)net\.npz.*H3-POLICY-029"):
        read_design(write_tiny(tmp_path, conditions=[condition]))
    shutil.copy(WEIGHTS, tmp_path / "net.npz")
    partner = read_design(tmp_path / "study.toml").conditions[0].partner
    assert partner is not None
    assert re.fullmatch(r"weights:net\.npz@[0-9a-f]{12}", partner), "no path of this machine"
    for named in (f"weights:{tmp_path}/net.npz", "weights:../net.npz"):
        design = read_design(write_tiny(tmp_path / "below", conditions=[{**condition, "partner": named}]))
        assert design.conditions[0].partner == partner.replace("net.npz", "../net.npz")
        make_plan(design, tmp_path / "below" / "tiny-1")


def test_recordings_name_weights_without_paths_of_the_machine(tmp_path: Path) -> None:
    shutil.copy(WEIGHTS, tmp_path / "net.npz")
    condition = {"name": "net", "app": "social_nav", "partner": "weights:net.npz"}
    design = read_design(write_tiny(tmp_path, conditions=[condition], scenes=["small:1"], tutorial={"skip": True}))
    plan = make_plan(design, tmp_path / "tiny-1")
    game = EpisodeFactory(plan.plans[-1]).begin(GameOrder(index=0, name="one", plan=len(plan.plans) - 1))
    game.step()
    game.close()
    recording = read_mcap(tmp_path / "tiny-1" / "one.mcap")
    assert recording.episode.info["policy"] == design.conditions[0].partner
    assert str(tmp_path) not in repr(recording.episode) + repr(design)


@pytest.mark.parametrize("task", ["social_nav", "rearrange"])
def test_every_policy_of_a_task_can_be_a_partner(task: str, tmp_path: Path) -> None:
    for seat, kind in (("person", "robot"), ("robot", "human")):
        names = find_task(task).policies.get(kind, {})
        conditions = [{"name": f"c{k}", "app": task, "play_as": seat, "partner": name} for k, name in enumerate(names)]
        if not conditions:
            continue
        design = read_design(write_tiny(tmp_path, scenes=["small:1"], conditions=conditions, episodes=1))
        assert [c.partner for c in design.conditions] == list(names), "named as they are"
        for condition in design.conditions:
            plan = PlayPlan(app=task, out=str(tmp_path), seats=(seat,), partner=condition.partner, scenes="small:1")
            assert EpisodeFactory(plan).plan.partner == condition.partner


def test_one_condition_is_a_study(tmp_path: Path) -> None:
    plan = make_plan(tiny(conditions=TINY["conditions"][:1]), tmp_path)
    assert [[block.condition for block in place.blocks] for place in plan.places] == [["solo"]] * 4


def test_forms_about_a_robot_are_asked_where_there_is_one() -> None:
    design = tiny()
    assert [form.id for form in forms_after(design, "condition", "solo")] == ["nasa_tlx"]
    assert [form.id for form in forms_after(design, "condition", "still")] == ["nasa_tlx", "trust"]
    assert [form.id for form in forms_after(design, "end")] == ["you"]


def test_answers_are_checked_and_scored() -> None:
    trust = resolved(tiny().forms[1])
    best = {item.id: 1 if item.reversed else 7 for item in trust.items}
    taken, why = checked_answers(trust, best)
    assert not why
    assert score(trust, taken) == 7
    load = resolved(tiny().forms[0])
    assert score(load, dict.fromkeys([item.id for item in BUILTIN["nasa_tlx"].items], 35.0)) == 35
    middle = dict.fromkeys([item.id for item in load.items], 50)
    for answers, message in (
        ({}, "every question"),
        ({**middle, "x": 1}, "no question 'x'"),
        ({**middle, "effort": 101}, "from 0 to 100"),
        ({**middle, "effort": 52}, "from 0 to 100"),
        ({**middle, "effort": True}, "a number"),
        ({**middle, "effort": float("nan")}, "a number"),
        ({**middle, "effort": "much"}, "a number"),
    ):
        assert message in checked_answers(load, answers)[1]
