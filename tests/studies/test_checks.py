"""Checks with right answers, questions after each episode, rules that leave out participants and episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from h3data.errors import InputError
from h3data_studies.answers import answer_rows, check_rows, form_means
from h3data_studies.exclusions import exclusions, focus_rows, participant_measures
from h3data_studies.files import read_design
from h3data_studies.flow import COMPLETE, SCREENED_OUT, NotNow, Progress
from h3data_studies.pseudonyms import completion_code
from h3data_studies.store import Participant
from h3data_studies.views import stage_view
from tests.studies.test_flow import DEVICE, PLACE, act
from tests.studies.test_study_doors import PID, Study, run
from tests.studies.tiny import tiny, write_tiny

TASK = {"id": "task", "text": "What to do?", "kind": "choice", "options": ["Follow", "Tidy up", "Sleep"], "right": 1}
UNDERSTOOD = {"id": "understood", "after": "tutorial", "attempts": 3, "items": [TASK], "again": "Read again."}
ATTENTION = {"id": "attention", "text": "Please choose 2.", "right": 2}
TRUST = {"builtin": "trust", "fail": "note", "items": [ATTENTION]}
MOOD = {"id": "mood", "after": "trial", "items": [{"id": "happy", "text": "Happy?"}]}


def person_of(design: Any, progress: Progress, name: str = "P-1", used: float = 600.0) -> Participant:
    return Participant(
        number=1,
        id=name,
        place=0,
        joined=0.0,
        used=used,
        idle=0.0,
        language="en",
        consent={},
        ids={},
        progress=progress,
    )


def to_form(progress: Progress, form: str) -> None:
    """Does everything up to a form."""
    while progress.stage.form != form:
        act(progress)


def test_a_check_may_be_answered_again_and_its_answers_are_kept() -> None:
    design = tiny(forms=[UNDERSTOOD])
    progress = Progress(design, PLACE)
    to_form(progress, "understood")
    assert "right" not in str(stage_view(design, person_of(design, progress))["stage"]), "pages do not know the answer"
    assert stage_view(design, person_of(design, progress))["stage"]["again"] == ""
    rows = progress.answer("understood", {"task": 0})
    assert rows == {
        "check/form/understood/1": {"form": "understood", "answers": {"task": 0.0}, "wrong": ["task"], "attempt": 1}
    }
    assert stage_view(design, person_of(design, progress))["stage"]["again"] == "Read again."
    progress.answer("understood", {"task": 1})
    assert progress.stage.kind == "episode"
    person = person_of(design, progress)
    assert [row[3:] for row in check_rows([person])[1:]] == [["1", "task", "0.0", "0"], ["2", "task", "1.0", "1"]]
    assert participant_measures(person)["check_retries"] == 1
    assert participant_measures(person)["failed_checks"] == 0


def test_who_passes_in_no_attempt_is_screened_out_or_only_noted() -> None:
    out = Progress(tiny(forms=[UNDERSTOOD]), PLACE)
    to_form(out, "understood")
    for _ in range(3):
        assert out.stage.kind == "form"
        out.answer("understood", {"task": 2})
    assert (out.status, out.reason) == (SCREENED_OUT, "failed_check")
    stage = stage_view(out.design, person_of(out.design, out))["stage"]
    assert stage["text"] == "You cannot take part: a question about the instructions was not answered correctly."
    noted = Progress(tiny(forms=[TRUST]), PLACE)
    while noted.stage.kind != "end":
        act(noted)  # chooses 4 everywhere
    assert noted.status == COMPLETE
    person = person_of(noted.design, noted)
    assert participant_measures(person)["failed_checks"] == 1  # not after solo
    (mean,) = form_means(noted.design, [person])[0]
    assert mean.mean == 4.0, "checks are no part of a score"


def test_questions_come_after_each_episode_and_name_it() -> None:
    design = tiny(forms=[MOOD])
    progress, keys = Progress(design, PLACE), []
    while progress.stage.kind != "end":
        keys.append(progress.stage.key)
        if progress.stage.kind == "form":
            with pytest.raises(NotNow):
                progress.answer("mood", {"happy": 1}, progress.stage.block, progress.stage.trial + 1)
            progress.answer("mood", {"happy": len(keys) % 7 + 1}, progress.stage.block, progress.stage.trial)
        else:
            act(progress)
    assert keys == [
        "device",
        "tutorial",
        "episode/1/1",
        "form/1/1/mood",
        "episode/1/2",
        "form/1/2/mood",
        "episode/2/1",
        "form/2/1/mood",
        "episode/2/2",
        "form/2/2/mood",
    ]
    person = person_of(design, progress)
    rows = answer_rows([person], free_text=False)
    assert [dict(zip(rows[0], row, strict=True))["trial"] for row in rows[1:]] == ["1", "2", "1", "2"]
    means = {m.condition: m for m in form_means(design, [person])[0]}
    assert (means["still"].mean, means["still"].people) == ((5 + 7) / 2, 1)


def test_rules_leave_out_people_and_episodes_with_reasons_and_counts() -> None:
    rules = [
        {"name": "inattentive", "what": "failed_checks", "above": 0},
        {"name": "hasty", "what": "minutes", "below": 5},
        {"name": "away", "of": "trial", "what": "away_s", "above": 30},
    ]
    design = tiny(forms=[TRUST], exclude=rules)
    people = []
    for name, used, right in (("P-good", 600.0, True), ("P-bad", 600.0, False), ("P-hasty", 60.0, True)):
        progress = Progress(design, PLACE)
        while progress.stage.kind != "end":
            if progress.stage.form == "trust" and right:
                progress.answer("trust", {item.id: 2 for item in progress.form.items})
            else:
                act(progress)
        progress.rows["focus/1"] = {"away": True, "why": "hidden", "seconds": 0.0, "stage": "episode/1/2"}
        progress.rows["focus/2"] = {"away": False, "why": "blur", "seconds": 31.0, "stage": "episode/1/2"}
        people.append(person_of(design, progress, name, used))
    found = exclusions(design, people)
    assert found.people == {"P-bad": "rule inattentive (failed_checks is 1)", "P-hasty": "rule hasty (minutes is 1)"}
    assert found.trials == {("P-good", "episode/1/2"): "rule away (away_s is 31)"}
    assert found.counts == {"inattentive": 1, "hasty": 1, "away": 1}
    assert [row[2:] for row in focus_rows(people[:1])[1:]] == [
        ["episode/1/2", 1, "hidden", 0.0],
        ["episode/1/2", 0, "blur", 31.0],
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"forms": [{**UNDERSTOOD, "items": [{**TASK, "right": 3}]}]}, "H3-STUDY-048"),
        ({"forms": [{**UNDERSTOOD, "items": [{"id": "a", "text": "b", "kind": "text", "right": 1}]}]}, "H3-STUDY-040"),
        ({"forms": [{**MOOD, "attempts": 2}]}, "H3-STUDY-024"),
        ({"exclude": [{"name": "a", "what": "minuts", "above": 1}]}, r"(?s)Did you mean 'minutes'.*H3-STUDY-025"),
        ({"exclude": [{"name": "a", "what": "minutes"}]}, "H3-STUDY-026"),
        (
            {"exclude": [{"name": "a", "what": "failed_checks", "of": "trial", "above": 0}]},
            r"(?s)seconds.*H3-STUDY-025",
        ),
        ({"forms": [UNDERSTOOD, {**UNDERSTOOD, "after": "consent"}]}, r"(?s)forms.*H3-STUDY-028"),
        ({"recruiting": {"unique_codes": True, "completion_code": "C"}}, "H3-STUDY-021"),
    ],
)
def test_what_a_check_or_a_rule_cannot_mean_is_refused(tmp_path: Any, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_design(write_tiny(tmp_path, **changes))


def test_designs_of_before_are_read(tmp_path: Any) -> None:
    design = read_design(write_tiny(tmp_path))
    old = msgspec.to_builtins(design)
    for name in ("exclude", "bonus"):
        del old[name]
    assert msgspec.convert(old, type(design)) == design
    assert DEVICE


def test_pages_answer_checks_log_the_focus_and_end_with_a_code_of_their_own(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        assert person.stage["form"] == "ready"
        body = {"form": "ready", "block": 0, "trial": 0}
        assert await person.ask("api/study/form", {**body, "answers": {"task": 0}}) == 200
        assert (person.stage["kind"], person.stage["again"]) == ("form", "Read again.")
        assert await person.ask("api/study/form", {**body, "answers": {"task": 1}}) == 200
        assert person.stage["kind"] == "episode"
        who = study.front.journal.by_id(person.view["participant"])
        assert who is not None
        study.clock.now += 6
        study.front.journal.count_time()
        idle = who.idle
        assert await person.ask("api/study/focus", {"away": True, "why": "hidden"}) == 204
        act(who.progress)  # the episode ends while nobody looks
        assert who.idle == idle > 0, "who is away is not active"
        assert await person.ask("api/study/focus", {"away": False, "ms": 4200}) == 204
        assert participant_measures(who) | {"away_s": 4.2, "away_count": 1} == participant_measures(who)
        assert {row[2] for row in focus_rows([who])[1:]} == {"episode/1/1"}
        assert await person.ask("api/study/focus", {"away": False, "ms": -1}) == 400
        assert await person.ask("api/study") == 200
        assert (person.stage["form"], person.stage["trial"]) == ("mood", 1)
        answers = {"form": "mood", "block": 1, "answers": {"happy": 5}}
        assert await person.ask("api/study/form", answers) == 409, "which episode?"
        assert await person.ask("api/study/form", {**answers, "trial": 1}) == 200
        study.finish(person)
        await person.ask("api/study")
        key = (tmp_path / "s.key").read_bytes()
        assert person.stage["code"] == completion_code(person.view["participant"], key)
        assert person.stage["url"].endswith(f"cc={person.stage['code']}")

    ready = {**UNDERSTOOD, "id": "ready", "after": "consent"}
    recruiting = {"unique_codes": True, "completion_url": "https://example.org/?cc={code}"}
    run(tmp_path, what, forms=[ready, MOOD], recruiting=recruiting)
