"""What the command line says about words that it cannot use: one line with the word, what was expected, where to look."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from h3data_pipelines.cli import main
from h3data_pipelines.command import Group
from h3data_pipelines.commands.exporting import Export
from h3data_pipelines.commands.table import COMMANDS

HELP = [
    *((name,) for name in COMMANDS),
    *((name, sub) for name, group in COMMANDS.items() if isinstance(group, Group) for sub in group.commands),
]
REFUSED = {
    "generat": "Unknown command 'generat'. Did you mean 'generate'? Expected one of: demo,",
    "fly": "Unknown command 'fly'. Expected one of: demo, generate,",
    "scenes lst": "Unknown command 'lst'. Did you mean 'list'? Expected one of: list, show, export, validate.",
    "--json generate": "Expected a command before --json: h3data COMMAND --json. See: h3data --help",
    "generate": "Missing from h3data generate: TASK and -o/--out. See: h3data generate --help",
    "generate wander": "Missing from h3data generate: -o/--out. See: h3data generate --help",
    "convert a": "Missing from h3data convert: OUT. See: h3data convert --help",
    "generate wander -o x --epsodes 3": "Unknown option '--epsodes'. Did you mean '--episodes'? See: h3data generate --help",
    "metrics a --profil=field": "Unknown option '--profil=field'. Did you mean '--profile'? See: h3data metrics --help",
    "doctor please": "Unknown argument 'please'. See: h3data doctor --help",
    "generate wander -o x --episodes abc": "--episodes: expected a whole number, got 'abc'. See: h3data generate --help",
    "generate wander -o x --episodes None": "--episodes: expected a whole number, got 'None'. See: h3data generate --help",
    "generate wander -o x --seed 1.5": "--seed: expected a whole number, got '1.5'. See: h3data generate --help",
    "generate wander -o x --human-speed nan": "--human-speed: expected a number, got 'nan'. See: h3data generate --help",
    "generate wander -o x --episodes": "Missing value for --episodes. See: h3data generate --help",
    "robots reach quad_arm 1 2": "POINT: expected 3 values, got 2. See: h3data robots reach --help",
    "robots reach quad_arm 1 2 z": "POINT: expected a number, got 'z'. See: h3data robots reach --help",
    "export a --to b -o c": "Cannot export to 'b'. Expected one of: gfx-replay, gltf,",
    "rerender a --format b -o c": "--format: expected one of mp4, av1, png, data, got 'b'. See: h3data rerender --help",
    "generate --ot x": "Unknown option '--ot'. Did you mean '--out'? See: h3data generate --help",
    "view a -o --json": "Missing value for -o/--out. See: h3data view --help",
    "view a -o": "Missing value for -o/--out. See: h3data view --help",
}


@pytest.mark.parametrize("words", REFUSED)
def test_words_that_cannot_be_used_are_refused_in_one_line(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    out, error = capsys.readouterr()
    assert error.startswith("error: " + REFUSED[words])
    assert error.count("\n") == 1
    assert json.loads(out)["error"] == error[7:-1] if "--json" in words else not out


def test_refused_words_are_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--jsn", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"].startswith("Unknown option '--jsn'. Did you mean '--json'?")


@pytest.mark.parametrize("words", HELP, ids=" ".join)
def test_help_tells_defaults_that_say_something(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    out, error = capsys.readouterr()
    assert (stop.value.code, error) == (0, "")
    told = " ".join(line.strip("│ ") for line in out.splitlines())
    for raw in ("(default: )", "(default: None)", "(default: False)", "(default: '')", "{None}"):
        assert raw not in told
    assert "Examples:" in told
    if words == ("generate",):
        assert "(default: 4)" in told
        assert "--episodes INT" in told


def test_the_first_help_is_one_page(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in COMMANDS)
    assert len(out.splitlines()) < 60


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("h3data ")


def test_help_before_parsing_changes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    before = dict(Export.__annotations__)
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    assert before == Export.__annotations__
    script = """
from contextlib import suppress
from h3data_pipelines.cli import main
with suppress(SystemExit):
    main(["export", "--help"])
raise SystemExit(main(["export", "a", "--to", "b", "-o", "c"]))
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert said.returncode == 2
    assert "Cannot export to 'b'." in said.stderr
