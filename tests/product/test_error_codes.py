"""Codes of errors: each kind of message has one, which stays, and users find it."""

from __future__ import annotations

import copy
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from h3data.errors import H3DataError, InputError, SceneError, with_code
from h3data.metrics.requirements import UnmeasurableError
from h3data.recording.records import UnknownColumnError
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.failed_episodes import reason_of
from h3data_pipelines.machine.pages import error_kinds
from tests import error_codes
from tests.error_codes import PAGE, assign, kinds_of, places, read_sources, shipped_files, split, with_codes
from tests.paths import ROOT

KINDS = error_kinds(PAGE.read_text(encoding="utf-8"))
BASES = "class H3DataError(Exception): ...\nclass InputError(H3DataError): ...\n"


@pytest.mark.parametrize("error", [SceneError, UnknownColumnError])
def test_an_error_shows_its_code_beside_its_sentence(error: type[H3DataError]) -> None:
    fault = error("No home.", code="H3-SCENE-014")
    assert (str(fault), fault.code, with_code(fault)) == ("No home.", "H3-SCENE-014", "No home. [H3-SCENE-014]")
    assert with_code(ValueError("no")) == "no"
    for again in (pickle.loads(pickle.dumps(fault)), copy.copy(fault)):
        assert (str(again), again.code, again.__notes__) == ("No home.", "H3-SCENE-014", fault.__notes__)
    with pytest.raises(error, match="H3-SCENE-014"):  # as tests match it
        raise fault


def test_an_error_of_a_plug_in_has_a_code_too() -> None:
    assert InputError("No.").code == H3DataError.code == error_codes.OTHER.code
    assert UnmeasurableError("No.", "why", code="H3-METRIC-001").code == "H3-METRIC-001"


def test_a_traceback_names_the_code() -> None:
    script = "from h3data.errors import InputError; raise InputError('No.', code='H3-TASK-001')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stderr.endswith("InputError: No.\nH3-TASK-001: `h3data docs H3-TASK-001` says more.\n")


def test_a_failed_episode_says_its_code() -> None:
    assert reason_of(SceneError("No\nhome.", code="H3-SCENE-014")) == "No home. [H3-SCENE-014]"


def test_refusals_in_live_play_say_their_code() -> None:
    pytest.importorskip("aiohttp", reason="needs the extra hitl")
    from h3data_play.worker import Worker

    def refuse(*_: object) -> str:
        raise InputError("Not there.", code="H3-PLAY-001")

    told: list[tuple[str, str, list]] = []
    driver = SimpleNamespace(can_place=refuse)
    running: Any = SimpleNamespace(over=False, key="a", game=SimpleNamespace(drivers={0: driver}, take=refuse))
    worker: Any = SimpleNamespace(
        games={"a": running}, channel=SimpleNamespace(send=lambda *letter: told.append(letter))
    )
    Worker.can(worker, "a", [0, [1.0, 2.0]])
    Worker._take(worker, running, 0, SimpleNamespace(), "", 0.0)  # type: ignore[arg-type]
    said = {"why": "Not there.", "code": "H3-PLAY-001"}
    assert told == [("told", "a", [0, {"can": {"p": [1.0, 2.0], **said}}]), ("told", "a", [0, said])]


def test_the_entry_of_a_code_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    kind = next(kind for kind in KINDS if kind.to_do and kind.to_do != error_codes.GONE)
    assert main(["docs", kind.code.lower()]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for part in (kind.code, f"{kind.error}:", kind.text, kind.to_do):
        assert part in shown
    for other in (error_codes.OTHER.code, next(kind.code for kind in KINDS if not kind.to_do)):
        assert main(["docs", other, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["to_do"]
    assert main(["docs", "H3-SCENE-999999"]) == 2
    assert "`h3data docs errors` lists all" in capsys.readouterr().err


def test_the_page_loses_no_code() -> None:
    """Numbers of an area go from 1 to the one before the next that the page names, without a gap."""
    page = PAGE.read_text(encoding="utf-8")
    codes = [kind.code for kind in KINDS]
    assert len(codes) == len(set(codes)) > 1000
    after = dict(re.findall(r"The next code is H3-([A-Z]+)-(\d+)", page))
    for area, number in after.items():
        there = sorted(error_codes.number(code) for code in codes if code.split("-")[1] == area)
        assert there == ([0] if area == "OTHER" else list(range(1, int(number)))), area


def test_every_folder_has_an_area() -> None:
    assert error_codes.area_of("pipelines/h3data_homes/build.py") == "SCENE"
    assert error_codes.area_of("h3data/plugins.py") == "FILE"
    for path in shipped_files(ROOT):
        assert error_codes.area_of(path.relative_to(ROOT).as_posix()) in error_codes.AREAS


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Expected a path, got {x}.", ("Expected a path, got {x}.", "")),
        ("It is cut. Hint: copy it again: {path}", ("It is cut.", "Copy it again")),
        ("Not usable ({why}). Run `h3data info {path}`.", ("Not usable ({why}).", "Run `h3data info {path}`.")),
        ("No Ray. Hint: pip install 'h3data[ray]'", ("No Ray.", "pip install 'h3data[ray]'")),
    ],
)
def test_what_to_do_is_told_apart(text: str, said: tuple[str, str]) -> None:
    assert split(text) == said


def module(folder: Path, text: str) -> Path:
    file = folder / "h3data" / "scene" / "homes.py"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(BASES + text)
    return file


def codes_of(file: Path) -> list[str]:
    return re.findall(r"H3-\w+-\d+", file.read_text())


def test_codes_are_given_once_and_stay(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    first, second = (
        "raise InputError(f'No home {x!r} in', )\n",
        "raise InputError(\n    'Too many'  # why\n    ' of them'\n)\n",
    )
    file = module(tmp_path, first + second)
    error_codes.main(tmp_path)
    assert codes_of(file) == ["H3-SCENE-001", "H3-SCENE-002"]
    page = tmp_path / "docs" / "errors.md"
    assert "| H3-SCENE-001 | `InputError` | No home {x} in |" in page.read_text()
    before = file.read_text(), page.read_text()
    error_codes.main(tmp_path)
    assert (file.read_text(), page.read_text()) == before
    # other words, and one more before it: the number stays
    file.write_text(before[0].replace("No home", "No house").replace("raise", "raise InputError('Not now')\nraise", 1))
    error_codes.main(tmp_path)
    assert codes_of(file) == ["H3-SCENE-003", "H3-SCENE-001", "H3-SCENE-002"]
    # what is no longer raised stays on the page, and has its number again when it comes back
    file = module(tmp_path, first.replace("home", "house"))
    page_before = page.read_text()
    error_codes.main(tmp_path)
    assert codes_of(file) == ["H3-SCENE-001"]
    assert page.read_text().count(error_codes.GONE) == 2
    file = module(tmp_path, "raise InputError('Not now')\nraise InputError('Never')\nraise InputError('Not now')\n")
    error_codes.main(tmp_path)
    assert codes_of(file) == ["H3-SCENE-003", "H3-SCENE-004", "H3-SCENE-003"]
    assert page.read_text().startswith(page_before.partition("\n## ")[0])


def test_after_a_merge_the_place_that_the_page_does_not_know_gets_another_number(tmp_path: Path) -> None:
    file = module(
        tmp_path,
        "raise InputError('The other one', code='H3-SCENE-001')\nraise InputError('The first one', code='H3-SCENE-001')\n",
    )
    known = [error_codes.ErrorKind("H3-SCENE-001", "InputError", "The first one", "")]
    given = assign(places(read_sources([file])), known, tmp_path)
    assert [code for _, code in given] == ["H3-SCENE-002", "H3-SCENE-001"]
    text = with_codes(file.read_text(), [(place.call, code) for place, code in given])
    assert re.findall(r"H3-\w+-\d+", text) == ["H3-SCENE-002", "H3-SCENE-001"]
    assert {kind.code: kind.text for kind in kinds_of(given, known)}["H3-SCENE-002"] == "The other one"


def test_messages_without_words_of_their_own_share_no_code(tmp_path: Path) -> None:
    text = "raise InputError(f'{a}: {b}')\nraise InputError(f'{a}: {b}')\nraise InputError(x, code=fault.code)\n"
    file = module(tmp_path, text)
    known = [error_codes.ErrorKind(f"H3-SCENE-00{k}", "InputError", "{a}: {b}", "") for k in (1, 2)]
    assert [code for _, code in assign(places(read_sources([file])), [], tmp_path)] == ["H3-SCENE-001", "H3-SCENE-002"]
    assert [code for _, code in assign(places(read_sources([file])), known, tmp_path)] == [
        "H3-SCENE-001",
        "H3-SCENE-002",
    ]


def test_messages_are_found_behind_names_and_in_classes(tmp_path: Path) -> None:
    file = module(
        tmp_path,
        "WHY = 'A constant one'\n"
        "class Own(InputError):\n    def __init__(self, x): super().__init__(f'Made here of {x}')\n"
        "def why(): return f'Returned by {it}'\n"
        "def f():\n    text = 'A local one'\n    raise InputError(text)\n"
        "raise InputError(WHY)\nraise InputError(why())\nraise Own(3)\nraise ValueError('Not ours')\n"
        "raise InputError('one way' if a else 'or another')\n",
    )
    texts = sorted(place.kind.text for place in places(read_sources([file])))
    assert texts == ["A constant one", "A local one", "Made here of {x}", "Returned by {it}", "one way / or another"]


def test_every_place_that_raises_has_its_code_and_the_page_is_current() -> None:
    sources = read_sources(shipped_files(ROOT))
    given = assign(places(sources), KINDS, ROOT)
    wrong = [f"{place.path}:{place.call.lineno}" for place, code in given if place.kind.code != code]
    assert not wrong, f"run `make error-codes` and commit: {wrong}"
    assert len(given) > 1000
    page = error_codes.page_of(given, KINDS, sources)
    assert page == PAGE.read_text(encoding="utf-8"), "run `make error-codes` and commit docs/errors.md"
