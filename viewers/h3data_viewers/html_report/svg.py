"""Drawings of a report as lists of SVG elements, and axes with round numbers.

Colours come from CSS classes of the page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from h3data_viewers.html_report.tables import cut

Scale = Callable[[float], float]
Box = tuple[float, float, float, float]
"""Left, top, right and bottom of a chart's axes."""


@dataclass(frozen=True)
class Mark:
    """Element of an SVG drawing."""

    tag: str
    attributes: Mapping[str, str]
    text: str = ""
    title: str = ""
    """Tooltip of the element."""


@dataclass
class Svg:
    """Drawing of a fixed size in its own units; the page scales it (macro ``svg`` of page/parts.html)."""

    width: float
    height: float
    alt: str
    """Description of the picture for readers who cannot see it."""
    css: str = ""
    """CSS class of the drawing."""
    caption: str = ""
    """Text above the drawing, if the page shows it as a figure."""
    marks: list[Mark] = field(default_factory=list)

    def add(self, tag: str, css: str, *, text: str = "", title: str = "", **attributes: float | str) -> None:
        """Add an SVG element; ``_`` in names of attributes stands for a hyphen."""
        written = {name.replace("_", "-"): v if isinstance(v, str) else _n(v) for name, v in attributes.items()}
        self.marks.append(Mark(tag, {"class": css} | written if css else written, text, title))

    def line(self, x1: float, y1: float, x2: float, y2: float, css: str) -> None:
        """Add a straight line."""
        self.add("line", css, x1=x1, y1=y1, x2=x2, y2=y2)

    def rect(self, x: float, y: float, width: float, height: float, css: str) -> None:
        """Add a filled rectangle."""
        self.add("rect", css, x=x, y=y, width=max(width, 0.0), height=max(height, 0.0))

    def path(self, points: Iterable[tuple[float, float]], css: str, *, closed: bool = False) -> None:
        """Add a line through points of shape [K, 2], with gaps where a point is NaN."""
        # M moves the pen without drawing: it begins each stretch between gaps
        words, pen = [], "M"
        for x, y in points:
            if math.isnan(x) or math.isnan(y):
                pen = "M"
                continue
            words.append(f"{pen}{_n(x)} {_n(y)}")
            pen = "L"
        if words:
            self.add("path", css, d="".join(words) + "Z" * closed)

    def circle(self, x: float, y: float, radius: float, css: str, *, title: str = "") -> None:
        """Add a dot."""
        self.add("circle", css, cx=x, cy=y, r=radius, title=title)

    def text(self, x: float, y: float, text: str, css: str = "", *, anchor: str = "start", most: int = 0) -> None:
        """Add a text with its base line at y; texts of more than ``most`` characters are cut and get a tooltip."""
        shown = text if not most else cut(text, most)
        self.add("text", css, x=x, y=y, text_anchor=anchor, text=shown, title=text if shown != text else "")


def linear(low: float, high: float, start: float, stop: float) -> Scale:
    """Return a linear function that maps values ``low`` to ``high`` to coordinates ``start`` to ``stop``."""
    span = (high - low) or 1.0
    return lambda value: start + (value - low) / span * (stop - start)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return about ``count`` round numbers from ``low`` to ``high``."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    # the smallest round step of which no more than `count` fit
    step = next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= raw * 0.999)
    # a border that is a multiple of the step belongs to the axis, also where the quotient is rounded
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """Return a short text for a number, such as 0.5, 20 or 2M."""
    for factor, unit in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= factor:
            return f"{value / (1e3 if unit == 'k' else factor):g}{unit}"
    return f"{value:.6g}".replace("-", "−")


def add_x_axis(svg: Svg, x: Scale, xs: Sequence[float], box: Box, *, title: str, grid: bool = True) -> None:
    """Add the numbers of the x axis below a chart, with vertical grid lines if ``grid`` is true."""
    left, top, right, bottom = box
    for value in xs:
        if grid:
            svg.line(x(value), top, x(value), bottom, "grid")
        svg.text(x(value), bottom + 15, tick_text(value), "tick", anchor="middle")
    svg.line(left, bottom, right, bottom, "axis")
    svg.text((left + right) / 2, bottom + 31, title, "axis-title", anchor="middle")


def _n(value: float) -> str:
    """Return a coordinate to a tenth of a unit, so that files stay small."""
    return f"{value:.1f}".removesuffix(".0")
