"""``h3data docs``: the pages of the documentation, which are part of the installation."""

from __future__ import annotations

import pydoc
import re
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import tyro

from h3data.builtin import pages_root
from h3data.commands.command import JsonFlag, Outcome
from h3data.errors import InputError, suggest
from h3data.terminal import aligned


@dataclass(frozen=True)
class Docs:
    """Read the documentation: lists its pages, or shows one.

    The pages are part of the installation, so that they fit its version and need no network.

    Examples:
        h3data docs
        h3data docs metrics
        h3data docs tutorials/first-table
        h3data docs training --print > training.md
    """

    name: tyro.conf.Positional[str] = ""
    """A page, as listed without a name."""
    print: bool = False
    """Print the page, also on a terminal, which would show it in a pager otherwise."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Returns the list of pages, or the text of one."""
        pages = _pages()
        if not self.name:
            titles = {name: _title(path) for name, path in pages.items()}
            lines = [aligned(list(titles.items())), "", "Show one: h3data docs NAME", *_address()]
            return Outcome(text="\n".join(lines), data={"pages": titles})
        name = re.sub(r"^docs/|(\.md|\.html)?(#.*)?$", "", self.name)
        if name not in pages:
            raise InputError(f"Unknown page {self.name!r}.{suggest(name, pages)} `h3data docs` lists the pages.")
        text = pages[name].read_text(encoding="utf-8")
        if sys.stdout.isatty() and not (self.print or self.json):
            pydoc.pager(text)
            return Outcome(text=f"{pages[name]}")
        return Outcome(text=text, data={"page": name, "file": str(pages[name]), "text": text})


_OF_SITE = ("index", "changes", "gallery")
"""Pages that only the site has: they are made of other files, or of pictures."""


def _pages() -> dict[str, Path]:
    """The files of all pages by name: ``metrics``, ``tutorials/first-table``."""
    root = pages_root()
    found = sorted(path for pattern in ("*.md", "tutorials/*.md") for path in root.glob(pattern))
    return {path.relative_to(root).with_suffix("").as_posix(): path for path in found if path.stem not in _OF_SITE}


def _title(path: Path) -> str:
    with path.open(encoding="utf-8") as lines:
        return next((line.lstrip("# ").strip() for line in lines if line.startswith("# ")), "")


def _address() -> list[str]:
    """Where the documentation is on the internet, if the package says so."""
    try:
        urls = metadata("h3data").get_all("Project-URL") or []
    except PackageNotFoundError:
        return []
    pairs = (entry.partition(",")[::2] for entry in urls)
    return [f"With pictures: {url.strip()}" for label, url in pairs if label.strip().lower() == "documentation"]
