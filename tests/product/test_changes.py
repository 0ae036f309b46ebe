"""Fragments of the changelog, of which `make changelog` makes its next section."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.paths import DOCS, ROOT

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["towncrier"]
KINDS = {kind["directory"]: kind["name"] for kind in SETTINGS["type"]}
TEMPLATE = Path(SETTINGS["template"])
LONGEST = 400
"""Characters of an entry: two or three sentences. The page that it links to has the rest."""


def fault_of(name: str, text: str) -> str:
    """What is wrong with a fragment; empty if nothing is."""
    if not (found := re.fullmatch(r"([a-z][a-z-]*)\.([a-z]+)(\.\d+)?\.md", name)):
        return "expected a name such as studies.fixed.md, or studies.fixed.1.md for the second of a kind"
    if found[2] not in KINDS:
        return f"the kind {found[2]!r} is none of {', '.join(KINDS)}"
    if not re.match(r"[A-Z`]", text) or not re.search(r"[.)]\n\Z", text):
        return "expected whole sentences and a line break at the end"
    if re.search(r"^(?:[-*#]|\s*$)", text.rstrip("\n"), re.MULTILINE):
        return "expected one paragraph without bullets, headings and empty lines"
    if len(text) > LONGEST:
        return f"{len(text)} characters are more than {LONGEST}; make two of it, or move details to a page"
    missing = [link for link in re.findall(r"\]\(([^)#:]+)(?:#[\w-]+)?\)", text) if not (ROOT / link).exists()]
    return f"links start at CHANGELOG.md, and there is no {missing}" if missing else ""


def test_fragments_are_well_formed() -> None:
    files = [path for path in (DOCS / "changes").iterdir() if path.name != TEMPLATE.name]
    faults = {path.name: fault for path in files if (fault := fault_of(path.name, path.read_text(encoding="utf-8")))}
    assert faults == {}


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("studies.md", "Good.\n", "a name such as"),
        ("studies.also.md", "Good.\n", "'also' is none of"),
        ("studies.fixed.md", "no sentence", "whole sentences"),
        ("studies.fixed.md", "One.\n\n- Two.\n", "one paragraph"),
        ("studies.fixed.2.md", f"Long {'word ' * 90}.\n", "more than 400"),
        ("studies.fixed.md", "See [studies](study.md#faults).\n", "there is no ['study.md']"),
        ("studies.fixed.md", "See [studies](docs/study.md#faults).\n", ""),
    ],
)
def test_faults_of_fragments_are_found(name: str, text: str, said: str) -> None:
    assert said in fault_of(name, text)
    assert bool(said) is bool(fault_of(name, text))


def test_a_release_takes_the_fragments_into_the_changelog(tmp_path: Path) -> None:
    pytest.importorskip("towncrier")
    changes = tmp_path / "docs" / "changes"
    changes.mkdir(parents=True)
    shutil.copy(ROOT / TEMPLATE, changes)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (changes / "studies.fixed.md").write_text("One is mended.\n")
    (changes / "homes.fixed.md").write_text("Another is mended.\n")
    (changes / "homes.answers.md").write_text("`generate` was wrong.\n")
    start = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").partition("\n## ")[0]
    (tmp_path / "CHANGELOG.md").write_text(f"{start}\n## 0.2.0 (2026-11-25)\n\nThe rest.\n")
    command = [sys.executable, "-m", "towncrier", "build", "--yes", "--version", "0.3.0", "--date", "2027-01-02"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    written = (tmp_path / "CHANGELOG.md").read_text().removeprefix(start)
    assert written == (
        "\n## 0.3.0 (2027-01-02)\n\n### Answers that were wrong\n\n- Homes: `generate` was wrong.\n\n"
        "### Fixed\n\n- Homes: Another is mended.\n- Studies: One is mended.\n\n"
        "## 0.2.0 (2026-11-25)\n\nThe rest.\n"
    )
    assert [path.name for path in changes.iterdir()] == [TEMPLATE.name]
