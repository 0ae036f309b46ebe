"""Record of one metric: formula, unit, source, and required data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from numpy.typing import NDArray

from h3data.recording.records import Recording

Direction = Literal["higher", "lower", "neither"]
NAN = float("nan")
INF = float("inf")
Series = Mapping[str, NDArray[Any]]
"""Per-row arrays [T] by name: flags (bool) or quantities (float64)."""


ARROWS: dict[Direction, str] = {"higher": "up", "lower": "down", "neither": ""}
"""Arrow for the better direction in tables."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """Metric of one profile."""

    id: str
    """Identifier ``profile/task/name@version``; a change of meaning gets a new version."""
    name: str
    """Key of the metric in results, such as ``S``."""
    title: str
    formula: str
    unit: str = "1"
    """Unit; ``1`` for ratios and flags."""
    range: tuple[float, float] = (-INF, INF)
    """Smallest and largest possible value."""
    direction: Direction = "neither"
    """Better direction; ``neither`` if the source names none."""
    source: str = ""
    """Paper, section or code that defines the metric."""
    columns: tuple[str, ...] = ()
    """Required data. ``<robot>`` and ``<human>`` are agent numbers, ``<i>`` is every agent; ``info:<key>`` is a key of
    `Episode.info`, ``events:<kind>`` a kind of event. ``a or b`` means that one of the two is enough."""
    optional: tuple[str, ...] = ()
    """Columns that are read where present; a note states their replacement if they are missing."""
    undefined: str = ""
    """Description of the episodes in which the metric has no value."""
    series: tuple[str, ...] = ()
    """Names of the profile's per-row series from which the metric follows."""
    binary: bool = False
    """True if the metric is 0 or 1 in an episode, so that its mean is a proportion and gets a Wilson interval."""
    reading: str = ""
    """Interpretation of points that the source leaves open."""
    habitat: str = ""
    """Difference from the computation in Habitat's code (spec/habitat.md 1.6)."""
    value: Callable[[Recording], float] | None = None
    """Function that computes the metric from a recording with its ``columns`` and at least one row. None where the profile
    computes all its metrics together."""

    @property
    def profile(self) -> str:
        """Name of the metric's profile, such as ``paper``."""
        return self.id.split("/")[0]

    @property
    def task(self) -> str:
        """Task or group of the metric, such as ``social_nav``."""
        return self.id.split("/")[1]
