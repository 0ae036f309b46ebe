"""The shape of the house: no import circles between files, no flat folder that outgrows a table of contents."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "h3data": ROOT / "h3data",
    "sim_kinematic": ROOT / "sim_kinematic",
    "h3data_viewers": ROOT / "viewers" / "h3data_viewers",
    "h3data_training": ROOT / "pipelines" / "h3data_training",
    "h3data_pipelines": ROOT / "pipelines" / "h3data_pipelines",
    "h3data_kernels": ROOT / "pipelines" / "h3data_kernels",
    "bake": ROOT / "pipelines" / "bake",
}
BLOCKS = (ast.stmt, ast.ExceptHandler, ast.match_case)
"""Where imports are; most of a tree is expressions, which have none."""
FILES_PER_FOLDER = 15
"""Modules per folder, `__init__.py` not counted."""


def modules() -> dict[str, Path]:
    """Every module of the product by its dotted name; a package's name stands for its `__init__.py`."""
    return {
        ".".join([package, *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__"): path
        for package, folder in PACKAGES.items()
        for path in sorted(folder.rglob("*.py"))
    }


def imported_names(tree: ast.Module) -> Iterator[str]:
    """Dotted names that a module imports, `from a import b` as `a.b`.

    Imports inside functions and those for type checkers count too: they hide a circle from Python, not from a reader.
    """
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        waiting += [child for child in ast.iter_child_nodes(node) if isinstance(child, BLOCKS)]


def import_graph(paths: dict[str, Path]) -> dict[str, list[str]]:
    """The modules that each module imports by name.

    Importing `a.b.c` also runs `a/__init__.py` and `a/b/__init__.py`. Those arrows are left out: Python tolerates them, and
    every package whose face re-exports its files would be a circle.
    """
    graph = {}
    for name, path in paths.items():
        targets = {}
        for imported in imported_names(ast.parse(path.read_text(encoding="utf-8"))):
            target = imported if imported in paths else imported.rpartition(".")[0]
            if target in paths and target != name:
                targets[target] = None
        graph[name] = list(targets)
    return graph


def circles(graph: dict[str, list[str]]) -> list[list[str]]:
    """One path per group of modules that import each other, first module repeated at the end."""
    reachable = {name: _reachable(graph, name) for name in graph}
    groups = {frozenset(b for b in reachable[a] if a in reachable[b]) for a in graph if a in reachable[a]}
    return sorted(_path(graph, group) for group in groups)


def _reachable(graph: dict[str, list[str]], start: str) -> set[str]:
    seen: set[str] = set()
    stack = list(graph[start])
    while stack:
        name = stack.pop()
        if name not in seen:
            seen.add(name)
            stack += graph[name]
    return seen


def _path(graph: dict[str, list[str]], group: frozenset[str]) -> list[str]:
    """A shortest circle within a group of modules that all reach each other, from its first module in the alphabet."""
    start = min(group)
    paths = [[start]]
    for path in paths:
        for target in graph[path[-1]]:
            if target == start:
                return [*path, start]
            if target in group and target not in path:
                paths.append([*path, target])
    raise AssertionError(f"{start} is in no circle of {sorted(group)}")


def test_no_import_circles() -> None:
    paths = [" -> ".join(path) for path in circles(import_graph(modules()))]
    assert not paths, "Files import each other; move what they share into a file below both:\n" + "\n".join(paths)


def test_circles_are_found() -> None:
    graph = {"a": ["b", "c"], "b": ["c"], "c": ["d"], "d": ["b"], "e": ["f"], "f": ["e", "a"], "g": ["a"]}
    assert circles(graph) == [["b", "c", "d", "b"], ["e", "f", "e"]]


def test_hidden_imports_count() -> None:
    source = "import a\nif TYPE_CHECKING:\n    import b\ndef f():\n    from c import d\n"
    assert sorted(imported_names(ast.parse(source))) == ["a", "b", "c.d"]


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_stay_small(package: str) -> None:
    folders = {path.parent for path in PACKAGES[package].rglob("*.py")}
    sizes = {folder: sum(path.name != "__init__.py" for path in folder.glob("*.py")) for folder in folders}
    crowded = [
        f"{folder.relative_to(ROOT)}: {size}" for folder, size in sorted(sizes.items()) if size > FILES_PER_FOLDER
    ]
    assert not crowded, f"More than {FILES_PER_FOLDER} modules in one folder; group them: {crowded}"
