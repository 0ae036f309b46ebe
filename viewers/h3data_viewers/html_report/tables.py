"""Tables of a report and the three ways to write them: HTML, Markdown, LaTeX. Everything that is written is escaped."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

NAN = float("nan")
_WIDE = 6
"""With more columns, intervals stand below their means."""
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


NAME_WIDTH = 34
"""Characters of a name that a table shows: homes have up to 60, seeds 19, policies the path of their file."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Value in a table."""

    text: str
    """``0.97 [0.95, 0.99]``; empty: nothing to say."""
    value: float = NAN
    """Value by which the column is sorted."""
    small: str = ""
    """Said below, in small type."""
    strong: bool = False
    heat: float = NAN
    """Strength of the cell's colour, 0 to 1; NaN for none."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """Column of a table, except the column of names."""

    head: str
    hint: str = ""
    group: str = ""
    """Head that neighbouring columns of the same group share."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a table: its name and a cell for each column."""

    name: str
    cells: tuple[Cell, ...]
    small: str = ""
    """Said below the name, in small type."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Rows that belong together."""

    title: str
    rows: tuple[Row, ...]
    published: bool = False
    """Numbers of the paper, not ours."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of a report."""

    key: str
    """Short name: ``social_nav``."""
    title: str
    caption: str
    name_head: str
    columns: tuple[Column, ...]
    sections: tuple[Section, ...]
    notes: tuple[str, ...] = ()
    scale: tuple[str, str] | None = None
    """Meanings of the palest and the darkest colour of its cells; None if cells are not coloured."""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Group heads with the number of columns that each spans; empty if no column has a group."""
        if not any(column.group for column in self.columns):
            return []
        spans: list[tuple[str, int]] = []
        for column in self.columns:
            if spans and spans[-1][0] == column.group:
                spans[-1] = (column.group, spans[-1][1] + 1)
            else:
                spans.append((column.group, 1))
        return spans


@dataclass(frozen=True, kw_only=True)
class StudyTables:
    """Tables of a report about the episodes of one task that participants did under conditions."""

    tables: tuple[Table, ...] = ()
    charts: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Charts below a table, as SVG, by the key of the table."""
    missing: str = ""
    """Reason why there are no tables of means; empty if there are."""


# --- numbers ----------------------------------------------------------------------------------------------------------
def number(value: float, digits: int = 2) -> str:
    """A number with a fixed count of decimals; a dash for NaN."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−" if float(text) else "")


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 episode`` or ``2 episodes``."""
    return f"{count:,} {noun}{'s' if count != 1 else ''}"


def cut(text: str, most: int) -> str:
    """Shortens a name to at most ``most`` characters.

    Sentences lose their end, single words their middle, since names of scenes and policies often differ only at the
    end.
    """
    if len(text) <= most:
        return text
    tail = 0 if " " in text else (most - 1) // 2
    return text[: most - 1 - tail] + "…" + text[len(text) - tail :]


def mean_cell(mean: float, low: float = NAN, high: float = NAN, *, digits: int = 2, small: str = "") -> Cell:
    """``mean [low, high]``; without the bracket if there is no interval."""
    interval = "" if math.isnan(low) else f" [{number(low, digits)}, {number(high, digits)}]"
    return Cell(text=number(mean, digits) + interval, value=mean, small=small)


def spread_cell(values: tuple[float, ...], *, digits: int = 2) -> Cell:
    """A published value: ``mean``, ``mean ± std`` or ``mean [low, high]``; empty if there is none."""
    if not values:
        return Cell(text="")
    if len(values) == 3:
        return mean_cell(*values, digits=digits)
    tail = f" ± {number(values[1], digits)}" if len(values) == 2 else ""
    return Cell(text=number(values[0], digits) + tail, value=values[0])


def p_text(p: float) -> str:
    """Returns a p value as papers print it."""
    return "–" if math.isnan(p) else "< .0001" if p < 1e-4 else f"{p:.4f}"


# --- HTML -------------------------------------------------------------------------------------------------------------
def to_html(table: Table, *, sortable: bool = True) -> str:
    """A table with headers for screen readers, in a box that scrolls sideways where it is too wide."""
    rows = "".join(_html_section(table, section) for section in table.sections)
    groups = "".join(f'<th colspan="{n}" scope="colgroup">{escape(g)}</th>' for g, n in table.groups)
    group_row = f"<tr><td></td>{groups}</tr>" if groups else ""
    heads = "".join(
        f'<th scope="col"{_title(c.hint)}>{_fitting(c.head)}</th>'
        for c in (Column(head=table.name_head), *table.columns)
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.notes)
    bar, width = "", ""
    if table.scale is not None:
        low, high = map(escape, table.scale)
        width = f' style="--columns:{len(table.columns)}"'
        bar = f'<p class="scale" role="img" aria-label="Colours from {low} to {high}">{low}<span></span>{high}</p>'
    css = "data" + (" sortable" if sortable else "") + (" wide" if len(table.columns) > _WIDE else "")
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(table.title)}">'
        f'<table class="{css}" id="table-{escape(table.key)}"{width}>'
        f"<caption><span>{escape(table.caption)}</span></caption>"
        f"<thead>{group_row}<tr>{heads}</tr></thead>{rows}</table></div>"
        + bar
        + (f'<ul class="notes">{notes}</ul>' if notes else "")
    )


def _html_section(table: Table, section: Section) -> str:
    lines = [f"<tbody{' class=published' if section.published else ''}>"]
    if section.title:
        lines.append(
            f'<tr class="section"><th scope="rowgroup" colspan="{len(table.columns) + 1}">{escape(section.title)}</th></tr>'
        )
    for row in section.rows:
        name = _fitting(row.name) + (f"<small>{escape(row.small)}</small>" if row.small else "")
        lines.append(f'<tr><th scope="row">{name}</th>{"".join(map(_html_cell, row.cells))}</tr>')
    return "".join([*lines, "</tbody>"])


def _html_cell(cell: Cell) -> str:
    value, bracket, interval = _fitting(cell.text).partition(" [")
    text = f'{value} <span class="interval">[{interval}</span>' if bracket else value
    text = f"<strong>{text}</strong>" if cell.strong else text
    small = f"<small>{escape(cell.small)}</small>" if cell.small else ""
    value = "" if math.isnan(cell.value) else f' data-v="{cell.value:.6g}"'
    heat = "" if math.isnan(cell.heat) else f' class="heat" style="--v:{cell.heat:.3f}"'
    return f"<td{value}{heat}>{text}{small}</td>"


def _fitting(text: str) -> str:
    """A text of a cell: names and numbers without a space are cut in the middle where they are long, and whole in the title."""
    if " " in text or len(text) <= NAME_WIDTH:
        return escape(text)
    return f'<span title="{escape(text)}">{escape(cut(text, NAME_WIDTH))}</span>'


def _title(text: str) -> str:
    return f' title="{escape(text)}"' if text else ""


# --- Markdown ---------------------------------------------------------------------------------------------------------
def to_markdown(table: Table) -> str:
    """A GitHub table under a heading; the sections are set in bold."""
    heads = [table.name_head, *(f"{c.group}: {c.head}" if c.group else c.head for c in table.columns)]
    lines = [f"### {_md(table.title)}", "", _md(table.caption), "", _md_line(heads)]
    lines.append("|" + " --- |" + " ---: |" * len(table.columns))
    for section in table.sections:
        if section.title:
            lines.append(f"| **{_md(section.title)}** |" + " |" * len(table.columns))
        for row in section.rows:
            cells = [f"**{_md(c.text)}**" if c.strong and c.text else _md(c.text) for c in row.cells]
            lines.append("| " + " | ".join([_md(row.name), *cells]) + " |")
    return "\n".join([*lines, *([""] if table.notes else []), *(f"- {_md(note)}" for note in table.notes)])


def _md_line(cells: list[str]) -> str:
    return "| " + " | ".join(map(_md, cells)) + " |"


def _md(text: str) -> str:
    """Letters only: nothing in ``text`` is markup."""
    flat = re.sub(r"\s+", " ", text)
    return re.sub(r"([\\`*_|\[\]#~])", r"\\\1", flat).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


# --- LaTeX ------------------------------------------------------------------------------------------------------------
def to_latex(table: Table) -> str:
    """A ``table`` environment that needs the package booktabs."""
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
    """Letters only: nothing in ``text`` is a command."""
    return "".join(_LATEX.get(c, c) for c in re.sub(r"\s+", " ", text))
