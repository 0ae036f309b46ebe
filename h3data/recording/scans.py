"""Laser scans in recordings: columns ``metrics.agent_<i>.<sensor>`` with distances around an agent's base."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import heading_from_quat
from h3data.recording.records import Recording

HEIGHT_M = 0.3
"""Height of the scanner over the floor, at which viewers display scans [m]."""


class Scan(NamedTuple):
    """Distances that one laser scanner measured in each step."""

    agent: int
    sensor: str
    ranges: NDArray[np.float32]
    """Distances [T, R] [m], or [T, L, R] for L lasers, the lowest first."""
    max_m: float
    """Greatest distance that the scanner measures [m]; a ray with this value hit nothing."""
    height_m: float = HEIGHT_M
    """Height of the scanner over the origin of the base [m]."""
    elevations: tuple[float, ...] = (0.0,)
    """Elevation of each laser above the horizon [rad]."""

    def met(self) -> NDArray[np.float32]:
        """Return distances at which rays hit something, in the shape of `ranges` [m], infinite where a ray hit nothing."""
        # a thousandth less, because float32 rounds the greatest distance
        return np.where(self.ranges < self.max_m * (1 - 1e-3), self.ranges, np.float32(np.inf))

    def directions(self) -> NDArray[np.float64]:
        """Return unit vectors of the rays [L * R, 3] in the scanner's frame: x ahead, y up, z to the right."""
        # the first ray looks ahead, the others turn to the left, which is -z in a frame with z to the right
        turns = np.arange(self.ranges.shape[-1]) * (2 * math.pi / max(self.ranges.shape[-1], 1))
        flat, up = np.cos(self.elevations)[:, None], np.sin(self.elevations)[:, None]
        return np.stack(np.broadcast_arrays(flat * np.cos(turns), up, -flat * np.sin(turns)), -1).reshape(-1, 3)

    def around(self, rows: NDArray[np.integer] | slice | list[int]) -> NDArray[np.float64]:
        """Return the points that the rays hit in some rows, in the scanner's frame, [t, L * R, 3] [m].

        They are NaN where a ray hit nothing.
        """
        reach = self.met()[rows].astype(np.float64)
        reach[np.isinf(reach)] = np.nan
        return reach.reshape(len(reach), -1, 1) * self.directions()

    def points(self, recording: Recording, rows: NDArray[np.integer] | slice = slice(None)) -> NDArray[np.float32]:
        """Return the world points that the rays hit in some rows, [t, L * R, 3] [m]; NaN where a ray hit nothing."""
        base = recording.agent_column(self.agent, "base_pose")[rows].astype(np.float64)
        x, y, z = np.moveaxis(self.around(rows), -1, 0)
        heading = heading_from_quat(base[:, 3:])[:, None]
        cos, sin = np.cos(heading), np.sin(heading)
        moved = (x * cos + z * sin, y + self.height_m, z * cos - x * sin)
        return (base[:, None, :3] + np.stack(moved, -1)).astype(np.float32)


def scan_column(agent: int, sensor: str) -> str:
    """Return the name of the column with the scans of an agent's sensor."""
    return f"metrics.agent_{agent}.{sensor}"


def scans_of(recording: Recording) -> list[Scan]:
    """Return the planar scans of a recording, by agent."""
    # sensors that are scans: rays at equal angles, the first straight ahead, the others to the left
    scanners = ("lidar", "lidar_legs", "range_scan")
    return [scan for scan, _ in _found(recording, scanners, 2)]


def clouds_of(recording: Recording) -> list[Scan]:
    """Return the scans of several lasers of a recording, by agent, without scans whose geometry is not recorded."""
    clouds = []
    # sensors that are scans of several lasers, each at an elevation of its own
    cloud_sensors = ("lidar_3d",)
    for scan, facts in _found(recording, cloud_sensors, 3):
        try:
            (low, high), height = facts["elevation_deg"], float(facts["height_m"])
            lasers = np.radians(np.linspace(float(low), float(high), scan.ranges.shape[1]))
        except (KeyError, TypeError, ValueError):
            continue
        if np.isfinite([*lasers, height]).all():
            clouds.append(scan._replace(height_m=height, elevations=tuple(lasers.tolist())))
    return clouds


def _found(recording: Recording, sensors: tuple[str, ...], axes: int) -> list[tuple[Scan, Mapping[str, Any]]]:
    """Return the columns of some sensors as scans, with the facts that the recording states of each."""
    told = recording.episode.info.get("sensors")
    found = []
    for agent in range(len(recording.agents)):
        for sensor in sensors:
            column = recording.columns.get(name := scan_column(agent, sensor))
            # a sensor of this name in the recording of somebody else may be no scan at all
            if column is None or column.ndim != axes or not column[:1].size or column.dtype.kind != "f":
                continue
            facts = told.get(name) if isinstance(told, Mapping) else None
            facts = facts if isinstance(facts, Mapping) else {}
            high = facts.get("high")
            known = isinstance(high, int | float) and math.isfinite(high) and high > 0
            # without a stated limit the longest ray is the best guess
            max_m = float(high) if known else float(np.nanmax(column, initial=0.0)) or math.inf  # type: ignore[arg-type]
            found.append((Scan(agent, sensor, column.astype(np.float32), max_m), facts))
    return found
