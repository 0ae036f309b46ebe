"""Tables of a report, and their output as Markdown and LaTeX; the macro ``data_table`` of page/parts.html writes HTML."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

NAN = float("nan")
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "−": "$-$",
    "–": "--",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "…": r"\ldots{}",
}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Cell of a table."""

    text: str
    """Text such as ``0.97 [0.95, 0.99]``; empty for a cell without a value."""
    value: float = NAN
    """Value by which the column is sorted."""
    small: str = ""
    """Text in small type below the cell's text."""
    strong: bool = False
    heat: float = NAN
    """Strength of the cell's colour, 0 to 1; NaN for none."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """Column of a table, except the column of names."""

    head: str
    hint: str = ""
    group: str = ""
    """Heading that neighbouring columns of the same group share."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a table: its name and a cell for each column."""

    name: str
    cells: tuple[Cell, ...]
    small: str = ""
    """Text in small type below the name."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Group of consecutive rows of a table."""

    title: str
    rows: tuple[Row, ...]
    published: bool = False
    """True if the numbers are from the paper, false if they are ours."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of a report, with its columns and sections of rows."""

    key: str
    """Short identifier, such as ``social_nav``."""
    title: str
    caption: str
    name_head: str
    columns: tuple[Column, ...]
    sections: tuple[Section, ...]
    notes: tuple[str, ...] = ()
    scale: tuple[str, str] | None = None
    """Meanings of the palest and the darkest cell colour; None if cells are not coloured."""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings of column groups with the number of columns that each spans; empty if no column has a group."""
        if not any(column.group for column in self.columns):
            return []
        spans: list[tuple[str, int]] = []
        for column in self.columns:
            if spans and spans[-1][0] == column.group:
                spans[-1] = (column.group, spans[-1][1] + 1)
            else:
                spans.append((column.group, 1))
        return spans


# --- numbers ----------------------------------------------------------------------------------------------------------
def number(value: float, digits: int = 2) -> str:
    """Return a number with a fixed count of decimals, or a dash for NaN."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}"
    # a minus sign, which is as wide as a digit; and 0.00, never -0.00
    return text.replace("-", "−" if float(text) else "")


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 episode`` or ``2 episodes``."""
    return f"{count:,} {noun}{'s' if count != 1 else ''}"


def cut(text: str, most: int) -> str:
    """Shorten a name to at most ``most`` characters.

    Sentences are cut at the end and single words in the middle, because names of scenes and policies often differ only
    at the end.
    """
    if len(text) <= most:
        return text
    # "weights:out/s10/policy.npz" and "weights:out/s11/policy.npz" have to stay apart
    tail = 0 if " " in text else (most - 1) // 2
    return text[: most - 1 - tail] + "…" + text[len(text) - tail :]


def mean_cell(mean: float, low: float = NAN, high: float = NAN, *, digits: int = 2, small: str = "") -> Cell:
    """Return a cell with the text ``mean [low, high]``, or only the mean if there is no interval."""
    interval = "" if math.isnan(low) else f" [{number(low, digits)}, {number(high, digits)}]"
    return Cell(text=number(mean, digits) + interval, value=mean, small=small)


def spread_cell(values: tuple[float, ...], *, digits: int = 2) -> Cell:
    """Return a cell with a published value: ``mean``, ``mean ± std``, ``mean [low, high]``, or empty without a value."""
    if not values:
        return Cell(text="")
    if len(values) == 3:
        return mean_cell(*values, digits=digits)
    tail = f" ± {number(values[1], digits)}" if len(values) == 2 else ""
    return Cell(text=number(values[0], digits) + tail, value=values[0])


def p_text(p: float) -> str:
    """Return a p value as papers print it."""
    return "–" if math.isnan(p) else "< .0001" if p < 1e-4 else f"{p:.4f}"


# --- Markdown ---------------------------------------------------------------------------------------------------------
def to_markdown(table: Table) -> str:
    """Return a table as GitHub Markdown under a heading, with section names in bold."""
    heads = [table.name_head, *(f"{c.group}: {c.head}" if c.group else c.head for c in table.columns)]
    lines = [f"### {_md(table.title)}", "", _md(table.caption), "", "| " + " | ".join(map(_md, heads)) + " |"]
    lines.append("|" + " --- |" + " ---: |" * len(table.columns))
    for section in table.sections:
        if section.title:
            lines.append(f"| **{_md(section.title)}** |" + " |" * len(table.columns))
        for row in section.rows:
            cells = [f"**{_md(c.text)}**" if c.strong and c.text else _md(c.text) for c in row.cells]
            lines.append("| " + " | ".join([_md(row.name), *cells]) + " |")
    return "\n".join([*lines, *([""] if table.notes else []), *(f"- {_md(note)}" for note in table.notes)])


def _md(text: str) -> str:
    """Return a text in which nothing is Markdown markup."""
    # a line break would end the row of the table
    flat = re.sub(r"\s+", " ", text)
    return re.sub(r"([\\`*_|\[\]#~])", r"\\\1", flat).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


# --- LaTeX ------------------------------------------------------------------------------------------------------------
def to_latex(table: Table) -> str:
    """Return a table as a LaTeX ``table`` environment, which needs the package booktabs."""
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_tex(table.caption)}}}", rf"\label{{tab:{table.key}}}"]
    lines += [rf"\begin{{tabular}}{{@{{}}l{'c' * len(table.columns)}@{{}}}}", r"\toprule"]
    if table.groups:
        spans = [rf"\multicolumn{{{n}}}{{c}}{{{_tex(group)}}}" for group, n in table.groups]
        lines.append(" & ".join(["", *spans]) + r" \\")
        first = 2
        for group, n in table.groups:
            if group:
                lines.append(rf"\cmidrule(lr){{{first}-{first + n - 1}}}")
            first += n
    lines.append(" & ".join([_tex(table.name_head), *(_tex(c.head) for c in table.columns)]) + r" \\")
    for section in table.sections:
        lines.append(r"\midrule")
        if section.title:
            lines.append(rf"\multicolumn{{{len(table.columns) + 1}}}{{@{{}}l}}{{\emph{{{_tex(section.title)}}}}} \\")
        for row in section.rows:
            cells = [rf"\textbf{{{_tex(c.text)}}}" if c.strong and c.text else _tex(c.text) for c in row.cells]
            # A line that begins with a bracket would be read as an option of the line break before it.
            lines.append(" & ".join([_tex(row.name), *cells]).replace("[", "{[}") + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"])


def _tex(text: str) -> str:
    """Return a text in which nothing is a LaTeX command."""
    return "".join(_LATEX.get(c, c) for c in re.sub(r"\s+", " ", text))
