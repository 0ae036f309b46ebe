"""Commands in README and docs are commands that exist with options that exist; Python blocks parse, some pages run."""

from __future__ import annotations

import ast
import inspect
import json
import re
import shlex
from pathlib import Path

import pytest

from h3data.errors import InputError
from h3data_pipelines.command import Group
from h3data_pipelines.commands.table import COMMANDS
from h3data_pipelines.parsing import parse
from tests.paths import DOCS, ROOT

BLOCK = re.compile(r"^ *```(\w+)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("tutorials/*.md"))]
NOTEBOOKS = sorted(DOCS.glob("notebooks/*.ipynb"))
RUN = ("python.md",)
"""Pages whose Python blocks run one after the other, as a reader runs them."""


def commands(page: Path) -> list[list[str]]:
    """Words of every command of h3data in the shell blocks of a page."""
    lines: list[list[str]] = []
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind in ("bash", "console", "sh"):
            for line in text.replace("\\\n", " ").splitlines():
                for part in re.split(r"&&|\|(?=\s)|;(?=\s)", line.partition(" #")[0]):
                    words = shlex.split(part)
                    if words[:1] == ["h3data"]:
                        lines.append(words[1 : words.index(">") if ">" in words else None])
    return lines


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_the_docs_exist(page: Path) -> None:
    for words in commands(page):
        try:
            parse([word for word in words if word != "..."], COMMANDS, about="")
        except InputError as error:
            pytest.fail(f"h3data {' '.join(words)}: {error}")
        except SystemExit:  # --help, --version
            pass


def test_the_docs_hold_commands() -> None:
    assert sum(len(commands(page)) for page in PAGES) > 60


def test_examples_of_help_exist() -> None:
    tried = 0
    for top in COMMANDS.values():
        for command in top.commands.values() if isinstance(top, Group) else [top]:
            for line in (inspect.getdoc(command) or "").partition("Examples:")[2].splitlines():
                if line.strip().startswith("h3data "):
                    words = shlex.split(line.partition(" > ")[0])[1:]
                    parse(words, COMMANDS, about="")
                    tried += 1
    assert tried > 60


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_in_the_docs_parses(page: Path) -> None:
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "python":
            ast.parse(text)


@pytest.mark.parametrize("name", RUN)
def test_pages_run_as_written(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for kind, text in BLOCK.findall((DOCS / name).read_text(encoding="utf-8")):
        if kind == "python":
            exec(compile(text, name, "exec"), {"__name__": "__main__"})


def test_the_site_leads_to_every_page() -> None:
    listed = re.findall(r"^[a-z][\w/-]*$", (DOCS / "index.md").read_text(encoding="utf-8"), re.MULTILINE)
    written = [page.relative_to(DOCS).with_suffix("").as_posix() for page in (*PAGES[1:], *NOTEBOOKS)]
    assert sorted(set(listed) - {"reference/python", "reference/commands"}) == sorted(set(written) - {"index"})


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs_which_make_docs_computes(notebook: Path) -> None:
    cells = json.loads(notebook.read_text())["cells"]
    assert any(cell["cell_type"] == "code" for cell in cells)
    for cell in cells:
        assert not cell.get("outputs"), "clear the outputs of all cells before you commit"
        assert cell.get("execution_count") is None
