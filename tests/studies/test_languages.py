"""Pages, questionnaires and sentences in the languages of the package, and what a further language has to bring."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import h3data_play
import h3data_studies
from h3data.errors import InputError
from h3data_play.apps.tutorial import HOW
from h3data_studies.files import read_design
from h3data_studies.flow import Progress
from h3data_studies.forms import BUILTIN, resolved
from h3data_studies.texts import ENGLISH, LIVE, SHIPPED, page_words, shipped
from h3data_studies.views import stage_view
from sim_kinematic.agents.skills import REASONS
from tests.studies.test_checks import person_of
from tests.studies.test_flow import DEVICE, PLACE
from tests.studies.tiny import tiny, write_tiny

PLAY, STUDIES = Path(h3data_play.__path__[0]), Path(h3data_studies.__path__[0])
OTHERS = [code for code in SHIPPED if code != "en"]
SENTENCE = re.compile(r"^[A-Z].*\.$")


def blanks(text: str) -> list[str]:
    return sorted(re.findall(r"\{\w*\}", text))


@pytest.mark.parametrize("code", OTHERS)
def test_a_language_of_the_package_has_every_word_with_the_same_blanks(code: str) -> None:
    language = shipped(code)
    assert language is not None
    for ours, english in ((language.pages, ENGLISH), (language.live, LIVE)):
        assert set(ours) == set(english)
        assert [name for name in english if blanks(ours[name]) != blanks(english[name])] == []
    assert [text for text, ours in language.said.items() if len(blanks(text)) != len(blanks(ours))] == []
    assert {name: set(form.items) for name, form in language.forms.items()} == {
        name: {item.id for item in form.items} for name, form in BUILTIN.items()
    }


def test_the_page_asks_for_words_that_are_there_and_for_no_others() -> None:
    said: set[str] = set()
    for path in (PLAY / "web" / "src").rglob("*.ts"):
        text = path.read_text()
        said |= set(re.findall(r"say\(\s*\"(\w+)\"", text)) | set(re.findall(r"\"((?:help|click|thumb)_\w+)\"", text))
    said |= set(re.findall(r'data-(?:say|title|label)="(\w+)"', (PLAY / "web" / "index.html").read_text()))
    assert said <= set(LIVE), said - set(LIVE)
    sources = "".join(path.read_text() for path in (PLAY / "web" / "src").rglob("*.ts"))
    named = said | {name for name in LIVE if re.search(rf"\b{name}\b", sources)}
    computed = re.compile(r"^(help|because|click|put|bring|use|chore|posture)_|^(open|close)$")
    assert [name for name in LIVE if name not in named and not computed.match(name)] == []


def sentences(path: Path) -> set[str]:
    """Sentences that a module returns or raises for players."""
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    values: list[ast.expr | None] = [node.value for node in ast.walk(tree) if isinstance(node, ast.Return)]
    values += [node.value for node in tree.body if isinstance(node, ast.Assign)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            values += [keyword.value for keyword in node.keywords if keyword.arg == "text"]
            values += node.args if isinstance(node.func, ast.Name) and node.func.id == "NotNow" else []
    for value in values:
        if isinstance(value, ast.Constant) and isinstance(value.value, str) and SENTENCE.match(value.value):
            found.add(value.value)
    return found


@pytest.mark.parametrize("code", OTHERS)
def test_what_the_server_says_to_players_is_there_too(code: str) -> None:
    language = shipped(code)
    assert language is not None
    told = set(REASONS.values()) | {text for how in HOW.values() for text in how.values()}
    study = STUDIES / "front.py", STUDIES / "flow.py"
    for path in (PLAY / "drivers.py", PLAY / "worker.py", *study, *sorted((PLAY / "apps").glob("*.py"))):
        told |= sentences(path)
    assert len(told) > 40
    patterns = [re.compile("^" + ".+?".join(map(re.escape, text.split("{}"))) + "$") for text in language.said]
    assert [text for text in sorted(told) if not any(pattern.match(text) for pattern in patterns)] == []


def test_a_participant_reads_pages_and_forms_in_their_language() -> None:
    design = tiny(languages=["en", "de", "es"], forms=[{"builtin": "nasa_tlx", "after": "consent"}])
    progress = Progress(design, PLACE)
    progress.device(DEVICE)
    person = person_of(design, progress)
    person.language = "de"
    view = stage_view(design, person)
    assert view["stage"]["heading"] == "Wie war die Aufgabe?"
    performance = next(item for item in view["stage"]["items"] if item["id"] == "performance")
    assert (performance["low"], performance["high"]) == ("Perfekt", "Misslungen")
    assert view["words"]["live_thumb_take"] == "Nehmen"
    assert view["words"]["said.The time is up."] == "Die Zeit ist um."
    assert page_words(tiny(texts={"en": {"live_view": "Look"}}), "en")["live_view"] == "Look"
    assert design.say(resolved(design.forms[0]).title, "de-AT") == "Wie war die Aufgabe?"


def test_a_language_without_texts_is_refused_and_told_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)'fr'.*en, de, es.*agree, decline.*more.*H3-STUDY-022"):
        read_design(write_tiny(tmp_path / "a", languages=["fr"]))
    words = dict.fromkeys((*ENGLISH, *(f"live_{name}" for name in LIVE)), "x")
    with pytest.raises(InputError, match=r"(?s)nasa_tlx.*'fr'.*H3-STUDY-023"):
        read_design(write_tiny(tmp_path / "b", languages=["fr"], texts={"fr": words}))
    own = [{"id": "you", "after": "end", "items": [{"id": "age", "text": "Âge"}]}]
    assert read_design(write_tiny(tmp_path / "c", languages=["fr"], texts={"fr": words}, forms=own)).languages == ["fr"]
    del words["live_thumb_take"]
    with pytest.raises(InputError, match=r"(?s)live_thumb_take.*H3-STUDY-022"):
        read_design(write_tiny(tmp_path / "d", languages=["fr"], texts={"fr": words}, forms=own))
    with pytest.raises(InputError, match=r"(?s)'de'.*H3-STUDY-039"):
        read_design(write_tiny(tmp_path / "e", languages=["en", "de"], title={"en": "Tidying"}))
