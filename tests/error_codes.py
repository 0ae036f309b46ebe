"""Codes of errors: gives every kind of message one, and writes docs/errors.md (make error-codes).

A code stands at the place that raises: ``raise InputError(f"...", code="H3-SCENE-014")``. A new place is written without one;
this script adds it and formats the file. docs/errors.md is the record of all codes ever given: a message that is no longer
raised stays there, so that its number is not given again. Places whose messages have the same words have the same code. A place
that passes another error on has its code (``code=fault.code``) and is left alone.

The script may be run at any time, and changes nothing where every place has its code. After a merge in which two branches gave
the same number, the place that the page does not know gets another one. A place that lost its code gets it back, if its words
are still those of the page.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from h3data_pipelines.machine.pages import ErrorKind, error_kinds
from tests.paths import ROOT

PAGE = ROOT / "docs" / "errors.md"
ROOTS = ("h3data", "sim_kinematic", "pipelines", "viewers")
NOT_SHIPPED = ("pipelines/bake", "pipelines/h3data_kernels")
AREAS = {
    "SCENE": ("scenes and homes", "scenes", "h3data/scene pipelines/h3data_homes"),
    "MESH": ("meshes and images", "meshes", "h3data/mesh pipelines/h3data_meshes"),
    "BODY": (
        "people, robots and motion",
        "bodies",
        "h3data/bodies pipelines/h3data_motion pipelines/h3data_worlds/mjcf.py pipelines/h3data_pipelines/assets",
    ),
    "HABITAT": ("files of Habitat", "habitat", "pipelines/h3data_habitat"),
    "WORLD": ("scenes of other makers", "scenes", "pipelines/h3data_worlds"),
    "RECORDING": ("recordings and datasets", "format", "h3data/recording"),
    "REPLAY": ("replay", "replay", "h3data/replay"),
    "RENDER": (
        "pictures",
        "rendering",
        "h3data/render pipelines/h3data_gpu pipelines/h3data_light pipelines/h3data_rays pipelines/h3data_pipelines/pictures",
    ),
    "EXPORT": ("exports", "export", "pipelines/h3data_exporters pipelines/lerobot_env_h3data"),
    "ROS": ("bags of ROS 2, tracks and maps", "ros", "pipelines/h3data_ros"),
    "METRIC": ("metrics", "metrics", "h3data/metrics pipelines/h3data_social"),
    "STATS": ("statistics", "statistics", "h3data/stats"),
    "FORMAT": ("file formats", "format", "h3data/formats"),
    "FILE": ("files, folders and plug-ins", "extending", "h3data"),
    "SIM": ("agents and their world", "simulation", "sim_kinematic"),
    "TASK": ("tasks and episodes", "simulation", "sim_kinematic/tasks pipelines/h3data_crowds"),
    "POLICY": ("policies", "learned-policies", "sim_kinematic/policies"),
    "ENV": (
        "environments",
        "environments",
        "sim_kinematic/envs pipelines/h3data_training/torch pipelines/h3data_training/envs",
    ),
    "OPTION": ("commands and their options", "python", "h3data/commands pipelines/h3data_pipelines"),
    "JOB": ("jobs", "scale", "pipelines/h3data_pipelines/jobs pipelines/h3data_pipelines/execution"),
    "MACHINE": (
        "the installation and the machine",
        "troubleshooting",
        "pipelines/h3data_pipelines/machine h3data/kernels",
    ),
    "HUB": ("copies on hubs and in object stores", "sharing", "pipelines/h3data_pipelines/hub"),
    "TRAIN": ("training", "training", "pipelines/h3data_training"),
    "REMOTE": ("policy servers", "remote-policies", "pipelines/h3data_remote"),
    "LANGUAGE": ("tasks in words", "language", "pipelines/h3data_language"),
    "LLM": ("language models", "language", "pipelines/h3data_llm"),
    "VIEW": ("viewers and reports", "view", "viewers/h3data_viewers"),
    "PLAY": ("live play", "play", "viewers/h3data_play"),
    "STUDY": ("studies with people", "study", "viewers/h3data_studies"),
    "OTHER": ("errors without a code of their own", "extending", ""),
}
"""What the part in the middle of a code says: the subject, its page, and the folders where new messages get it."""
TO_DO = (
    re.compile(r"(?<=[.:;!?)}]) Hint: "),
    re.compile(
        r"(?<=[.;!?)}]) (?=(Add|Check|Choose|Close|Convert|Copy|Delete|Download|Free|Generate|Give|Install|Leave|Make|Move|"
        r"Name|Open|Pass|Put|Record|Reinstall|Remove|Rename|Run|Save|Select|Set|Start|Try|Update|Use|Wait|Write)\b)"
    ),
)
"""Where a message goes over to what the user should do."""
BY_CLASS = {
    "H3DataError": "Read the lines above the message; if they do not help, report a fault with the output of `h3data doctor`.",
    "InputError": "Correct the argument, the option or the file that the message names.",
    "FormatError": "See what the file is with `h3data info FILE`. If it is damaged, copy or download it again; "
    "`h3data recover` saves what is sound in a log. If it is newer than h3data, upgrade h3data.",
    "SceneError": "Correct the file that the message names, or use another home; `h3data scenes list` shows the included ones.",
    "MissingAssetError": "Give the folder that has the file with `--assets DIR`.",
    "MissingExtraError": "Install the extra that the message names.",
    "Refused": "Correct the option that the message names, or start the server again.",
    "PluginError": "Upgrade or uninstall the package that the message names.",
    "UntrustedNameError": "If you trust the source of the file, say so as the message shows.",
    "GpuError": "Check the driver with `h3data doctor`, or use the CPU.",
    "LostShardError": "Use fewer workers, so that each has more memory, and run the command again with `--resume`.",
    "DiskFullError": "Free some space and run the same command again.",
}
"""What to do about an error whose message does not say it, by class; others have what the class above them has."""
WITHOUT_BASE = ("Refused",)
"""Classes whose errors become an `H3DataError` in another process; their own does not import h3data."""
OTHER = ErrorKind("H3-OTHER-000", "H3DataError", "The message of a plug-in.", "Ask the authors of the plug-in.")
GONE = "No longer raised."


@dataclass(frozen=True)
class Place:
    """A call that makes an error."""

    path: Path
    call: ast.Call
    kind: ErrorKind
    """Its code is empty if none is written there."""


def shipped_files(root: Path) -> list[Path]:
    """The modules that users run."""
    files = sorted(path for name in ROOTS for path in (root / name).rglob("*.py"))
    return [
        f for f in files if not f.relative_to(root).as_posix().startswith(NOT_SHIPPED) and "node_modules" not in f.parts
    ]


@dataclass(frozen=True)
class Sources:
    """The modules that have to do with errors."""

    trees: dict[Path, ast.Module]
    classes: dict[str, ast.ClassDef]
    """The classes below `H3DataError`, by name."""


def read_sources(files: Iterable[Path]) -> Sources:
    """Parses the modules that mention an error with a parenthesis behind it; parsing all would take five times as long."""
    texts = {path: path.read_text(encoding="utf-8") for path in files}
    bases = dict(each for text in texts.values() for each in re.findall(r"^class (\w+)\((.+)\):", text, re.MULTILINE))
    names = {"H3DataError", *WITHOUT_BASE}
    while more := {name for name, of in bases.items() if name not in names and names & set(re.findall(r"\w+", of))}:
        names |= more
    mentioned = re.compile(rf"\b({'|'.join(names)})\(")
    trees = {path: ast.parse(text) for path, text in texts.items() if mentioned.search(text)}
    top = [node for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)]
    return Sources(trees, {node.name: node for node in top if node.name in names})


def places(sources: Sources) -> list[Place]:
    """All calls that make errors of classes below `H3DataError`, except those that pass a code on."""
    return [place for path, tree in sources.trees.items() for place in _places_in(path, tree, sources.classes)]


def _own_init(error: ast.ClassDef) -> ast.FunctionDef | None:
    """The ``__init__`` of a class that writes its message itself."""
    for node in error.body:
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            return None if any(a.arg == "code" for a in node.args.kwonlyargs) else node
    return None


def _places_in(path: Path, tree: ast.Module, classes: dict[str, ast.ClassDef]) -> Iterator[Place]:
    nodes = list(ast.walk(tree))
    templates = Templates(nodes)
    for node in nodes:
        if isinstance(node, ast.ClassDef) and node.name in classes and (init := _own_init(node)):
            calls = [(node.name, call) for call in ast.walk(init) if _is_super_init(call)]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            name = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
            calls = [(name, node)] if name in classes and not _own_init(classes[name]) else []
        else:
            continue
        for error, call in calls:
            assert isinstance(call, ast.Call)
            given = next((k.value for k in call.keywords if k.arg == "code"), None)
            if given is None or isinstance(given, ast.Constant):
                text, to_do = split(templates.of(call.args[0], call) if call.args else "{...}")
                yield Place(path, call, ErrorKind(str(given.value) if given else "", error, text, to_do))


def _is_super_init(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func) == "super().__init__"


class Templates:
    """What the messages of a module say, as far as its source tells."""

    def __init__(self, nodes: Sequence[ast.AST]) -> None:
        self.functions = {n.name: n for n in nodes if isinstance(n, ast.FunctionDef)}
        module = nodes[0]
        assert isinstance(module, ast.Module)
        self.constants = _assigned(module.body)

    def local(self, place: ast.expr) -> dict[str, ast.expr]:
        """What the function around an expression assigns."""
        around = [f for f in self.functions.values() if f.lineno <= place.lineno <= (f.end_lineno or 0)]
        return _assigned([node for function in around for node in ast.walk(function)])

    def of(self, node: ast.expr, place: ast.expr, depth: int = 0) -> str:
        """The words of an expression, with the names of its variables in braces."""
        unknown = f"{{{_name(node)}}}"
        if depth > 3:
            return unknown
        match node:
            case ast.Constant(value=str(text)):
                return text
            case ast.JoinedStr():
                return "".join(self.of(part, place, depth) for part in node.values)
            case ast.FormattedValue():
                return f"{{{_name(node.value)}}}"
            case ast.BinOp(op=ast.Add()):
                return self.of(node.left, place, depth) + self.of(node.right, place, depth)
            case ast.IfExp():
                return f"{self.of(node.body, place, depth)} / {self.of(node.orelse, place, depth)}"
            case ast.Name(id=name):
                value = self.local(place).get(name) or self.constants.get(name)
                return self.of(value, place, depth + 1) if value is not None else unknown
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in self.functions:
                returned = [n.value for n in ast.walk(self.functions[name]) if isinstance(n, ast.Return) and n.value]
                texts = [self.of(value, value, depth + 1) for value in returned]
                return " / ".join(text for text in texts if text) or unknown
            case ast.Call(func=ast.Name(), args=[argument]):
                return self.of(argument, place, depth)
            case _:
                return unknown


def _assigned(nodes: Sequence[ast.AST]) -> dict[str, ast.expr]:
    """Expressions by the names that they are assigned to."""
    return {
        node.targets[0].id: node.value
        for node in nodes
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }


def _name(node: ast.expr) -> str:
    text = ast.unparse(node)
    return text if re.fullmatch(r"[\w.]{1,40}(\[-?\w+\])?", text) else "..."


def split(text: str) -> tuple[str, str]:
    """A message as what it says, and what it says to do."""
    text = " ".join(text.split())
    for mark in TO_DO:
        if found := mark.search(text):
            to_do = re.sub(
                r"(:|(?<=[.)]) \w+:) \{[\w.]+\}$", "", text[found.end() :]
            )  # the file, which the user sees in the message
            is_sentence = re.match(r"(?!h3data |pip |python )[a-z]+ ", to_do)
            return text[: found.start()], to_do[:1].upper() + to_do[1:] if is_sentence else to_do
    return text, ""


def has_words(kind: ErrorKind) -> bool:
    """Whether a message has words of its own, so that two places with the same ones say the same."""
    return len(re.findall(r"[A-Za-z]{2,}", re.sub(r"\{[^{}]*\}", " ", kind.text))) > 1


# --- the page ---------------------------------------------------------------------------------------------------------
HEAD = """# Error messages

<!-- written by `make error-codes` -->

Every error has a code. A command prints it after the message:

```text
error: Unknown task 'wandr'. Did you mean 'wander'? [H3-FILE-011]
```

`h3data docs H3-FILE-011` prints the entry of a code. In Python, the code is `error.code`, and a traceback shows it in a line
below the message. With `--json`, a command that is refused prints `{"error": ..., "code": ...}`. Records of failed episodes and
refusals in live play have the code too. It stays the same when the words of a message change, so scripts should compare codes.

All errors that you can correct are of the class `H3DataError`. `H3-OTHER-000` is the code of an error that is raised without
one, for example by a plug-in. Words in braces stand for what a message names.

| class | meaning | what to do, if the message does not say |
|---|---|---|
"""


def written_page(kinds: Iterable[ErrorKind], classes: dict[str, tuple[str, str]]) -> str:
    """The page: each kind of message below its area."""
    page = HEAD + "".join(f"| `{name}` | {_cell(a)} | {_cell(b)} |\n" for name, (a, b) in sorted(classes.items()))
    by_area: dict[str, list[ErrorKind]] = {}
    for kind in sorted(kinds, key=lambda kind: number(kind.code)):
        by_area.setdefault(kind.code.split("-")[1], []).append(kind)
    for area, (about, see, _) in sorted(AREAS.items()):
        if area not in by_area:
            continue
        rows = by_area[area]
        page += f"\n## {area}: {about}\n\nSee [{see}]({see}.md). "
        page += f"The next code is {code_of(area, number(rows[-1].code) + 1)}.\n\n"
        page += "| code | class | message | what to do |\n|---|---|---|---|\n"
        page += "".join(f"| {k.code} | `{k.error}` | {_cell(k.text)} | {_cell(k.to_do)} |\n" for k in rows)
    return page


def number(code: str) -> int:
    """The number of a code within its area."""
    return int(code.rpartition("-")[2])


def code_of(area: str, number: int) -> str:
    """A code in full."""
    return f"H3-{area}-{number:03d}"


def _cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    text = text.replace("|", r"\|")
    return "".join(
        part if part.startswith("`") else part.replace("*", r"\*").replace("<", "&lt;")
        for part in re.split(r"(`[^`]*`)", text)
    )


def about_classes(sources: Sources) -> dict[str, tuple[str, str]]:
    """What each class of errors means, and what to do about one."""
    classes, about = sources.classes, {}
    for name, node in classes.items():
        meaning = " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())
        while node.name not in BY_CLASS:
            node = next(classes[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in classes)
        about[name] = (meaning, BY_CLASS[node.name])
    return about


# --- giving codes -----------------------------------------------------------------------------------------------------
def area_of(path: str) -> str:
    """The area of new messages of a file: that of the innermost folder which has one."""
    found = [
        (len(folder), area)
        for area, (_, _, folders) in AREAS.items()
        for folder in folders.split()
        if f"{path}/".startswith(f"{folder}/")
    ]
    assert found, f"{path} has no area: add its folder to AREAS in tests/error_codes.py"
    return max(found)[1]


def assign(there: Sequence[Place], known: Sequence[ErrorKind], root: Path) -> list[tuple[Place, str]]:
    """The code that each place should have. Numbers on the page are never given again."""
    on_page = {kind.code: kind for kind in known}
    owners: dict[str, ErrorKind] = {}
    """By code, the kind that has it: of two places with the same code the one that the page knows, or the first."""
    for place in there:
        if (code := place.kind.code) and (code not in owners or on_page.get(code) == place.kind):
            owners[code] = place.kind
    last = dict.fromkeys(AREAS, 0)
    for code in (*on_page, *owners):
        _, area, _ = code.split("-")
        last[area] = max(last[area], number(code))
    free: dict[tuple[str, str], list[str]] = {}
    """Codes that no place has, by class and words; the first is given first."""
    for kind in known:
        if kind.code not in owners:
            free.setdefault((kind.error, kind.text), []).append(kind.code)
    by_words = {(kind.error, kind.text): [code] for code, kind in owners.items() if has_words(kind)}
    given = []
    for place in there:
        kind = place.kind
        words = (kind.error, kind.text)
        owner = owners.get(kind.code)
        if owner is kind or (owner is not None and has_words(kind) and (owner.error, owner.text) == words):
            code = kind.code
        elif by_words.get(words):
            code = by_words[words][0]
        elif free.get(words):
            code = free[words].pop(0)
        else:
            area = area_of(place.path.relative_to(root).as_posix())
            last[area] += 1
            code = code_of(area, last[area])
        if has_words(kind):
            by_words[words] = [code]
        given.append((place, code))
    return given


def kinds_of(given: Iterable[tuple[Place, str]], known: Iterable[ErrorKind]) -> list[ErrorKind]:
    """What the page lists: the kinds that are raised, and those that were."""
    raised = {OTHER.code: OTHER}
    for place, code in given:
        raised.setdefault(code, place.kind._replace(code=code))
    return [*raised.values(), *(kind._replace(to_do=GONE) for kind in known if kind.code not in raised)]


def page_of(given: Iterable[tuple[Place, str]], known: Iterable[ErrorKind], sources: Sources) -> str:
    """The page as it should be."""
    return written_page(kinds_of(given, known), about_classes(sources))


def with_codes(source: str, codes: Iterable[tuple[ast.Call, str]]) -> str:
    """A module whose calls have these codes."""
    lines = source.encode().splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def at(line: int, column: int) -> int:
        return starts[line - 1] + column

    text = source.encode()
    for call, code in sorted(codes, key=lambda each: (each[0].end_lineno, each[0].end_col_offset), reverse=True):
        assert call.end_lineno is not None
        assert call.end_col_offset is not None
        old = next((k.value for k in call.keywords if k.arg == "code"), None)
        if old is not None:
            assert old.end_lineno is not None
            assert old.end_col_offset is not None
            begin, end, new = at(old.lineno, old.col_offset), at(old.end_lineno, old.end_col_offset), f'"{code}"'
        else:
            begin = end = at(call.end_lineno, call.end_col_offset) - 1  # before the parenthesis
            written = max(call.args + [k.value for k in call.keywords], key=lambda a: (a.end_lineno, a.end_col_offset))
            assert written.end_lineno is not None
            assert written.end_col_offset is not None
            rest = re.sub(rb"#[^\n]*", b"", text[at(written.end_lineno, written.end_col_offset) : end])
            new = f'code="{code}"' if rest.rstrip().endswith(b",") else f', code="{code}"'
        text = text[:begin] + new.encode() + text[end:]
    return text.decode()


def main(root: Path = ROOT) -> int:
    """Writes codes into the sources, and the page."""
    page = root / PAGE.relative_to(ROOT)
    sources = read_sources(shipped_files(root))
    known = error_kinds(page.read_text(encoding="utf-8")) if page.exists() else []
    given = assign(places(sources), known, root)
    changed: dict[Path, list[tuple[ast.Call, str]]] = {}
    for place, code in given:
        if place.kind.code != code:
            changed.setdefault(place.path, []).append((place.call, code))
    for path, codes in changed.items():
        path.write_text(with_codes(path.read_text(encoding="utf-8"), codes), encoding="utf-8")
    if changed:
        subprocess.run([sys.executable, "-m", "ruff", "format", "-q", *changed], check=True, cwd=ROOT)
    page.write_text(page_of(given, known, sources), encoding="utf-8")
    print(
        f"{sum(map(len, changed.values()))} codes written in {len(changed)} files; {page.relative_to(root)} lists all"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
