"""Modules, objects and files that docstrings, comments, messages and pages name exist."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tests.paths import ROOT
from tests.test_structure import PACKAGES, modules

PLACES = modules()
"""File of each module by its dotted name."""
OURS = "|".join(PACKAGES)
NAME = re.compile(rf"(?<!`)`{{1,2}}((?:{OURS})(?:\.\w+)+)(?:\([^`]*\))?`{{1,2}}")
"""A dotted name between single or double backticks, also as a call."""
MEMBER = re.compile(r"(?<!`)`{1,2}([A-Z]\w+)\.(\w+)(?:\([^`]*\))?`{1,2}")
"""A member of a class, ``Recording.columns``; names of classes that are not ours are left alone."""
OF_OTHERS = {"NavMeshSettings.readFromJSON"}
"""Members of classes of others that have the name of one of ours."""
IMPORT = re.compile(rf"^\s*from ((?:{OURS})\b[\w.]*) import \(?([\w, ]+)", re.MULTILINE)
FILE = re.compile(
    r"(?<![\w/.-])((?:benchmarks|datasets|docs|examples|h3data|pipelines|sim_kinematic|tests|viewers)/[\w./-]+\.(?:py|md|toml|txt|sh))\b"
)
SOURCES = sorted(
    {*PLACES.values(), *(path for top in ("tests", "benchmarks", "examples") for path in ROOT.glob(f"{top}/**/*.py"))}
)
PAGES = sorted(
    {ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "SECURITY")}
    | {
        path
        for top in ("docs", "datasets", "pipelines")
        for path in ROOT.glob(f"{top}/**/*.md")
        if "written" not in path.parts
    }
)
"""CHANGELOG.md may tell of what is no more."""
NOT_OBJECTS = re.compile(
    r"h3data\.(tasks|robots|policies|profiles|formats|motions|episode_files|scenes|apps|commands|device_envs|trainers|executors"
    r"|notebooks|viewers|meshes|walks|slides|robot_files|robot_guesses|renderers|lidars|lights|gltf_codecs|stand_ins"
    r"|report_sections|policy_servers|routines|batch|schema_version|moments)"
)
"""Groups of entry points and keys in the metadata of files."""


@cache
def classes() -> dict[str, list[str]]:
    """Modules that define a class of a name."""
    found: dict[str, list[str]] = {}
    for module, path in PLACES.items():
        for name in re.findall(r"^class (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            found.setdefault(name, []).append(module)
    return found


def missing_member(name: str, member: str) -> bool:
    """Whether no class of this name has the member, although there is one."""
    modules_of = classes().get(name, [])
    return bool(modules_of) and not any(_has(module, [name, member]) for module in modules_of)


def missing_name(name: str) -> bool:
    """Whether a dotted name is neither a module nor what one defines, imports or has as a member of a class."""
    module = name
    while module and module not in PLACES:
        module = module.rpartition(".")[0]
    rest = name.removeprefix(module).lstrip(".").split(".") if name != module else []
    return bool(rest) and not _has(module, rest)


def _has(module: str, rest: list[str]) -> bool:
    found = definitions(module).get(rest[0])
    if found is None:
        return False
    if isinstance(found, str):  # imported from there
        owner, _, member = found.rpartition(".")
        if found in PLACES:
            return len(rest) == 1 or _has(found, rest[1:])
        return owner not in PLACES or _has(owner, [member, *rest[1:]])
    if len(rest) == 1 or not isinstance(found, ast.ClassDef):
        return True
    return _class_has(module, found, rest[1])


def _class_has(module: str, found: ast.ClassDef, member: str) -> bool:
    """Members are looked for in the class and in its bases; a base of another package may have any."""
    if member in _names(found.body):
        return True
    for node in ast.walk(found):  # self.member = ...
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and node.attr == member:
            return True
    for base in found.bases:
        place, name = module, ast.unparse(base).partition("[")[0]
        if "." in name:
            return True
        while isinstance(known := definitions(place).get(name), str):
            place, _, name = known.rpartition(".")
            if place not in PLACES:
                return True
        if known is None:
            if name not in ("Protocol", "Generic", "object"):
                return True
        elif isinstance(known, ast.ClassDef) and _class_has(place, known, member):
            return True
    return False


@cache
def definitions(module: str) -> dict[str, ast.AST | str]:
    """What a module defines, or the full name of what it imports."""
    return _names(ast.parse(PLACES[module].read_text(encoding="utf-8")).body)


def _names(body: list[ast.stmt]) -> dict[str, ast.AST | str]:
    found: dict[str, ast.AST | str] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                found |= {part.id: node for part in ast.walk(target) if isinstance(part, ast.Name)}
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {(alias.asname or alias.name): alias.name for alias in node.names}
        for inner in ("body", "orelse", "finalbody"):
            if isinstance(node, ast.If | ast.Try | ast.With):
                found |= _names(getattr(node, inner, []))
    return found


def faults_of(text: str, *, imports: bool = True) -> list[str]:
    """Dotted names in backticks, imports and files of this repository that do not exist."""
    names = {name for name in NAME.findall(text) if not NOT_OBJECTS.fullmatch(name)}
    unknown = {f"{name}.{member}" for name, member in MEMBER.findall(text) if missing_member(name, member)} - OF_OTHERS
    for module, members in IMPORT.findall(text) if imports else ():
        names |= {f"{module}.{member.split()[0]}" for member in members.split(",") if member.strip()}
    files = {file for file in FILE.findall(text) if not (ROOT / file).exists()}
    return sorted({name for name in names if missing_name(name)} | unknown | files)


@pytest.mark.parametrize("kind", ["sources", "pages"])
def test_what_is_named_exists(kind: str) -> None:
    files = SOURCES if kind == "sources" else PAGES
    faults = {}
    for path in set(files) - {Path(__file__)}:  # pyright and the tests themselves check imports of sources
        if found := faults_of(path.read_text(encoding="utf-8"), imports=kind == "pages"):
            faults[str(path.relative_to(ROOT))] = found
    assert not faults


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("`h3data.recording.Recording.columns`, ``h3data.make(task)``, `h3data.plugins`", []),
        ("`h3data.errors.InputError.args`, whose base is Python's", []),
        (
            "`sim_kinematic.world.World.step`, and through an import `sim_kinematic.tasks.social_nav.SocialNav.name`",
            [],
        ),
        ("entry points of `h3data.tasks`", []),
        ("`h3data.recording.Recordings`", ["h3data.recording.Recordings"]),
        ("``h3data.nowhere.at_all()``", ["h3data.nowhere.at_all"]),
        ("`h3data.recording.Recording.colums`", ["h3data.recording.Recording.colums"]),
        ("`Recording.columns`, `Nobody.knows_it`, `Recording.colums`", ["Recording.colums"]),
        ("from h3data.recording import Dataset, Datasets", ["h3data.recording.Datasets"]),
        ("see " + "tests/test_nothing.py and tests/test_files.py", ["tests/test_nothing" + ".py"]),
        ("trained by " + "pipelines/bake/nothing.sh", ["pipelines/bake/nothing" + ".sh"]),
    ],
)
def test_what_does_not_exist_is_found(text: str, found: list[str]) -> None:
    assert faults_of(text) == found
