"""Command ``h3data docs``, which shows pages of the installed documentation and entries of error codes."""

from __future__ import annotations

import pydoc
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import NamedTuple

import tyro

from h3data.builtin import shipped
from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import InputError, did_you_mean, suggest
from h3data.terminal import aligned


@dataclass(frozen=True)
class Docs:
    """Read the documentation, or the meaning of an error code.

    The pages are part of the installation, so that they match its version and need no network.

    Examples:
        h3data docs
        h3data docs metrics
        h3data docs tutorials/first-table
        h3data docs H3-FILE-011
        h3data docs training --print > training.md
    """

    name: tyro.conf.Positional[str] = ""
    """Name of a page, as listed by the command without a name, or the code of an error."""
    print: bool = False
    """Print the page instead of opening it in a pager on a terminal."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return the list of pages, or the text of one page."""
        pages = _pages()
        if not self.name:
            titles = {name: _title(path) for name, path in pages.items()}
            lines = [aligned(list(titles.items())), "", "Show one: h3data docs NAME", *_address()]
            return Outcome(text="\n".join(lines), data={"pages": titles})
        if re.match(r"(?i)h3-", self.name):
            return _entry(self.name.upper(), pages["errors"].read_text(encoding="utf-8"))
        name = re.sub(r"^docs/|(\.md|\.html)?(#.*)?$", "", self.name)
        if name not in pages:
            raise InputError(
                f"Unknown page {self.name!r}.{suggest(name, pages)} `h3data docs` lists the pages.",
                code="H3-MACHINE-014",
            )
        text = pages[name].read_text(encoding="utf-8")
        if sys.stdout.isatty() and not (self.print or self.json):
            pydoc.pager(text)
            return Outcome(text=f"{pages[name]}")
        return Outcome(text=text, data={"page": name, "file": str(pages[name]), "text": text})


class ErrorKind(NamedTuple):
    """Kind of error, as the page of errors lists it."""

    code: str
    error: str
    """Name of the class."""
    text: str
    """Text of the message, with the names of its variables in braces."""
    to_do: str
    """Advice in the message; empty if the text or the error class gives it."""


def error_kinds(page: str) -> list[ErrorKind]:
    """Return the kinds of errors that the page of errors lists, in its order."""
    return [ErrorKind(*cells) for cells in _rows(page, of=4) if re.fullmatch(r"H3-[A-Z]+-\d{3,}", cells[0])]


def _rows(page: str, *, of: int) -> Iterator[list[str]]:
    """Yield the cells of the rows of all tables with so many columns."""
    for line in page.splitlines():
        cells = [_plain(cell.strip()) for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == of:
            yield cells


def _plain(cell: str) -> str:
    """Return a cell of a table without its escapes; a name of code without its quotes."""
    text = re.sub(r"\\([|*])", r"\1", cell).replace("&lt;", "<")
    return text[1:-1] if re.fullmatch(r"`\w+`", text) else text


def _entry(code: str, page: str) -> Outcome:
    """Return the entry of a code on the page of errors."""
    kinds = {kind.code: kind for kind in error_kinds(page)}
    if code not in kinds:
        raise InputError(
            f"Unknown code {code!r}.{did_you_mean(code, kinds)} `h3data docs errors` lists all of them.",
            code="H3-MACHINE-013",
        )
    kind = kinds[code]
    by_class = {name: (about, to_do) for name, about, to_do in _rows(page, of=3)}
    about, to_do = by_class[kind.error]
    before = page[: page.index(f"| {code} |")].rpartition("\n## ")[2]
    see = re.search(r"\[(.+?)\]\(", before)
    text = aligned(
        [
            (code, f"{kind.error}: {about}"),
            ("Message", kind.text),
            ("What to do", kind.to_do or to_do),
            ("More", f"h3data docs {see[1]}" if see else "h3data docs troubleshooting"),
        ]
    )
    return Outcome(text=text, data=kind._asdict() | {"to_do": kind.to_do or to_do})


_OF_SITE = ("index", "changes", "gallery")
"""Pages that only the site has, because they are made of other files or of pictures."""


def _pages() -> dict[str, Path]:
    """Return the files of all pages by name: ``metrics``, ``tutorials/first-table``."""
    root = shipped("_docs", "docs", "pages of the documentation")
    found = sorted(path for pattern in ("*.md", "tutorials/*.md") for path in root.glob(pattern))
    return {path.relative_to(root).with_suffix("").as_posix(): path for path in found if path.stem not in _OF_SITE}


def _title(path: Path) -> str:
    with path.open(encoding="utf-8") as lines:
        return next((line.lstrip("# ").strip() for line in lines if line.startswith("# ")), "")


def _address() -> list[str]:
    """Return the address of the documentation on the internet, if the package names one."""
    try:
        urls = metadata("h3data").get_all("Project-URL") or []
    except PackageNotFoundError:
        return []
    pairs = (entry.partition(",")[::2] for entry in urls)
    return [f"With pictures: {url.strip()}" for label, url in pairs if label.strip().lower() == "documentation"]
