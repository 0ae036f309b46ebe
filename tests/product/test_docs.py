"""Commands, files and make targets that README and docs quote exist; Python blocks parse, some pages run."""

from __future__ import annotations

import ast
import inspect
import json
import re
import runpy
import shlex
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import h3data
from h3data.commands.command import Group, missing_lines
from h3data.commands.options import options_of
from h3data.errors import InputError
from h3data.metrics.registry import find_profile
from h3data_pipelines.cli import main
from h3data_pipelines.commands.table import all_commands
from h3data_pipelines.parsing import parse
from tests.paths import DOCS, ROOT

COMMANDS = all_commands()

BLOCK = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`(h3data [^`]+)`")
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("tutorials/*.md"))]
OTHER_PAGES = [ROOT / f"{name}.md" for name in ("ARCHITECTURE", "CONTRIBUTING", "SECURITY")]
OTHER_PAGES += sorted(ROOT.glob("datasets/**/*.md"))
NOTEBOOKS = sorted(DOCS.glob("notebooks/*.ipynb"))
RUN = ("python.md",)
"""Pages whose Python blocks run one after the other, as a reader runs them."""


def commands(page: Path) -> list[list[str]]:
    """Words of every command of h3data in the shell blocks of a page."""
    lines: list[list[str]] = []
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind in ("bash", "console", "sh", ""):
            for line in text.replace("\\\n", " ").splitlines():
                for part in re.split(r"&&|\|(?=\s)|;(?=\s)", line.partition(" #")[0]):
                    words = shlex.split(part)
                    if words[:1] == ["h3data"]:
                        lines.append(words[1 : words.index(">") if ">" in words else None])
    return lines


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_the_docs_exist(page: Path) -> None:
    for words in commands(page):
        if words[0] == "lengths":
            continue  # the command that docs/extending.md adds
        try:
            parse([word for word in words if word != "..."], COMMANDS, about="")
        except InputError as error:
            pytest.fail(f"h3data {' '.join(words)}: {error}")
        except SystemExit:  # --help, --version
            pass


def quoted(page: Path) -> list[str]:
    """Commands of h3data in the prose of a page, ``h3data plan generate ... --cores 1000``."""
    return [" ".join(span.split()) for span in SPAN.findall(BLOCK.sub("", page.read_text(encoding="utf-8")))]


def fault_of(line: str) -> str:
    """The command or flag in a line of prose that does not exist; empty if all do. Lines of prose may leave out the rest."""
    words, table = shlex.split(line)[1:], COMMANDS
    while words and not words[0].startswith("-"):
        alternatives, words = words[0].split("|"), words[1:]
        if missing := [name for name in alternatives if name not in table]:
            return missing[0]
        command = table[alternatives[0]]
        if not isinstance(command, Group):
            flags = {"--config", "--quiet", "--help"}.union(*(option.flags for option in options_of(command)))
            given = [flag for word in words for flag in word.strip("[],.").partition("=")[0].split("|")]
            return next((flag for flag in given if re.match(r"--?[a-z]", flag) and flag not in flags), "")
        table = command.commands
    return ""


@pytest.mark.parametrize("page", [*PAGES, *OTHER_PAGES], ids=lambda page: page.name)
def test_commands_in_the_prose_exist(page: Path) -> None:
    assert {line: fault for line in quoted(page) if (fault := fault_of(line))} == {}


def all_flags() -> set[str]:
    """Options of all commands and scripts."""
    scripts = [path for top in ("benchmarks", "examples", "pipelines/bake") for path in ROOT.glob(f"{top}/**/*.py")]
    scripts += [ROOT / "tests" / "fingerprints.py", ROOT / "pyproject.toml"]
    flags = {flag for path in scripts for flag in re.findall(r'"(--[a-z-]+)[" ]', path.read_text(encoding="utf-8"))}
    for top in COMMANDS.values():
        for command in top.commands.values() if isinstance(top, Group) else [top]:
            flags |= {flag for option in options_of(command) for flag in option.flags}
    return flags | {"--config", "--help", "--quiet", "--trust", "--version"}


def bare_options(text: str) -> set[str]:
    """Options that the prose of a page names without their command: `--max-steps 40`."""
    return set(re.findall(r"`(--[a-z][a-z-]*[a-z])", BLOCK.sub("", text)))


def test_options_in_the_prose_exist() -> None:
    flags = all_flags() | {"--durations", "--compile"}  # of pytest, of an example
    named = {page.name: bare_options(page.read_text(encoding="utf-8")) for page in [*PAGES, *OTHER_PAGES]}
    del named["errors.md"]  # it also lists messages of earlier versions
    assert sum(map(len, named.values())) > 200
    assert {page: sorted(options - flags) for page, options in named.items() if options - flags} == {}
    assert bare_options("`--zsc a,b`, `--seed 1`") - flags == {"--zsc"}


def test_commands_in_the_tables_of_the_readme_are_complete() -> None:
    """A reader copies them: nothing that a command requires may be missing."""
    rows = [line for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    lines = [line for row in rows for line in SPAN.findall(row)]
    assert len(lines) > 12
    for line in lines:
        parse(shlex.split(line)[1:], COMMANDS, about="")


def test_what_does_not_exist_is_found() -> None:
    assert fault_of("h3data generate ... --episodes 5 -o DIR") == ""
    assert fault_of("h3data metrics list|explain NAME") == ""
    assert fault_of("h3data scenes show small:3 --bogus") == "--bogus"
    assert fault_of("h3data scenes paint small:3") == "paint"
    assert fault_of("h3data simulate") == "simulate"


@pytest.mark.parametrize("page", [*PAGES, *OTHER_PAGES], ids=lambda page: page.name)
def test_files_and_make_targets_in_the_docs_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    tops = "benchmarks|datasets|docs|examples|h3data|pipelines|sim_kinematic|tests|viewers"
    files = set(re.findall(rf"[` (]((?:{tops})/[\w./*-]+\.(?:py|toml|json|txt|npz|md))\b", text))
    assert sorted(file for file in files if not any(ROOT.glob(file))) == []
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"(?:`|^)make ([a-z][\w-]*)", text, re.MULTILINE))
    assert sorted(name for name in targets if not re.search(rf"^{name}:", makefile, re.MULTILINE)) == []
    groups = set(re.findall(r"\bGROUP=(\w+)", text))
    assert sorted(name for name in groups if not (ROOT / "benchmarks" / f"{name}.py").exists()) == []


def lines_of_benchmarks() -> str:
    """A pattern of all names in `benchmarks/` that may be lines; what is put in when they run is any word."""
    patterns = set()
    for file in (ROOT / "benchmarks").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else None for part in node.values]
                patterns.add("".join(r"\w+(?:\.\w+)*" if part is None else re.escape(str(part)) for part in parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                patterns.add(re.escape(node.value))
    return "|".join(pattern for pattern in patterns if re.match(r"[a-z_]+\\\.", pattern))


def test_the_figures_of_the_readme_are_lines_of_benchmarks() -> None:
    emitted = lines_of_benchmarks()
    for page, most in ((ROOT / "README.md", 4), (DOCS / "benchmark.md", 10)):
        names = re.findall(r"\| `([a-z_]+\.[\w.{},]+)` \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert len(names) > most
        for name in names:
            before, _, rest = name.partition("{")
            choices, _, after = rest.partition("}")
            for choice in choices.split(","):
                assert re.fullmatch(emitted, f"{before}{choice}{after}"), name
    assert not re.fullmatch(emitted, "recording.mcap.no_such_line")


def test_the_readme_is_short_and_says_what_it_needs_and_how_to_cite() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("\n") <= 120
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    first = text[: text.index("## Quick start")]
    versions = [tag.rpartition(" ")[2] for tag in project["classifiers"] if re.search(r"Python :: 3\.\d", tag)]
    assert f"Python {versions[0]} to {versions[-1]} on Linux" in first
    assert project["requires-python"] == f">={versions[0]}"
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version, year = re.findall(r"^(?:version|date-released): ([\d.]+)", citation, re.MULTILINE)
    assert f"version = {{{version}}}, year = {{{year}}}" in text
    assert str(version) == project["version"] == h3data.__version__
    (paper,) = re.findall(r'- type: conference-paper\n    title: "(.*)"', citation)
    assert f"title = {{{paper}}}" in text


def test_the_glossary_holds_every_metric_of_the_paper() -> None:
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    for task in ("social_nav", "rearrange"):
        _, _, section = text.partition(
            f"## Metrics of {task.replace('_nav', ' navigation').replace('rearrange', 'social rear')}"
        )
        rows = dict(re.findall(r"^\| ([A-Z]+) \|.*\| (.+) \|$", section.partition("\n## ")[0], re.MULTILINE))
        metrics = find_profile("paper", task).metrics
        assert rows == {
            metric.name: {"higher": "higher", "lower": "lower"}.get(metric.direction, "-") for metric in metrics
        }


def test_the_comparison_has_the_papers_columns_and_systems_with_a_speed_each() -> None:
    _, _, section = (
        (DOCS / "comparison.md").read_text(encoding="utf-8").partition("## In the columns of the Habitat 3.0 paper")
    )
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in section.partition("\n## ")[0].splitlines()
        if line.startswith("| ")
    ]
    assert rows[0][2:] == [
        *("people", "body model", "control of people", "human in the loop"),
        *("simulation", "several agents", "authored scenes", "speed"),
    ]
    speeds = {row[0].strip("*"): row[-1] for row in rows[1:]}
    systems = "VirtualHome VRKitchen SAPIEN AI2-THOR ThreeDWorld SEAN iGibson h3data MetaUrban InternUtopia SymbioSim"
    for name in (*systems.split(), "Habitat 2.0", "Habitat 3.0", "Virtual Community", "TongSIM", "Isaac Lab-Arena"):
        (speed,) = (speed for system, speed in speeds.items() if system.startswith(name))
        assert speed[0].isdigit() or speed.startswith("none published"), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_that_install_h3data_install_its_compiled_kernels_too(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "https://..." not in text, "an address is a real one or is left out"
    for _, block in BLOCK.findall(text):
        from_clone = re.findall(r"^pip install (?:\.|\"\.\[[^\n]*)[^\n]*$", block, re.MULTILINE)
        if "download.pytorch.org" in block and from_clone:
            assert all("pipelines/h3data_kernels" in line for line in from_clone), from_clone


@pytest.mark.parametrize("page", sorted(DOCS.glob("tutorials/*.md")), ids=lambda page: page.name)
def test_tutorials_show_what_their_commands_print_and_a_picture(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    printed = [
        block
        for kind, block in BLOCK.findall(text)
        if kind == "text" and not re.match(r"(h3data|pip|from|import|#) ", block)
    ]
    assert printed
    assert re.search(r"^!\[.+\]\(\.\./pictures/", text, re.MULTILINE)


def test_the_docs_hold_commands() -> None:
    assert sum(len(commands(page)) for page in PAGES) > 200
    assert sum(len(quoted(page)) for page in PAGES) > 100


def test_helps_on_the_site_fit_their_column() -> None:
    conf = runpy.run_path(str(DOCS / "conf.py"))
    seen = 0
    for name in ("generate", "view", "doctor"):
        lines = conf["help_text"]([name]).splitlines()
        assert max(map(len, lines)) <= conf["HELP_COLUMNS"], name
        assert any(line.strip().startswith("--json") for line in lines), "options keep lines of their own"
        seen += sum(re.fullmatch(r"Examples:|    h3data .*", line) is not None for line in lines)
    assert seen > 10
    filled = conf["wrapped"]("usage: x\n\nwords that\nwere broken\n\n options\n -----\n  --a  one\n")
    assert filled == "usage: x\n\nwords that were broken\n\n options\n  --a  one\n"


def test_the_reference_explains_every_parameter_of_a_function() -> None:
    conf = runpy.run_path(str(DOCS / "conf.py"))
    for name in h3data.__all__:
        function = getattr(h3data, name)
        if inspect.isfunction(function):
            texts = conf["parameter_texts"](name, function)
            assert all(texts.values()), (name, [parameter for parameter, text in texts.items() if not text])
            documented = inspect.getdoc(function) or ""
            for parameter in inspect.signature(function).parameters:
                assert parameter in texts or re.search(rf"\b{parameter}\b", documented), (name, parameter)


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


def test_pages_are_shown_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs"]) == 0
    listed = capsys.readouterr().out
    for page in (*DOCS.glob("*.md"), *DOCS.glob("tutorials/*.md")):
        if page.stem not in ("index", "changes", "gallery"):
            assert f"\n{page.relative_to(DOCS).with_suffix('')} " in f"\n{listed}"
    assert "http" not in listed  # pyproject.toml names no address
    assert main(["docs", "docs/metrics.md#field-proxemics"]) == 0
    assert capsys.readouterr().out.startswith("# ")
    assert main(["docs", "metrisc"]) == 2
    assert "Did you mean 'metrics'? `h3data docs` lists the pages." in capsys.readouterr().err


def test_sources_name_pages_as_the_command_shows_them() -> None:
    """An installation has no folder docs/, and help and messages are read there."""
    wrong = []
    for package in (
        "h3data",
        "sim_kinematic",
        "pipelines/h3data_habitat",
        "pipelines/h3data_exporters",
        "pipelines/h3data_gpu",
        "pipelines/h3data_homes",
        "pipelines/h3data_light",
        "pipelines/h3data_meshes",
        "pipelines/h3data_motion",
        "pipelines/h3data_worlds",
        "pipelines/h3data_pipelines",
        "pipelines/h3data_training",
        "pipelines/h3data_rays",
        "pipelines/h3data_remote",
        "pipelines/h3data_crowds",
        "pipelines/h3data_language",
        "pipelines/h3data_llm",
        "pipelines/h3data_ros",
        "pipelines/h3data_social",
        "viewers/h3data_viewers",
    ):
        for file in (ROOT / package).rglob("*.py"):
            text = file.read_text(encoding="utf-8")
            code = re.sub(r"#[^\n\"]*$", "", text, flags=re.MULTILINE)
            named = re.findall(r"h3data docs ([a-z][a-z/-]*[a-z])", code) if file.name != "pages.py" else []
            wrong += [f"{file}: {name}" for name in named if not (DOCS / f"{name}.md").is_file()]
            wrong += [f"{file}: {name}" for name in re.findall(r"(?<![\w/`.])docs/[\w/-]+\.md", code)]
    assert not wrong


def test_the_list_of_missing_assets_names_the_page_that_says_how_to_get_them() -> None:
    replay: Any = SimpleNamespace(missing={"data/objects/ycb/mug.glb": 2}, stand_ins=False)
    text = "\n".join(missing_lines(replay))
    (page,) = re.findall(r"h3data docs ([\w-]+)", text)
    assert "## Getting the assets" in (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert "mug.glb  x2" in text
