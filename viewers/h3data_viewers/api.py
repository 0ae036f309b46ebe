"""Views and reports from Python, with the options of the commands: ``h3data.view`` and ``h3data.report``.

Each function runs the command of its name, so both do the same; results come back as objects instead of text.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.commands.options import run_from_python
from h3data.render.light.sources import LightMode

if TYPE_CHECKING:
    from h3data_viewers.html_report.report import Report

AnyPath = str | os.PathLike[str]


def report(
    datasets: AnyPath | Sequence[AnyPath],
    out: AnyPath = Path("report.html"),
    *,
    title: str = "",
    markdown: AnyPath | None = None,
    latex: AnyPath | None = None,
    pictures: int = 6,
    assets: Sequence[AnyPath] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    stand_ins: bool = False,
    replays: bool = False,
    zsc: Sequence[str] = (),
    seeds: Sequence[str] = (),
    study_model: Literal["auto", "poisson", "observation"] = "auto",
    failed: Literal["leave-out", "limit"] = "leave-out",
    workers: int = 1,
    executor: str = "local",
    force: bool = False,
) -> Report:
    """Writes a self-contained HTML report on datasets and recordings; options as of ``h3data report``.

    Returns:
        The report: its runs, tables, and what could not be measured.

    Raises:
        InputError: there is nothing to report on, an option is wrong, or a file exists.
    """
    from h3data_viewers.commands.reporting import ReportCommand

    return run_from_python(ReportCommand, locals(), several=("datasets",))


def view(
    recording: AnyPath,
    *,
    compare: AnyPath | None = None,
    out: AnyPath | None = None,
    camera: Sequence[str] = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    assets: Sequence[AnyPath] = (),
    stand_ins: bool = False,
    open: bool = False,
    force: bool = False,
) -> Path:
    """Writes a recording as a Rerun file (or two side by side), or as an HTML file that plays it in a browser; options as
    of ``h3data view``.

    Returns:
        The .rrd or .html file.

    Raises:
        InputError: an option is wrong, or the file exists.
    """
    from h3data_viewers.commands.viewing import View

    return run_from_python(View, locals())
