"""Computation of the paper's social navigation metrics: S, SPS, F, CR, BYR, TD, FD.

Formulas, sources and interpretations: `h3data.metrics.paper.social_nav_definitions`. Values that a recording does not
determine are NaN, with a note on the reason; undefined values are never guessed or set to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.episode import Notes
from h3data.metrics.metric import NAN, Series
from h3data.metrics.paper.encounter import encounter_series
from h3data.metrics.paper.protocol import SOCIAL_NAV_PROTOCOL, protocol_deviations
from h3data.metrics.profile import GFX_REPLAY, Computed
from h3data.metrics.requirements import find_agents
from h3data.recording.records import Recording

GEODESIC, COLLISION = "metrics.geodesic_agents", "metrics.collision"


def compute_social_nav(recordings: Sequence[Recording], notes: Sequence[Notes]) -> list[Computed]:
    """Compute S, SPS, F, CR, BYR, TD and FD between the first robot and the first human of each recording."""
    agents = [find_agents(recording) for recording in recordings]
    # all episodes as one long array: NumPy's calls take longer than the arithmetic on one of them
    series, offsets = _joined_series(recordings, agents)
    found, contacts = (
        _occurrences(series["found"], offsets),
        _occurrences(series.get("collision", np.zeros(offsets[-1], np.bool_)), offsets),
    )
    unseen = _occurrences(np.isnan(series["dist_m"]), offsets)
    # BYR counts both: backing up and standing still near a person
    making_room = _occurrences(series["backs_up"] | series["yields"], offsets)
    computed = []
    for k, (recording, note, (robot, human)) in enumerate(zip(recordings, notes, agents, strict=True)):
        episode = _Counted(
            found[k], contacts[k], unseen[k].total, making_room[k].total, series["dist_m"][offsets[k] : offsets[k + 1]]
        )
        computed.append(
            Computed(
                values=_values(recording, episode, note),
                robot=robot,
                human=human,
                moments={name: of.first for name, of in (("found", found[k]), ("collision", contacts[k])) if of.total},
                protocol_deviations=protocol_deviations(recording, SOCIAL_NAV_PROTOCOL),
            )
        )
    return computed


def social_nav_series(recording: Recording) -> Series:
    """Compute `encounter_series` between the first robot and the first human, and ``collision`` if recorded, each [T]."""
    return _joined_series([recording], [find_agents(recording)])[0]


def reach_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Return the distance by which finding and following are decided [m], shape [T]: geodesic if recorded, else L2."""
    if GEODESIC in recording.columns:
        # the same type from either source, so that limits compare alike
        return recording.columns[GEODESIC].astype(np.float32, copy=False)
    return l2_distance(recording, robot, human)


def l2_distance(recording: Recording, robot: int, human: int) -> NDArray[np.float32]:
    """Return the straight distance between the base positions of two agents [m], shape [T]; NaN where one is absent."""
    a, b = (recording.agent_column(agent, "base_pose")[:, :3].astype(np.float64) for agent in (robot, human))
    return np.linalg.norm(a - b, axis=1).astype(np.float32)


class _Occurrences(NamedTuple):
    """Rows of one episode in which a flag holds."""

    first: int
    """Row within the episode; meaningless without occurrences."""
    total: int


class _Counted(NamedTuple):
    """Series of one episode, up to the last row that counts."""

    found: _Occurrences
    contacts: _Occurrences
    unseen: int
    """Number of rows in which an agent has no pose."""
    making_room: int
    distance: NDArray[np.float64]
    """L2 distance, shape [T] [m]; NaN where unseen."""


def _joined_series(
    recordings: Sequence[Recording], agents: Sequence[tuple[int, int]]
) -> tuple[dict[str, NDArray], NDArray[np.int64]]:
    """Return `social_nav_series` of recordings, one after another, and where each begins and ends, shape [E + 1].

    ``collision`` is there if any of them has it.
    """
    offsets = np.cumsum([0, *map(len, recordings)])
    pairs = list(zip(recordings, agents, strict=True))
    series = encounter_series(
        np.concatenate([recording.agent_column(robot, "base_pose") for recording, (robot, _) in pairs]),
        np.concatenate([recording.agent_column(human, "base_pose") for recording, (_, human) in pairs]),
        np.concatenate([reach_distance(recording, *pair) for recording, pair in pairs]),
        np.concatenate([recording.columns["time_ns"] for recording in recordings]),
        # an episode without rows has no first one: its offset is the next one's, or past the end
        starts=offsets[:-1][np.diff(offsets) > 0],
    )
    contacts = [recording.columns.get(COLLISION) for recording in recordings]
    if any(column is not None for column in contacts):
        series["collision"] = np.concatenate(
            [
                np.zeros(len(recording), np.bool_) if column is None else column.astype(np.bool_)
                for recording, column in zip(recordings, contacts, strict=True)
            ]
        )
    return series, offsets


def _occurrences(flags: NDArray[np.bool_], offsets: NDArray[np.int64]) -> list[_Occurrences]:
    """Return the steps at which a flag holds in each episode."""
    rows = np.flatnonzero(flags)
    bounds = np.searchsorted(rows, offsets)
    # an episode without the flag gets the first row of a later one, or -1: its total of 0 says that it counts for nothing
    first = np.append(rows, -1)[bounds[:-1]] - offsets[:-1]
    return [_Occurrences(*each) for each in zip(first.tolist(), np.diff(bounds).tolist(), strict=True)]


def _values(recording: Recording, episode: _Counted, notes: Notes) -> dict[str, float]:
    geodesic = recording.columns.get(GEODESIC)
    by_found = ("S", "SPS", "F", "FD")
    if geodesic is None:
        notes.add(by_found, f"no column {GEODESIC}: 'found' uses the L2 distance, which sees through walls")
    elif unknown := int(np.count_nonzero(np.isnan(geodesic))):
        notes.add(by_found, f"{unknown} of {len(recording)} rows have no geodesic distance: not found there")
    values = {"CR": _collision(recording, episode, notes)}
    values |= _distances(episode, notes)
    if "S" in values:
        found = episode.found
        # never found: SPS and F are 0 by their definition, whatever the oracle needs
        values |= (
            {"SPS": 0.0, "F": 0.0}
            if not found.total
            else _against_oracle(recording, found.first + 1, found.total, notes)
        )
        # its times are counted frames
        if recording.episode.task == GFX_REPLAY:
            notes.add(("BYR",), "a gfx-replay has no time stamps: speeds assume its nominal frame rate")
    return values


def _collision(recording: Recording, episode: _Counted, notes: Notes) -> float:
    rows = len(recording)
    if COLLISION not in recording.columns or rows == 0:
        notes.add(("CR",), f"no column {COLLISION}" if rows else "the recording has no rows")
        return NAN
    if not episode.contacts.total:
        return 0.0
    # in the paper a contact ends the episode
    if episode.contacts.first < rows - 1:
        notes.add(("CR",), f"the recording goes on after the first contact in row {episode.contacts.first}")
    return 1.0


def _distances(episode: _Counted, notes: Notes) -> dict[str, float]:
    """Return S, BYR, TD and FD; nothing if no row has both poses."""
    distance = episode.distance
    rows = len(distance)
    count = rows - episode.unseen
    if count == 0:
        notes.add(
            ("S", "SPS", "F", "BYR", "TD", "FD"),
            "no row has a pose of both agents" if rows else "the recording has no rows",
        )
        return {}
    if episode.unseen:
        notes.add(("S", "BYR", "TD", "FD"), f"{episode.unseen} of {rows} rows lack a pose and are left out")
    found = episode.found.total > 0
    values = {
        "S": float(found),
        "BYR": episode.making_room / count,
        "TD": _mean(distance),
    }
    if found:
        values["FD"] = _mean(distance[episode.found.first :])
    else:
        notes.add(("FD",), "the robot never finds the human")
    return values


def _mean(distance: NDArray[np.float64]) -> float:
    """Return the mean of the distances that are known, of which there is at least one."""
    known = distance[~np.isnan(distance)]
    # One after the other: np.sum adds pairwise, whose last bit depends on the number of rows and on NumPy's blocks.
    return float(np.add.accumulate(known)[-1]) / len(known)


def _against_oracle(recording: Recording, steps: int, following: int, notes: Notes) -> dict[str, float]:
    """Return SPS and F of an episode in which the human was found after ``steps`` (paper section 4.1)."""
    info = recording.episode.info
    oracle = info.get("oracle_min_steps")
    if "oracle_min_steps" not in info:
        notes.add(("SPS", "F"), "the oracle's minimum steps l are not recorded (info oracle_min_steps)")
        return {}
    if oracle is None:
        notes.add(("SPS", "F"), "the simulator's oracle never reached the human, so l is undefined")
        return {}
    if not _is_count(oracle):
        notes.add(("SPS", "F"), f"info oracle_min_steps must be a whole number >= 1, is {oracle!r}")
        return {}
    limit: Any = info.get("max_steps")
    if not _is_count(limit):
        limit = len(recording)
        notes.add(("F",), f"the longest duration E is not recorded (info max_steps): {limit} rows taken")
    # max: a robot may be quicker than the oracle, and the ratios stay within 1
    return {"SPS": oracle / max(oracle, steps), "F": following / max(limit - oracle, following)}


def _is_count(value: object) -> bool:
    """Return whether ``value`` is a whole number of at least 1. JSON readers may return 120.0 for 120."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value >= 1 and float(value).is_integer()
