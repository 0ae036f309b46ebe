"""The public interface is what tests/data/public_api.txt says, so that no change of it goes unnoticed."""

from __future__ import annotations

import difflib
import enum
import functools
import re
import subprocess
from pathlib import Path

import pytest

from tests import public_api
from tests.paths import ROOT


def test_the_public_interface_is_the_stored_one() -> None:
    stored = public_api.FILE.read_text(encoding="utf-8").splitlines()
    now = list(public_api.lines())
    changed = [
        line for line in difflib.unified_diff(stored, now, lineterm="", n=0) if line[:2] not in ("--", "++", "@@")
    ]
    assert not changed, "run `make api`, commit the file and tell users in docs/changes/:\n" + "\n".join(changed)


def test_it_holds_what_users_write() -> None:
    stored = public_api.FILE.read_text(encoding="utf-8").splitlines()
    assert "h3data.envs.make(... num_envs: int | None = None)" in stored
    assert "h3data generate --episodes int = None" in stored
    assert "h3data.Recording is h3data.recording.Recording" in stored
    assert not any(str(ROOT) in line or "0x" in line for line in stored)


class Sample:
    """A class as the text describes it."""

    def __init__(self, size: int, *, colour: str = "red") -> None: ...

    def grow(self, by: float = 1.0) -> Sample: ...

    @property
    def area(self) -> float: ...

    @functools.cached_property
    def weight(self) -> int: ...

    @classmethod
    def square(cls) -> Sample: ...

    def _hidden(self) -> None: ...


class Kind(enum.Enum):
    A = 1


def test_members_parameters_and_values_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(public_api, "OURS", re.compile(r"tests\."))
    assert list(public_api._described("x.Sample", Sample)) == [
        "class x.Sample(size: int)",
        "class x.Sample(... colour: str = 'red')",
        "x.Sample.area: float",
        "x.Sample.grow(self, by: float = 1.0) -> Sample",
        "classmethod x.Sample.square(cls) -> Sample",
        "x.Sample.weight: int",
    ]
    assert list(public_api._described("x.Kind", Kind)) == ["class x.Kind", "x.Kind.A = 1"]


def test_what_goes_away_needs_a_fragment_of_the_changelog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(public_api, "ROOT", tmp_path)
    monkeypatch.setattr(public_api, "FILE", tmp_path / "api.txt")

    def commit(name: str, text: str) -> None:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        for words in (["init", "-q"], ["add", "-A"], [*identity, "commit", "-qm", "x"]):
            subprocess.run(["git", *words], cwd=tmp_path, check=True, capture_output=True)

    commit("api.txt", "f(a)\n")
    commit("api.txt", "f(a)\ng()\n")
    assert public_api.main(["--since", "HEAD~1"]) == 0
    assert capsys.readouterr().out == "+ g()\n"
    commit("api.txt", "f(b)\ng()\n")
    assert public_api.main(["--since", "HEAD~1"]) == 1
    assert "TOPIC.changed.md in docs/changes/" in capsys.readouterr().out
    commit("docs/changes/" + "f.changed.md", "Parameter a is b.\n")
    assert public_api.main(["--since", "HEAD~2"]) == 0
    assert public_api.main(["--since", "HEAD"]) == 0
    assert capsys.readouterr().out.endswith("The public interface is the same.\n")
