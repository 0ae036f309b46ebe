"""The order of what participants do, under everything that they could send."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data_studies.answers import answer_rows, filled
from h3data_studies.design import Block, Place
from h3data_studies.flow import (
    ACTIVE,
    COMPLETE,
    SCREENED_OUT,
    STATUSES,
    WITHDRAWN,
    NotNow,
    Progress,
    stages_of,
)
from h3data_studies.store import Participant
from tests.studies.tiny import tiny

DEVICE = {"webgl": True, "ping_ms": 20.0, "fps": 60.0, "width": 1280.0, "height": 720.0, "touch": False}
PLACE = Place((0,), (Block("still", "small:1", (1, 2)), Block("solo", "small:3", (0, 1))))
ANSWERS = {
    "nasa_tlx": dict.fromkeys(("mental", "physical", "temporal", "performance", "effort", "frustration"), 50),
    "you": {"age": 30},
}


def act(progress: Progress, ended: str = "success") -> None:
    """Does what comes next."""
    stage = progress.stage
    if stage.kind == "device":
        progress.device(DEVICE)
    elif stage.kind == "form":
        answers = ANSWERS.get(stage.form) or {item.id: 4 for item in progress.form.items}
        progress.answer(stage.form, answers)
    elif stage.kind == "tutorial":
        progress.over(f"tutorial/{progress.attempts + 1}", {"ended": ended})
    else:
        progress.over(stage.key, {"ended": ended})


def test_a_participant_goes_from_the_device_check_to_the_end() -> None:
    progress, keys = Progress(tiny(), PLACE), []
    while progress.stage.kind != "end":
        keys.append(progress.stage.key)
        act(progress)
    assert keys == [
        "device",
        "tutorial",
        "episode/1/1",
        "episode/1/2",
        "form/1/nasa_tlx",
        "form/1/trust",
        "episode/2/1",
        "episode/2/2",
        "form/2/nasa_tlx",
        "form/you",
    ]
    assert progress.status == COMPLETE


def test_the_tutorial_has_to_be_passed() -> None:
    progress = Progress(tiny(tutorial={"attempts": 3}), PLACE)
    act(progress)
    act(progress, "max_steps")
    assert progress.stage.kind == "tutorial"
    act(progress, "success")
    assert progress.stage.key == "episode/1/1"
    other = Progress(tiny(tutorial={"attempts": 2}), PLACE, {"device": DEVICE})
    act(other, "max_steps")
    act(other, "max_steps")
    assert (other.status, other.reason, other.stage.kind) == (SCREENED_OUT, "tutorial", "end")


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        ({"webgl": False}, "no_webgl"),
        ({"ping_ms": 251.0}, "slow_connection"),
        ({"width": 320.0, "final": True}, "small_window"),
        ({"fps": 3.0}, "slow_graphics"),
    ],
)
def test_weak_devices_are_screened_out(report: dict[str, float], reason: str) -> None:
    progress = Progress(tiny(), PLACE)
    progress.device({**DEVICE, **report})
    assert (progress.status, progress.reason) == (SCREENED_OUT, reason)


def test_a_small_window_is_checked_again() -> None:
    progress = Progress(tiny(), PLACE)
    progress.device({**DEVICE, "width": 390.0})
    again = Progress(tiny(), PLACE, dict(progress.rows), progress.status)
    assert (again.status, again.stage.kind, again.done) == (ACTIVE, "device", 0)
    again.device(DEVICE)
    assert again.stage.kind == "tutorial"
    other = Progress(tiny(), PLACE)
    other.device({**DEVICE, "width": 390.0, "fps": 3.0})
    assert (other.status, other.reason) == (SCREENED_OUT, "slow_graphics"), "no larger window would help"


def test_who_leaves_an_episode_leaves_the_study() -> None:
    progress = Progress(tiny(tutorial={"skip": True}), PLACE, {"device": DEVICE})
    act(progress, "closed")
    assert (progress.status, progress.reason) == (WITHDRAWN, "left")


steps = st.lists(
    st.sampled_from(("next", "fail", "device", "form", "wrong form", "again", "leave", "withdraw", "restart")),
    max_size=60,
)


@settings(max_examples=150, deadline=None)
@given(steps)
def test_whatever_is_sent_stages_come_once_and_in_order(sent: list[str]) -> None:
    design = tiny(tutorial={"attempts": 4})
    order = [stage.key for stage in stages_of(design, PLACE)]
    progress = Progress(design, PLACE)
    for what in sent:
        before, status, done = dict(progress.rows), progress.status, progress.done
        try:
            if what in ("next", "fail") and progress.stage.kind != "end":
                act(progress, "success" if what == "next" else "max_steps")
            elif what == "device":
                progress.device(DEVICE)
            elif what == "form":
                progress.answer("nasa_tlx", ANSWERS["nasa_tlx"])
            elif what == "wrong form":
                progress.answer("you", {"age": 3})
            elif what == "again" and before:
                key = next(iter(before))
                assert progress.over(key, {"ended": "success"}) == {}
            elif what == "leave" and progress.stage.kind == "episode":
                act(progress, "closed")
            elif what == "withdraw":
                progress.end(WITHDRAWN, "asked")
        except NotNow:
            assert (progress.rows, progress.status) == (before, status)
        if what == "restart":
            progress = Progress(design, PLACE, dict(progress.rows), progress.status, progress.reason)
            assert progress.rows == before
        assert all(progress.rows[key] == before[key] for key in before), "nothing is written twice"
        assert progress.status in STATUSES
        assert done <= progress.done <= done + 1
        assert [key for key in order if key in progress.rows] == order[: progress.done]
        if status != ACTIVE:
            assert progress.status == status, "the end is the end"
            assert progress.stage.kind == "end"
        assert (progress.status == COMPLETE) <= (progress.done == len(order))


def test_rows_are_all_that_has_to_be_kept(tmp_path: Path) -> None:
    progress = Progress(tiny(), PLACE)
    while progress.stage.kind != "end":
        again = Progress(tiny(), PLACE, dict(progress.rows), progress.status)
        assert again.stage == progress.stage
        act(progress)


def test_a_form_after_consent_is_asked_again_at_the_end() -> None:
    item = {"id": "mood", "text": "How are you?"}
    forms = [
        {"id": "mood", "after": after, "title": after, "items": [item]} for after in ("consent", "condition", "end")
    ]
    design, asked = tiny(forms=forms, tutorial={"skip": True}), []
    progress = Progress(design, PLACE)
    while progress.stage.kind != "end":
        stage = progress.stage
        if stage.kind == "form":
            asked.append((stage.block, progress.form.title))
            for block in {0, 1, 2, 3} - {stage.block}:
                with pytest.raises(NotNow):
                    progress.answer("mood", {"mood": 1}, block)
            progress.answer("mood", {"mood": len(asked)}, stage.block)
        else:
            act(progress)
    assert asked == [(0, "consent"), (1, "condition"), (2, "condition"), (3, "end")]
    again = Progress(design, PLACE, dict(progress.rows))
    assert again.stage.kind == "end"
    person = Participant(
        number=1, id="P", place=0, joined=0.0, used=0.0, idle=0.0, language="en", consent={}, ids={}, progress=progress
    )
    assert [(form.title, answers["mood"]) for form, _, answers in filled(person)] == [
        ("consent", 1),
        ("condition", 2),
        ("condition", 3),
        ("end", 4),
    ]
    assert [row[-2:] for row in answer_rows([person], free_text=False)] == [
        ["after", "answer"],
        ["consent", "1"],
        ["condition", "2"],
        ["condition", "3"],
        ["end", "4"],
    ]
