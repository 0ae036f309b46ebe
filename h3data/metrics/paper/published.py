"""Published results of Habitat 3.0, from ``published.toml`` in this folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from h3data.metrics.report_layout import PublishedContrasts, PublishedTable


@dataclass(frozen=True, kw_only=True)
class PublishedResults:
    """The published tables."""

    social_nav: PublishedTable
    rearrange: PublishedTable
    hitl: PublishedTable
    """Results of the human-in-the-loop study."""
    contrasts: PublishedContrasts
    """Pairwise differences of task steps in the human-in-the-loop study."""


@cache
def published_results() -> PublishedResults:
    """Return the published tables."""
    import msgspec

    text = (files("h3data.metrics.paper") / "published.toml").read_bytes()
    return msgspec.toml.decode(text, type=PublishedResults)
