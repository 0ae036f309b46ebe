"""Data of one episode in a report: its metrics, facts from its recording, and its paths in a few kilobytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.metrics import EpisodeMetrics
from h3data.recording.records import agent_numbers
from h3data.recording.storage import AnyPath

GRID_S = 0.5
"""Time between stored distances of robot and person [s]."""
TRACK_S = 0.1
"""Time between stored points of agents' tracks [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Path of one agent in a report."""

    kind: str
    """Kind of agent: ``robot`` or ``human``."""
    xz: NDArray[np.float32]
    """Floor positions (x, z) in the world [m] every `TRACK_S` and in the last row, shape [K, 2]; NaN while the agent is
    absent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportEpisode:
    """Episode of a report, with its metrics and a summary of its motion."""

    source: AnyPath
    """Dataset or log that holds the episode."""
    index: int
    """Number of the episode in the dataset."""
    metrics: EpisodeMetrics
    seed: int
    policy: str
    partner: str
    population: str
    """Population of the partner: ``train``, ``zsc`` or empty."""
    participant: str
    condition: str
    distance_m: NDArray[np.float32]
    """Distance from the robot to the nearest person every `GRID_S` [m], shape [G]; empty if there is no robot or no
    person."""
    tracks: tuple[Track, ...]
    recorded: bool = True
    """True if the episode has a recording; False if there are only its metrics."""
    beside: tuple[EpisodeMetrics, ...] = ()
    """Metrics of further profiles (`h3data.metrics.Profile.beside`)."""
    imported: str = ""
    """Rate, people and gaps of an imported recording; empty for others."""

    @property
    def name(self) -> str:
        """Name of the episode as used on the command line, such as ``ds#3``."""
        return f"{self.source}#{self.index}" if self.source.is_dir() else str(self.source)

    @property
    def people(self) -> int:
        """Number of people in the episode."""
        return len(agent_numbers(self.tracks, "human"))

    @property
    def nearest_at(self) -> NDArray[np.float32]:
        """Positions (x, z) of the robot and the measured person where they are nearest to each other, shape [2, 2] [m].

        The shape is [0, 2] if one of them is missing, or if they are never present together.
        """
        measured = self.metrics.robot, self.metrics.human
        if min(measured) < 0 or max(measured) >= len(self.tracks):
            return np.zeros((0, 2), np.float32)
        robot, human = (self.tracks[number].xz for number in measured)
        # tracks have the same times, so that their points belong together
        gaps = np.linalg.norm(robot - human, axis=1)
        return np.zeros((0, 2), np.float32) if np.isnan(gaps).all() else np.stack([robot, human])[:, np.nanargmin(gaps)]

    @property
    def studied(self) -> bool:
        """Return whether the episode belongs to a study: it names a participant and a condition."""
        return bool(self.participant and self.condition)

    def seconds(self, row: int) -> float:
        """Return the time of a row since the start of the episode [s]."""
        return (row + 1) * self.metrics.dt_ns * 1e-9
