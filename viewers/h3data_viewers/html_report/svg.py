"""Inline SVG by hand: a picture that grows by lines, and axes with round numbers. Colours come from classes of the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

from h3data_viewers.html_report.tables import cut

Scale = Callable[[float], float]


@dataclass
class Svg:
    """A picture of a fixed size in its own units; the page scales it. All text is escaped."""

    width: float
    height: float
    alt: str
    """Description of the picture for readers who cannot see it."""
    css: str = ""
    """Class of the element."""
    parts: list[str] = field(default_factory=list)

    def line(self, x1: float, y1: float, x2: float, y2: float, css: str) -> None:
        """Add a straight line."""
        self.parts.append(f'<line class="{css}" x1="{_n(x1)}" y1="{_n(y1)}" x2="{_n(x2)}" y2="{_n(y2)}"/>')

    def rect(self, x: float, y: float, width: float, height: float, css: str) -> None:
        """Add a filled rectangle."""
        self.parts.append(
            f'<rect class="{css}" x="{_n(x)}" y="{_n(y)}" width="{_n(max(width, 0))}" height="{_n(max(height, 0))}"/>'
        )

    def path(self, points: Iterable[tuple[float, float]], css: str, *, closed: bool = False) -> None:
        """A line through points, shape [K, 2]; it is broken where a point is NaN."""
        words, pen = [], "M"
        for x, y in points:
            if math.isnan(x) or math.isnan(y):
                pen = "M"
                continue
            words.append(f"{pen}{_n(x)} {_n(y)}")
            pen = "L"
        if words:
            self.parts.append(f'<path class="{css}" d="{"".join(words)}{"Z" if closed else ""}"/>')

    def shape(self, d: str, css: str) -> None:
        """A path in SVG's own words."""
        self.parts.append(f'<path class="{css}" d="{d}"/>')

    def circle(self, x: float, y: float, radius: float, css: str, *, title: str = "") -> None:
        """Add a dot."""
        head = f'<circle class="{css}" cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}"'
        self.parts.append(f"{head}><title>{escape(title)}</title></circle>" if title else f"{head}/>")

    def text(self, x: float, y: float, text: str, css: str = "", *, anchor: str = "start", most: int = 0) -> None:
        """Text with its base line at y; longer than ``most`` characters it is cut, and whole in its title."""
        shown = text if not most else cut(text, most)
        title = f"<title>{escape(text)}</title>" if shown != text else ""
        self.parts.append(
            f'<text class="{css}" x="{_n(x)}" y="{_n(y)}" text-anchor="{anchor}">{escape(shown)}{title}</text>'
        )

    def use(self, reference: str) -> None:
        """Refers to a shape that the page defines under this id."""
        self.parts.append(f'<use href="#{escape(reference)}"/>')

    def to_html(self) -> str:
        """Return the element as HTML."""
        return (
            f'<svg class="{self.css}" viewBox="0 0 {_n(self.width)} {_n(self.height)}" role="img" '
            f'aria-label="{escape(self.alt)}">'
            f"{''.join(self.parts)}</svg>"
        )


def linear(low: float, high: float, start: float, stop: float) -> Scale:
    """Return a function that maps values to coordinates."""
    span = (high - low) or 1.0
    return lambda value: start + (value - low) / span * (stop - start)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers from ``low`` to ``high``, about ``count``."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """Return a short text of a number: 0.5, 20, 2M."""
    for factor, unit in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= factor:
            return f"{value / (1e3 if unit == 'k' else factor):g}{unit}"
    return f"{value:.6g}".replace("-", "−")


def axes(
    svg: Svg,
    x: Scale,
    y: Scale,
    xs: Sequence[float],
    ys: Sequence[float],
    box: tuple[float, float, float, float],
    *,
    x_title: str,
    y_text: Callable[[float], str] = tick_text,
) -> None:
    """Grid lines with numbers left and below. ``box``: left, top, right, bottom."""
    left, top, right, bottom = box
    for value in ys:
        svg.line(left, y(value), right, y(value), "grid")
        svg.text(left - 6, y(value) + 4, y_text(value), "tick", anchor="end")
    x_axis(svg, x, xs, (left, top, right, bottom), title=x_title, grid=False)


def x_axis(
    svg: Svg, x: Scale, xs: Sequence[float], box: tuple[float, float, float, float], *, title: str, grid: bool = True
) -> None:
    """Numbers below, with lines upwards if ``grid``."""
    left, top, right, bottom = box
    for value in xs:
        if grid:
            svg.line(x(value), top, x(value), bottom, "grid")
        svg.text(x(value), bottom + 15, tick_text(value), "tick", anchor="middle")
    svg.line(left, bottom, right, bottom, "axis")
    svg.text((left + right) / 2, bottom + 31, title, "axis-title", anchor="middle")


def _n(value: float) -> str:
    """At most a tenth of a unit: files stay small."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text
