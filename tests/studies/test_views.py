"""What pages are told: in the participant's language, and no more than they need."""

from __future__ import annotations

import json
from pathlib import Path

from h3data_studies.files import make_plan
from h3data_studies.flow import Progress
from h3data_studies.store import StudyStore
from h3data_studies.views import consent_view, end_view, stage_view, text_hash
from tests.studies.test_flow import DEVICE, act
from tests.studies.tiny import tiny

GERMAN = {
    "languages": ["en", "de"],
    "title": {"en": "Tidying up", "de": "Aufräumen"},
    "consent": {"version": "1", "text": {"en": "You may stop.", "de": "Sie dürfen aufhören."}},
    "texts": {"de": {"agree": "Ich nehme teil"}},
}


def test_consent_is_asked_and_hashed_in_the_language_that_was_read() -> None:
    english, german = (consent_view(tiny(**GERMAN), language) for language in ("en", "de"))
    assert german["title"] == "Aufräumen"
    assert german["stage"]["text"] == "Sie dürfen aufhören."
    assert german["stage"]["hash"] == text_hash("Sie dürfen aufhören.") != english["stage"]["hash"]
    assert german["words"]["agree"] == "Ich nehme teil"
    assert german["words"]["decline"] == "Ich nehme nicht teil", "words that the file does not have are the package's"
    assert english["words"]["decline"] == "I do not take part"


def test_participants_are_blind_to_their_condition(tmp_path: Path) -> None:
    names = [{"name": "solo-secret", "partner": "solo"}, {"name": "robot-secret", "partner": "still"}]
    design = tiny(conditions=names)
    plan = make_plan(design, tmp_path)
    store = StudyStore(design, plan.places, tmp_path)
    person = store.join("P-1", 0, language="en", consent={}, ids={})
    kinds = set()
    while person.progress.stage.kind != "end":
        view = stage_view(design, person)
        kinds.add(view["stage"]["kind"])
        assert "secret" not in json.dumps(view)
        act(person.progress)
    assert kinds == {"device", "tutorial", "episode", "form"}
    assert stage_view(design, person)["stage"]["status"] == "complete"


def test_the_last_page_says_why_and_hands_out_the_right_code() -> None:
    codes = {"completion_code": "C", "screen_out_code": "S", "screen_out_url": "https://example.org/?cc={code}"}
    design = tiny(recruiting=codes)
    progress = Progress(design, make_plan(design, Path("x")).places[0])
    progress.device({**DEVICE, "ping_ms": 999.0})
    stage = end_view(design, "en", progress.status, progress.reason)["stage"]
    assert stage["text"] == "You cannot take part: the connection to the server is too slow."
    assert (stage["code"], stage["url"]) == ("S", "https://example.org/?cc=S")
    for status in ("complete", "dropped", "withdrawn", "declined", "full", "need_id"):
        stage = end_view(design, "en", status)["stage"]
        assert stage["heading"]
        assert stage["code"] == ("C" if status == "complete" else "")
