"""Import of files with tracks of people as recordings, with walls from an occupancy map."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from h3data.errors import FormatError, InputError
from h3data.formats import ImportRequest
from h3data.geometry import ground_pose
from h3data.recording.records import Recording
from h3data_ros.occupancy import read_map, scene_of_map
from h3data_ros.track_recording import Import, Track, parse_goal, record_tracks
from h3data_ros.track_tables import UNITS, TrackTable, by_id, parse_table

BYTES_MAX = 500_000_000
SLOW_S = 10.0
"""Time between observations of one agent above which the times cannot be in seconds [s]."""
SPARSE = 1.5
"""Ratio of present to observed people per row above which observations are not simultaneous, so that rows need a rate."""


def read_tracks(file: str | os.PathLike[str], *, tracks: ImportRequest) -> Recording:
    """Read a file of tracks: CSV with named columns, ETH/UCY, TrajNet++, THÖR-MAGNI or ATC.

    Coordinates are in a plane with z up, as in `h3data_ros.frames`. ``tracks.robot`` is the id of the robot. Without it
    all tracks are people, which the profile ``field`` measures.

    Raises:
        InputError: an option is wrong or missing; the message says which.
        FormatError: the file is damaged, empty or too large.
    """
    path = Path(os.fspath(file))
    if tracks.people:
        raise InputError(
            f"--people names a topic of a bag; this is a file of tracks. Leave it out: {path}", code="H3-ROS-050"
        )
    if path.stat().st_size > BYTES_MAX:
        raise FormatError(
            f"The file has more than {BYTES_MAX // 10**6} MB. Hint: cut it into parts: {path}", code="H3-ROS-051"
        )
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise FormatError(
            f"The file of tracks is not text in UTF-8 ({fault.reason}): {path}", code="H3-ROS-052"
        ) from None
    table = parse_table(text, tracks.columns, tracks.robot, path=path)
    told = Import(source={"format": "tracks", "file": path.name, "layout": table.layout})
    told.goal = None if not tracks.goal else parse_goal(tracks.goal)
    if table.left_out:
        told.warnings.append(f"bodies that are no people are left out: {', '.join(table.left_out[:6])}")
    seconds = _seconds(table, tracks, path)
    unit = tracks.unit or table.unit
    if unit not in UNITS:
        raise InputError(f"--unit is one of {', '.join(UNITS)}, got {unit!r}.", code="H3-ROS-062")
    told.facts |= {"unit": unit} | ({"frames_per_s": tracks.rate} if tracks.rate else {})
    xy = table.xy * UNITS[unit]
    found = []
    for name, rows in by_id(table.ids).items():
        poses = np.full((len(rows), 7), np.nan)
        poses[:, 0], poses[:, 1], poses[:, 2] = xy[rows, 0], 0.0, -xy[rows, 1]
        if table.heading is not None and np.isfinite(table.heading[rows]).all():
            poses[:, 3:] = ground_pose(poses[:, [0, 2]], table.heading[rows])[:, 3:]
        known = np.isfinite(seconds[rows])
        if not known.all():
            told.warnings.append(f"{int((~known).sum())} rows of {name} have no time and are left out")
        time_ns = np.round(seconds[rows][known] * 1e9).astype(np.int64)
        found.append(Track(name=name, time_ns=time_ns, poses=poses[known]))
    _check_times(found, tracks, path)
    robot = None
    if tracks.robot:
        robot = next((track for track in found if track.name == tracks.robot), None)
        if robot is None:
            names = ", ".join(track.name for track in found[:12]) + (", ..." if len(found) > 12 else "")
            raise InputError(f"There is no robot {tracks.robot!r} among the ids {names}: {path}", code="H3-ROS-053")
    scene = None if tracks.map is None else scene_of_map(read_map(tracks.map), Path(tracks.map).stem)
    people = [track for track in found if track is not robot]
    return record_tracks(people, robot, told, scene=scene, hz=tracks.hz, task="tracks", model=tracks.model)


def _seconds(table: TrackTable, tracks: ImportRequest, path: Path) -> np.ndarray:
    """Return times of the observations [N] [s]."""
    if tracks.rate is not None and not 1e-3 <= tracks.rate <= 1e10:
        raise InputError(f"--rate is a number of frames per second, got {tracks.rate:g}.", code="H3-ROS-054")
    if table.frames and tracks.rate is None:
        frames = np.unique(table.t[np.isfinite(table.t)])
        step = float(np.diff(frames).min()) if len(frames) > 1 else 1.0
        raise InputError(
            f"The file counts frames ({', '.join(f'{f:g}' for f in frames[:3])}, ...) and does not say how many there are in a "
            f"second. Hint: --rate {step / 0.4:g} if rows are 0.4 s apart, as in ETH/UCY: {path}",
            code="H3-ROS-055",
        )
    with np.errstate(invalid="ignore", over="ignore"):
        seconds = table.t / (tracks.rate or 1.0)
    if (np.abs(seconds[np.isfinite(seconds)]) > 9e9).any():
        raise InputError(
            f"Times up to {np.nanmax(np.abs(seconds)):g} are no seconds. Hint: --rate 1000 for milliseconds, 1e9 for "
            f"nanoseconds: {path}",
            code="H3-ROS-056",
        )
    return np.where(np.isfinite(seconds), seconds, np.nan)


def _check_times(found: list[Track], tracks: ImportRequest, path: Path) -> None:
    steps = [np.diff(np.unique(track.time_ns)) for track in found if len(track.time_ns) > 1]
    typical = float(np.median(np.concatenate(steps))) * 1e-9 if steps else 0.0
    if typical > SLOW_S:
        raise InputError(
            f"Observations are {typical:g} s apart if times are seconds. Hint: --rate 1000 if they are milliseconds: {path}",
            code="H3-ROS-057",
        )
    if tracks.hz is not None or not steps:
        return
    times = np.unique(np.concatenate([track.time_ns for track in found]))
    spans = [(int(track.time_ns.min()), int(track.time_ns.max())) for track in found if len(track.time_ns)]
    there = sum(int(np.searchsorted(times, b, side="right") - np.searchsorted(times, a)) for a, b in spans)
    observed = sum(len(track.time_ns) for track in found)
    per_step = typical * 1e9 / max(float(np.median(np.diff(times))), 1.0)
    if there > SPARSE * observed and per_step > SPARSE:
        raise InputError(
            f"Agents are observed at different times, every {typical:.3g} s each, so rows need a rate. Hint: --hz "
            f"{max(1 / typical, 1):.0f}: {path}",
            code="H3-ROS-058",
        )
