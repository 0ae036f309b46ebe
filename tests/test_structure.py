"""The shape of the house: no circles of imports, none hidden in strings, no folder that outgrows a table of contents."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.statements import CORE, LIMIT, NAMES_LIMIT, by_package, count_names, count_statements, names_per_1000_lines

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "h3data": ROOT / "h3data",
    "sim_kinematic": ROOT / "sim_kinematic",
    "h3data_viewers": ROOT / "viewers" / "h3data_viewers",
    "h3data_play": ROOT / "viewers" / "h3data_play",
    "h3data_studies": ROOT / "viewers" / "h3data_studies",
    "h3data_crowds": ROOT / "pipelines" / "h3data_crowds",
    "h3data_exporters": ROOT / "pipelines" / "h3data_exporters",
    "h3data_gpu": ROOT / "pipelines" / "h3data_gpu",
    "h3data_homes": ROOT / "pipelines" / "h3data_homes",
    "h3data_habitat": ROOT / "pipelines" / "h3data_habitat",
    "h3data_light": ROOT / "pipelines" / "h3data_light",
    "h3data_meshes": ROOT / "pipelines" / "h3data_meshes",
    "h3data_motion": ROOT / "pipelines" / "h3data_motion",
    "h3data_worlds": ROOT / "pipelines" / "h3data_worlds",
    "h3data_training": ROOT / "pipelines" / "h3data_training",
    "h3data_rays": ROOT / "pipelines" / "h3data_rays",
    "h3data_remote": ROOT / "pipelines" / "h3data_remote",
    "h3data_ros": ROOT / "pipelines" / "h3data_ros",
    "h3data_language": ROOT / "pipelines" / "h3data_language",
    "h3data_llm": ROOT / "pipelines" / "h3data_llm",
    "h3data_social": ROOT / "pipelines" / "h3data_social",
    "h3data_pipelines": ROOT / "pipelines" / "h3data_pipelines",
    "h3data_kernels": ROOT / "pipelines" / "h3data_kernels",
    "bake": ROOT / "pipelines" / "bake",
}
LAYERS = (
    "h3data",
    "sim_kinematic",
    "h3data_exporters",
    "h3data_gpu",
    "h3data_homes",
    "h3data_habitat",
    "h3data_light",
    "h3data_meshes",
    "h3data_motion",
    "h3data_rays",
    "h3data_social",
    "h3data_worlds",
    "h3data_ros",
    "h3data_viewers",
    "h3data_play",
    "h3data_studies",
    "h3data_training",
    "h3data_remote",
    "h3data_crowds",
    "h3data_language",
    "h3data_llm",
    "h3data_pipelines",
)
"""Packages from the lowest to the highest."""
FACES = ("h3data.envs", "h3data.policies", "h3data.robots", "h3data.scenes", "h3data.sensors", "h3data.tasks")
"""What h3data offers to those who extend it, of modules that may move."""
AGAINST_THE_LAYERS = {
    "h3data": [
        "h3data_homes",
        "h3data_pipelines.api",
        "h3data_viewers.api",
        "sim_kinematic.envs.make",
        "sim_kinematic.tasks.sessions",
    ],
    "h3data.envs": [
        "h3data_training.envs.dataset_env",
        "sim_kinematic.envs.make",
        "sim_kinematic.envs.parallel",
        "sim_kinematic.envs.single",
        "sim_kinematic.envs.stepper",
        "sim_kinematic.envs.vector",
    ],
    "h3data.kernels.digests": [
        "h3data_crowds",
        "h3data_gpu",
        "h3data_habitat",
        "h3data_light",
        "h3data_meshes",
        "h3data_pipelines",
        "sim_kinematic",
    ],  # whose kernels are ours
    "h3data.plugins": ["h3data_pipelines"],  # whether a command runs
    "h3data.scene.scene_file": ["h3data.scene"],  # no module: the name of the file format
    "h3data.scenes": ["h3data_homes"],
}
"""Modules that name a module above them, or one that imports them, in a string, and so hide an import from import-linter.

Each is a debt, and the aim is an empty table: turn the arrow round by a registry with an entry point (`h3data.plugins`), and
delete the line here.
"""
BLOCKS = (ast.stmt, ast.ExceptHandler, ast.match_case)
"""Where imports are; most of a tree is expressions, which have none."""
DOTTED = re.compile(rf"(?:{'|'.join(PACKAGES)})(?:\.\w+)*")
QUOTED = re.compile(rf"[\"'](?:{'|'.join(PACKAGES)})[\"'.]")
MEMBERS_OF_TASK = 17
"""Attributes and methods of `sim_kinematic.tasks.task.Task`."""
FILES_PER_FOLDER = 15
"""Modules per folder, `__init__.py` not counted."""
MATCHES_WITHOUT_A_CODE = 14
"""Tests of our errors that match words alone. The number may only fall.

Errors that a test or a script raises itself have no code.
"""


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


def names_in_strings(tree: ast.Module) -> Iterator[str]:
    """Dotted names of our packages in strings, and beginnings of f-strings up to the last dot: ``f"sim_kinematic.{name}"``.

    Left out are names of loggers and of groups of entry points, which are no modules.
    """
    names_of_others: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args:
            if getattr(node.func, "attr", getattr(node.func, "id", "")) in ("getLogger", "Registry"):
                names_of_others.add(node.args[0])
        elif isinstance(node, ast.JoinedStr) and node.values and isinstance(node.values[0], ast.Constant):
            names_of_others.add(node.values[0])
            text, dot, _ = str(node.values[0].value).rpartition(".")
            if dot and DOTTED.fullmatch(text):
                yield text
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in names_of_others:
            text = node.value.partition(":")[0]
            if DOTTED.fullmatch(text):
                yield text


def hidden_arrows(paths: dict[str, Path], graph: dict[str, list[str]]) -> dict[str, list[str]]:
    """What each module names in strings although it is of a higher layer, or imports that module itself."""
    found: dict[str, set[str]] = {}
    for name, path in paths.items():
        text = path.read_text(encoding="utf-8")
        package = name.partition(".")[0]
        if package not in LAYERS or not QUOTED.search(text):
            continue
        for target in names_in_strings(ast.parse(text)):
            while target not in paths:
                target = target.rpartition(".")[0]
            above = target.partition(".")[0]
            if above not in LAYERS:
                continue
            higher = LAYERS.index(above) - LAYERS.index(package)
            if higher > 0 or (higher == 0 and name in _reachable(graph, target) and target not in (name, package)):
                found.setdefault(name, set()).add(target)
    return {name: sorted(targets) for name, targets in sorted(found.items())}


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


@pytest.fixture(scope="module")
def graph() -> dict[str, list[str]]:
    return import_graph(modules())


def test_no_import_circles(graph: dict[str, list[str]]) -> None:
    paths = [" -> ".join(path) for path in circles(graph)]
    assert not paths, "Files import each other; move what they share into a file below both:\n" + "\n".join(paths)


def test_public_faces_hold_imports_only_and_are_for_others(graph: dict[str, list[str]]) -> None:
    inside = [name for name in graph if re.match(r"(h3data|sim_kinematic)(\.|$)", name)]
    assert {name: faces for name in inside if (faces := {*graph[name]} & {*FACES})} == {}
    for face in FACES:
        file = ROOT / face.replace(".", "/")
        tree = ast.parse(
            (file / "__init__.py" if file.is_dir() else file.with_suffix(".py")).read_text(encoding="utf-8")
        )
        own = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        assert [node.name for node in own if node.name != "__getattr__"] == []
        module = importlib.import_module(face)
        assert all(getattr(module, name) is not None for name in module.__all__)


def test_circles_are_found() -> None:
    graph = {"a": ["b", "c"], "b": ["c"], "c": ["d"], "d": ["b"], "e": ["f"], "f": ["e", "a"], "g": ["a"]}
    assert circles(graph) == [["b", "c", "d", "b"], ["e", "f", "e"]]


def test_hidden_imports_count() -> None:
    source = "import a\nif TYPE_CHECKING:\n    import b\ndef f():\n    from c import d\n"
    assert sorted(imported_names(ast.parse(source))) == ["a", "b", "c.d"]


def test_no_new_import_is_hidden_in_a_string(graph: dict[str, list[str]]) -> None:
    found = hidden_arrows(modules(), graph)
    found.pop("h3data.moved", None)  # it names modules only to say what they are called now, and imports none of them
    new, gone = (
        {name: sorted({*a[name]} - {*b.get(name, ())}) for name in a if {*a[name]} - {*b.get(name, ())}}
        for a, b in ((found, AGAINST_THE_LAYERS), (AGAINST_THE_LAYERS, found))
    )
    assert not new, f"These modules name what lies above them; use a registry with an entry point: {new}"
    assert not gone, f"No longer hidden, so delete them from AGAINST_THE_LAYERS: {gone}"


def test_imports_in_strings_are_found(tmp_path: Path) -> None:
    low, high = tmp_path / "low.py", tmp_path / "high.py"
    high.touch()
    paths = {"h3data": high, "h3data.low": low, "h3data.high": high, "sim_kinematic": high, "sim_kinematic.world": high}
    graph = {"h3data.high": ["h3data.low"], **{name: [] for name in paths if name != "h3data.high"}}
    for source, targets in (
        ('importlib.import_module("sim_kinematic.world")', ["sim_kinematic.world"]),
        ('HOMES = {"World": "sim_kinematic.world:World"}', ["sim_kinematic.world"]),
        ('import_module(f"sim_kinematic.{name}")', ["sim_kinematic"]),
        ('[sys.executable, "-m", "sim_kinematic.world"]', ["sim_kinematic.world"]),
        ('TABLE = {"a": "h3data.high.function"}', ["h3data.high"]),
        ('logging.getLogger("sim_kinematic.world"); Registry("sim_kinematic.world", {})', []),
        ('f"{__name__}.high"; "of sim_kinematic.world"; "h3data.low"', []),
    ):
        low.write_text(source)
        assert hidden_arrows(paths, graph).get("h3data.low", []) == targets, source


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_stay_small(package: str) -> None:
    folders = {path.parent for path in PACKAGES[package].rglob("*.py")}
    sizes = {folder: sum(path.name != "__init__.py" for path in folder.glob("*.py")) for folder in folders}
    crowded = [
        f"{folder.relative_to(ROOT)}: {size}" for folder, size in sorted(sizes.items()) if size > FILES_PER_FOLDER
    ]
    assert not crowded, f"More than {FILES_PER_FOLDER} modules in one folder; group them: {crowded}"


def headless(text: str) -> list[str]:
    """Docstrings and entries of arguments that begin with a question word or with "of", in the text of a module."""
    return [
        found
        for docstring in re.findall(r'^ *r?"""(.*?)"""', text, re.MULTILINE | re.DOTALL)
        for found in re.findall(
            r"\A(?:How|Of|What|Where|Whether)\b.*|^ +\*{0,2}\w+: (?:How|Of|What|Where|Whether) .*",
            docstring,
            re.MULTILINE,
        )
    ]


def test_docstrings_begin_with_what_they_describe() -> None:
    """They are read alone, in an editor and in tables of the reference: "Number of steps", not "How many"."""
    found = {name: headless(path.read_text(encoding="utf-8")) for name, path in modules().items()}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_docstrings_that_cannot_stand_alone_are_found() -> None:
    source = 'class A:\n    """A thing."""\n\n    b: int\n    """How many."""\n    c: int\n    """Of whom."""\n'
    entries = 'def f(a):\n    """Does it.\n\n    Args:\n        b: What it is.\n        c: The one.\n    """\n'
    assert headless(source + entries) == ["How many.", "Of whom.", "        b: What it is."]


def matches_without_a_code(text: str) -> list[int]:
    """Lines of ``pytest.raises(OurError, match=...)`` that match no code, in the text of a module of tests.

    The code is in the pattern, or in a table that the function around it is parametrized with.
    """
    tree, lines = ast.parse(text), text.splitlines()
    ours: set[str] = set()
    tables: list[str] = []
    """Names at the top of the module whose values hold codes."""
    functions: list[ast.FunctionDef | ast.AsyncFunctionDef] = []
    for node in tree.body:
        match node:
            case ast.ImportFrom(module=str(module), names=names) if module.partition(".")[0] in PACKAGES:
                ours |= {alias.name for alias in names if alias.name.endswith("Error")}
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                if any("H3-" in line for line in lines[node.lineno - 1 : node.end_lineno]):
                    tables.append(name)
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                functions.append(node)
    has_code = re.compile("|".join(["H3-", *(rf"\b{name}\b" for name in tables)]))
    found = []
    for function in functions:
        first = min(part.lineno for part in [function, *function.decorator_list])
        body = "\n".join(lines[first - 1 : function.end_lineno])
        for call in ast.walk(function) if "match=" in body else ():
            if not isinstance(call, ast.Call) or not (pattern := [k.value for k in call.keywords if k.arg == "match"]):
                continue
            errors = {
                node.id for argument in call.args[:1] for node in ast.walk(argument) if isinstance(node, ast.Name)
            }
            written = "\n".join(lines[pattern[0].lineno - 1 : pattern[0].end_lineno])
            has_table = not isinstance(pattern[0], ast.Constant) and has_code.search(body)
            if ours & errors and "H3-" not in written and not has_table:
                found.append(call.lineno)
    return sorted({*found})


def test_errors_are_matched_by_their_codes() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if "match=" in (text := path.read_text(encoding="utf-8"))
        for line in matches_without_a_code(text)
    ]
    assert len(found) <= MATCHES_WITHOUT_A_CODE, found
    assert len(found) >= MATCHES_WITHOUT_A_CODE, "fewer than before: lower MATCHES_WITHOUT_A_CODE"


def test_matches_without_a_code_are_found() -> None:
    source = (
        "from h3data.errors import InputError\n"
        "T = ['H3-SIM-001']\n"
        "def a():\n    pytest.raises(InputError, match='words')\n    pytest.raises(InputError, match='H3-SIM-001')\n"
        "def b(words):\n    pytest.raises(InputError, match=words)\n    pytest.raises(ValueError, match='x')\n"
        "@pytest.mark.parametrize('code', T)\ndef c(code):\n    pytest.raises(InputError, match=code)\n"
    )
    assert matches_without_a_code(source) == [4, 7]


def test_the_map_names_every_folder_and_every_registry() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = {part for span in re.findall(r"(?<!`)`([^`\n]+)`", text) for part in re.findall(r"[\w.]+", span)}
    faces = {face.partition(".")[2] for face in FACES}
    folders = {name.split(".")[1] for name in modules() if name.count(".") > 1 and name.startswith(tuple(LAYERS))}
    assert sorted(folders - named - faces) == []
    source = "".join(path.read_text(encoding="utf-8") for path in modules().values())
    groups = {*re.findall(r'Registry\(\s*"(h3data\.\w+)"', source)}
    assert len(groups) > 10
    assert sorted(groups - named) == []


def test_a_task_is_a_short_list() -> None:
    """Whoever writes a task reads all of it; what belongs together is one member, such as `Task.codec`."""
    from sim_kinematic.tasks.task import Task

    members = [name for name in vars(Task) if not name.startswith("_")]
    assert len(members) <= MEMBERS_OF_TASK, sorted(members)


def test_no_hook_of_tasks_is_for_one_task_alone() -> None:
    from examples import fetch, point_goal
    from h3data.tasks import find_task
    from sim_kinematic.tasks.task import Task

    named = ("social_nav", "rearrange", "wander", "language", "crowd_nav", "scenarios")
    tasks = {cls for task in map(find_task, named) for cls in type(task).__mro__ if issubclass(cls, Task)} - {Task}
    tasks |= {fetch.Fetch, point_goal.PointGoal}
    members = [name for name in vars(Task) if not name.startswith("_")]
    users = {member: [cls.__name__ for cls in tasks if member in vars(cls)] for member in members}
    assert {member: own for member, own in users.items() if len(own) == 1} == {}


def test_statements_are_counted_without_lone_strings() -> None:
    source = '"""Module."""\nA = 1\n"""Field."""\ndef f():\n    """Does it."""\n    if A:\n        return 2\n'
    assert count_statements(source) == 4
    assert {"h3data", "sim_kinematic", "h3data_viewers", "h3data_pipelines"} <= {*by_package(ROOT)}


def test_what_a_newcomer_reads_does_not_grow() -> None:
    """What only one other package uses, a format of others or a task beside the paper's belongs above the core."""
    counts = by_package(ROOT)
    assert sum(counts[name] for name in CORE) <= LIMIT, "see `python -m tests.statements`"


def test_names_are_counted_at_the_top_of_modules() -> None:
    assert count_names("A = 1\nB: int = 2\nC, D = 3, 4\ndef f():\n    e = 5\nclass G:\n    h = 6\n") == 4


def test_a_newcomer_meets_no_more_names() -> None:
    """A constant or helper of one function belongs into it, those of one module into a record."""
    assert names_per_1000_lines(ROOT) <= NAMES_LIMIT, "see `python -m tests.statements`"
