"""The documentation site: `make docs` builds it offline from the pages of this folder into build/docs.

The references of Python and of the commands are written by the build, from `__all__` of each module and from `--help`.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import shutil
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import docstring_parser

import h3data

HERE = Path(__file__).parent
WRITTEN = HERE / "reference" / "written"
"""Pages that the build writes; git ignores them."""
MODULES = {
    "h3data": "Everything that most scripts need.",
    "h3data.recording": "Recordings, their two stores, datasets and windows for learners.",
    "h3data.replay": "Recordings brought back: poses at any step, cameras, pictures.",
    "h3data.render": "Scenes and cameras to depth, ids, normals and RGB.",
    "h3data.scene": "Homes, generated or read, and the floor on which agents can walk.",
    "h3data.bodies": "People and robots: skeletons, skins, motion, kinematics.",
    "h3data.metrics": "Metrics of recordings and tables of them.",
    "h3data_studies.analysis": "Plans, power and analysis of studies with people.",
    "h3data_studies.statistics": "Mixed models and contrasts for studies with people.",
    "h3data.stats": "Statistics for comparisons.",
}

CALLED = {"import_": ("import", ""), "run_benchmark": ("benchmark", "run"), "verify_benchmark": ("benchmark", "verify")}
"""Commands, and their parts, of functions with another name."""
ASTERISK = re.compile(r"(``.*?``|`[^`]*`)|\*")
"""Code, which stays, or an asterisk outside of it."""

project, author = "h3data", "the h3data authors"
project_copyright = "the h3data authors, MIT licence"
version = release = h3data.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_design"]
default_role = "literal"
exclude_patterns = ["changes/**"]  # entries of CHANGELOG.md that are not in it yet
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode, nb_execution_timeout, nb_execution_raise_on_error = "force", 300, True
nb_execution_show_tb, nb_render_markdown_format = True, "gfm"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_use_unqualified_type_names = True
copybutton_exclude = ".linenos, .gp, .go, .c1"
suppress_warnings = ["misc.highlighting_failure"]  # there is no lexer for CSV

html_theme = "furo"
html_title = f"h3data {release}"
html_static_path, html_css_files = ["_static"], ["site.css"]
html_search_scorer = str(HERE / "search_scorer.js")
html_show_sphinx = False
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b6e63", "color-brand-content": "#0b6e63"},
    "dark_css_variables": {"color-brand-primary": "#5fd0c1", "color-brand-content": "#5fd0c1"},
}


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("builder-inited", lambda _: write_references())
    app.connect("autodoc-process-docstring", as_restructured_text, priority=400)
    app.connect("autodoc-process-docstring", with_parameters, priority=450)  # before napoleon's 500
    app.connect("autodoc-process-docstring", without_types, priority=600)  # after napoleon's 500
    app.connect("autodoc-process-signature", with_short_types)


_attributes: dict[str, list[str]] = {}


def as_restructured_text(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Escapes the asterisks of shapes such as [*, 3]; a constant without a docstring does not get that of its type."""
    if what == "data" and "\n".join(lines).strip() == str(inspect.getdoc(found)).strip():
        lines.clear()
    lines[:] = [ASTERISK.sub(lambda found: found[1] or r"\*", line) for line in lines]
    if what in ("attribute", "property", "data"):
        _attributes[name] = list(lines)


def with_parameters(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Functions that are commands too have their parameters explained by the command, `simulate` by `session`."""
    module, _, function = name.rpartition(".")
    if what == "function" and module == "h3data":
        lines += [*(f":param {parameter}: {text}" for parameter, text in parameter_texts(function, found).items()), ""]


def parameter_texts(name: str, function: Any) -> dict[str, str]:
    """Texts of the parameters of a function of h3data that its own docstring does not explain."""
    from h3data.commands.command import Group
    from h3data.commands.options import options_of
    from h3data_pipelines.commands.table import all_commands

    own = {one.arg_name.lstrip("*") for one in docstring_parser.parse(inspect.getdoc(function) or "").params}
    if name == "simulate":
        texts = {
            one.arg_name.lstrip("*"): one.description or ""
            for one in docstring_parser.parse(inspect.getdoc(h3data.session) or "").params
        }
    else:
        first, second = CALLED.get(name, (name, ""))
        command = all_commands().get(first)
        command = command.commands[second] if isinstance(command, Group) else command
        if command is None:
            return {}
        # some texts stand under the field, others are those of a type that commands share
        texts = {
            one.field: next((m.help for m in one.metadata if getattr(m, "help", None)), "")
            for one in options_of(command)
        }
        texts |= {
            one.arg_name: one.description
            for one in docstring_parser.parse_from_object(command).params
            if one.description
        }
    return {
        parameter: ASTERISK.sub(lambda found: found[1] or r"\*", " ".join(texts.get(parameter, "").split()))
        for parameter in inspect.signature(function).parameters
        if parameter not in own
    }


def without_types(app: Any, what: str, name: str, found: Any, options: Any, lines: list[str]) -> None:
    """Attributes as they are written: napoleon takes what comes before a colon for their type."""
    if name in _attributes:
        lines[:] = _attributes.pop(name)


def with_short_types(app: Any, what: str, name: str, found: Any, options: Any, signature: str, returns: str) -> Any:
    """Arrays by the names that the source has for them."""
    return tuple(text and _short(text) for text in (signature, returns))


def _short(text: str) -> str:
    text = re.sub(
        r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[~?([^\]]*)\]\]", r"NDArray[\1]", text
    )
    return re.sub(r"~?(?:[a-z_0-9]+\.)+([A-Za-z_]\w*)", r"\1", text)


def write_references() -> None:
    """Writes a page for each module and one for each command, and tables of both (``.inc``, included by the pages above)."""
    shutil.rmtree(WRITTEN, ignore_errors=True)
    for name, about in MODULES.items():
        _write(WRITTEN / "python" / f"{name}.md", _module_page(name, about))
    _write(WRITTEN / "modules.inc", _table("python", MODULES))
    from h3data.commands.command import Group
    from h3data_pipelines.commands.table import all_commands

    about_commands = {
        name: command.about
        if isinstance(command, Group)
        else " ".join((command.__doc__ or "").partition("\n\n")[0].split())
        for name, command in all_commands().items()
    }
    _write(WRITTEN / "commands.inc", _table("commands", about_commands))
    for name, command in all_commands().items():
        parts = [[name, part] for part in command.commands] if isinstance(command, Group) else [[name]]
        page = f"# h3data {name}\n\n"
        for words in parts:
            page += (f"## {' '.join(words)}\n\n" if len(parts) > 1 else "") + f"```text\n{help_text(words)}```\n\n"
        _write(WRITTEN / "commands" / f"{name}.md", page)


def _table(folder: str, about: Mapping[str, str]) -> str:
    rows = [f"| [`{name}`](written/{folder}/{name}.md) | {text} |" for name, text in about.items()]
    return "\n".join(["| | |", "|---|---|", *rows]) + "\n"


def _module_page(name: str, about: str) -> str:
    module = importlib.import_module(name)
    page = f"# {name}\n\n{about}\n\n```{{eval-rst}}\n.. py:module:: {name}\n"
    for member in sorted(module.__all__, key=lambda member: (not member[0].isupper(), member)):
        found = getattr(module, member)
        elsewhere = [m for m in MODULES if m != "h3data" and member in importlib.import_module(m).__all__]
        if name == "h3data" and elsewhere:
            page += f"\n* :py:obj:`{member} <{elsewhere[0]}.{member}>`\n"
            continue
        if inspect.isclass(found):
            page += f"\n.. autoclass:: {name}.{member}\n"
        elif callable(found):
            page += f"\n.. autofunction:: {name}.{member}\n"
        else:
            page += f"\n.. autodata:: {name}.{member}\n   :no-value:\n"
    return page + "```\n"


HELP_COLUMNS = 86
"""Characters in a line of a code block at a width of 1,280 px."""


def help_text(words: list[str]) -> str:
    """The help of a command in lines of at most `HELP_COLUMNS`."""
    from h3data_pipelines.cli import main

    out = io.StringIO()
    columns, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), str(HELP_COLUMNS)
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        os.environ.pop("COLUMNS") if columns is None else os.environ.update(COLUMNS=columns)
    return wrapped(out.getvalue())


def wrapped(text: str) -> str:
    """The text of a help: paragraphs filled anew, rules below headings left out."""
    lines: list[str] = []
    for block in re.split(r"\n\n+", text.strip("\n")):
        found = [line for line in block.splitlines() if not re.fullmatch(r"\s*[-─]+\s*", line)]
        if any(line.startswith(" ") for line in found):  # a list of options or of examples
            for line in found:
                indent = line[: len(line) - len(line.lstrip())]
                lines += textwrap.wrap(line, HELP_COLUMNS, subsequent_indent=f"{indent}    ", break_on_hyphens=False)
        else:
            lines += textwrap.wrap(" ".join(found), HELP_COLUMNS, break_on_hyphens=False)
        lines.append("")
    return "\n".join(lines).strip("\n") + "\n"


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
