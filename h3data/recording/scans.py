"""Scans of laser scanners in recordings: the columns ``metrics.agent_<i>.<sensor>`` of lengths around an agent's base."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat
from h3data.recording.records import Recording

SCANNERS = ("lidar", "lidar_legs", "range_scan")
"""Sensors that are scans: rays at equal angles, the first straight ahead, the others to the left."""
HEIGHT_M = 0.3
"""Height over the floor at which scans are shown, that of the scanner [m]."""


class Scan(NamedTuple):
    """Distances that one laser scanner measured in each step."""

    agent: int
    sensor: str
    ranges: NDArray[np.float32]
    """Measured distances [T, R] [m]."""
    max_m: float
    """Greatest distance that it can measure; rays that long met nothing."""

    def met(self) -> NDArray[np.float32]:
        """Distances [T, R] [m] to what the rays met, infinite where that is nothing."""
        return np.where(self.ranges < self.max_m * (1 - 1e-3), self.ranges, np.float32(np.inf))

    def points(self, recording: Recording, rows: NDArray[np.integer] | slice = slice(None)) -> NDArray[np.float32]:
        """World points that the rays met in some rows, [t, R, 3] [m]; NaN where a ray met nothing."""
        base = recording.agent_column(self.agent, "base_pose")[rows].astype(np.float64)
        reach = self.met()[rows].astype(np.float64)
        reach[np.isinf(reach)] = np.nan
        turns = np.arange(reach.shape[1]) * (2 * math.pi / max(reach.shape[1], 1))
        headings = heading_from_quat(base[:, 3:])[:, None] + turns
        x, z = base[:, :1] + reach * np.cos(headings), base[:, 2:3] - reach * np.sin(headings)
        y = np.where(np.isnan(reach), np.nan, base[:, 1:2] + HEIGHT_M)
        return np.stack([x, y, z], -1).astype(np.float32)


def scan_column(agent: int, sensor: str) -> str:
    """Name of the column of an agent's sensor."""
    return f"metrics.agent_{agent}.{sensor}"


def scans_of(recording: Recording) -> list[Scan]:
    """Returns the scans of a recording, by agent."""
    told = recording.episode.info.get("sensors")
    found = []
    for agent in range(len(recording.agents)):
        for sensor in SCANNERS:
            column = recording.columns.get(name := scan_column(agent, sensor))
            if column is None or column.ndim != 2 or not column.shape[1] or column.dtype.kind != "f":
                continue
            facts = told.get(name) if isinstance(told, Mapping) else None
            high = facts.get("high") if isinstance(facts, Mapping) else None
            known = isinstance(high, int | float) and math.isfinite(high) and high > 0
            max_m = float(high) if known else float(np.nanmax(column, initial=0.0)) or math.inf  # type: ignore[arg-type]
            found.append(Scan(agent, sensor, column.astype(np.float32), max_m))
    return found
