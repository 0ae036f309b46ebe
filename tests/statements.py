"""Counts statements by package: ``python -m tests.statements [FOLDER ...]``, folders being clones of this repository.

A statement is a node of Python's syntax tree (`ast.stmt`), wherever it stands: a ``def``, an ``if`` and what is in it count one
each. Docstrings, also those below fields and constants, and other lone strings do not count, so that neither layout nor
documentation changes the number. `h3data` and `sim_kinematic` are what a newcomer reads; their sum may not pass `LIMIT`.

The last line counts the names that these two packages define at the top of their modules: functions, classes and constants
(``__all__`` too, but not two names assigned at once). A reader meets each of them. Constants and helpers that serve one
function belong into that function, and those that serve one module into a record of it; they may not pass `NAMES_LIMIT`.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from functools import cache
from pathlib import Path

from tests.paths import ROOT

CORE = ("h3data", "sim_kinematic")
LIMIT = 37_041
"""Seven tenths of the 52,916 statements that the two packages had before the first of the packages beside them."""

NAMES_LIMIT = 45.0
"""Names per 1,000 lines of the core, at most; other projects of this kind have 15 to 31."""


def count_statements(source: str) -> int:
    """Number of statements of a module, lone strings left out."""
    return sum(isinstance(node, ast.stmt) and not _is_string(node) for node in ast.walk(ast.parse(source)))


def count_names(source: str) -> int:
    """Number of functions, classes and single variables that a module defines at its top level."""
    return sum(
        isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef))
        or (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name))
        or (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name))
        for node in ast.parse(source).body
    )


def names_per_1000_lines(root: Path) -> float:
    """Names at the top of the core's modules per 1,000 of all their lines."""
    sources = [path.read_text("utf-8") for name in CORE for path in (root / name).rglob("*.py")]
    return 1000 * sum(map(count_names, sources)) / sum(len(source.splitlines()) for source in sources)


@cache
def by_package(root: Path) -> Counter[str]:
    """Statements of each package of a clone."""
    folders = [root / name for name in CORE]
    folders += [path for parent in ("pipelines", "viewers") for path in sorted((root / parent).iterdir())]
    return Counter(
        {
            folder.name: sum(count_statements(path.read_text("utf-8")) for path in folder.rglob("*.py"))
            for folder in folders
            if folder.is_dir()
        }
    )


def _is_string(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def main(folders: list[str]) -> int:
    """Prints a column per folder; returns 1 if the core of the first is over a limit."""
    counts = [by_package(Path(folder)) for folder in folders or [str(ROOT)]]
    for name in sorted(set().union(*counts), key=lambda name: (name not in CORE, name)):
        print(f"{name:<20}", *(f"{count[name]:>8,}" for count in counts))
    sums = [sum(count[name] for name in CORE) for count in counts]
    print(f"{' + '.join(CORE):<20}", *(f"{total:>8,}" for total in sums), f"  (at most {LIMIT:,})")
    names = [names_per_1000_lines(Path(folder)) for folder in folders or [str(ROOT)]]
    print(f"{'names / 1,000 lines':<20}", *(f"{value:>8.1f}" for value in names), f"  (at most {NAMES_LIMIT})")
    return int(sums[0] > LIMIT or names[0] > NAMES_LIMIT)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
