"""What others need to know of a task, they ask the task: its name is written in its own folder and hardly anywhere else.

A task name counts where a string constant of `h3data`, `sim_kinematic`, a package of pipelines/ or one of viewers/ is equal to
the name of a task that comes with h3data (an entry point of ``h3data.tasks`` in pyproject.toml, where names and classes meet).
Docstrings, comments and longer texts, such as help, do not count; nor do the folder or module of the task's class, modules
of a package that brings only this task (`h3data_language`), and `OTHER_WORDS`, where the word means something else.
To list what is counted: ``python -m tests.test_task_names``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from h3data.plugins import own_entries
from tests.paths import ROOT

MOST = 5
"""Task names outside their own folders. The number may only fall."""
OTHER_WORDS = {
    "wander": {  # the policy of this name, which any task may give its agents
        "sim_kinematic/policies/assignment.py",
        "sim_kinematic/tasks/control.py",
        "sim_kinematic/tasks/task.py",
    },
    "rearrange": {"viewers/h3data_studies/design.py"},  # the app of this name; a study's server imports no task
    "language": {  # that of a participant, and the command
        "pipelines/h3data_pipelines/commands/table.py",
        "viewers/h3data_studies/commands/handing_out.py",
        "viewers/h3data_studies/commands/reporting.py",
        "viewers/h3data_studies/orders.py",
        "viewers/h3data_studies/views.py",
    },
}


def strings_of(source: str) -> Iterator[ast.Constant]:
    """Constants of a module that are strings, without lone strings, which are docstrings."""
    waiting: list[ast.AST] = [ast.parse(source)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node
        waiting += [
            child
            for child in ast.iter_child_nodes(node)
            if not (isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant))
        ]


def homes() -> dict[str, str]:
    """Beginning of the paths of a task's own files, by the name of the task."""
    found = {}
    for name, reference in own_entries("h3data.tasks").items():
        module = reference.partition(":")[0].split(".")
        folder = "/".join(["pipelines"] * (module[0] != "sim_kinematic") + module)
        if not (ROOT / folder).is_dir():  # a module: its folder, if that is only this task's
            single = len({of for of in own_entries("h3data.tasks").values() if of.startswith(f"{module[0]}.")}) == 1
            inside = folder.rpartition("/")[0]
            folder = inside if single or inside.endswith(name) else f"{folder}.py"
        found[name] = folder
    return found


def task_names() -> list[str]:
    """Places where a task is named outside its own files, as ``path:line name``."""
    own, found = homes(), []
    for top in ("h3data", "sim_kinematic", "pipelines", "viewers"):
        for path in sorted((ROOT / top).rglob("*.py")):
            file, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
            if not any(f'"{name}"' in text for name in own):
                continue
            found += [
                f"{file}:{node.lineno} {node.value}"
                for node in strings_of(text)
                if node.value in own
                and not f"{file}/".startswith(f"{own[str(node.value)]}/")
                and file not in OTHER_WORDS.get(str(node.value), ())
            ]
    return sorted(found)


def test_tasks_are_named_at_home() -> None:
    found = task_names()
    assert len(found) <= MOST, f"ask the task instead of comparing its name: {found}"
    assert len(found) >= MOST, "fewer than before: lower MOST"


def test_names_of_tasks_are_found(tmp_path: Path) -> None:
    source = '"""wander"""\nA = "wander"\n"""wander"""\ndef f(x="wander"):\n    "wander"\n    return {"wander": f"wander{x}"}\n'
    assert [node.lineno for node in strings_of(source) if node.value == "wander"].count(2) == 1
    assert sorted(node.lineno for node in strings_of(source) if node.value == "wander") == [2, 4, 6, 6]
    assert homes()["wander"] == "sim_kinematic/tasks/wander.py"
    assert homes()["rearrange"] == "sim_kinematic/tasks/rearrange"
    assert homes()["social_nav"] == "sim_kinematic/tasks/social_nav.py"
    assert homes()["crowd_nav"] == "pipelines/h3data_crowds/crowd_nav.py"
    assert homes()["language"] == "pipelines/h3data_language"


if __name__ == "__main__":
    print("\n".join(task_names()))
