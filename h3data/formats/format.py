"""Records that describe a file format, for built-in formats and plug-ins."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

PersonDetail = Literal["full", "low"]
BagStorage = Literal["mcap", "sqlite3"]
LengthUnit = Literal["m", "cm", "mm"]

Function = str | Callable[..., Any] | None
"""A function, or ``module:name`` of one that is imported at first use."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file format: how to recognise it, and how to read or write recordings in it."""

    name: str
    """Name in tables, JSON and entry points, such as ``gfx_replay``; with dashes on the command line."""
    title: str
    """Noun phrase for messages, such as "a gfx-replay recording"."""
    begins: re.Pattern[bytes] | None = None
    """Pattern of the first bytes of files in the format, after gzip and a byte order mark."""
    members: Callable[[Mapping[str, Any], str], bool] | None = None
    """Function that returns whether a JSON document with these top-level members, in a file of this name, has the
    format. Only ``keyframes`` is decoded; other objects are given as {}, anything else as None."""
    suffixes: tuple[str, ...] = ()
    """Endings of file names. `h3data import` collects files with them from folders; they decide the format only where
    neither ``begins`` nor ``members`` is given."""
    hint: str = ""
    """Advice for users who give such a file where a recording is expected."""

    read: Function = None
    """Function that is called as ``read(file, **options)`` with a path (a `SourceFile`, which saves reading its bytes
    again) and returns a `h3data.recording.Recording`."""
    read_options: tuple[Literal["fps", "assets", "tracks"], ...] = ()
    """Keyword arguments that ``read`` takes: ``fps``, steps per second of files without times; ``assets``, an
    `h3data.recording.assets.library.AssetLibrary`; ``tracks``, an `ImportRequest`."""

    write: Function = None
    """Function that is called as ``write(recordings, request)`` with an iterable of recordings (which may be iterated
    repeatedly) and an `ExportRequest`, and returns an `Exported`."""
    write_options: tuple[
        Literal["agent", "assets", "person_detail", "people", "stand_ins", "cameras", "storage", "lidar"], ...
    ] = ()
    """Names of options of `h3data export` that the format supports; other options are refused."""
    target: Literal["file", "folder", "dataset"] = "file"
    """Type of the output. A dataset is a folder as in h3data docs format, which ``--force`` replaces."""
    many: bool = False
    """True if one output holds several recordings."""

    @property
    def option(self) -> str:
        """Name of the format on the command line."""
        return self.name.replace("_", "-")


@dataclass(frozen=True, kw_only=True)
class ImportRequest:
    """Options of the import of tracks of robots and people."""

    people: str = ""
    """Topic of people in a ROS bag; empty for the only one."""
    robot: str = ""
    """Frame or topic of the robot in a ROS bag, or its id in a file of tracks."""
    map: Path | None = None
    """Path of the yaml file of an occupancy map, whose walls become the scene."""
    goal: str = ""
    """Goal of the robot, ``x,y`` in the frame of the map [m]."""
    columns: Sequence[str] = ()
    """Names of the columns of a table, in their order or as ``meaning=name``."""
    unit: LengthUnit | None = None
    """Unit of lengths in a file of tracks; None: that of its format."""
    rate: float | None = None
    """Number of frames per second in a file of tracks, by which frame numbers become times [1/s]."""
    hz: float | None = None
    """Rows per second of the recording [1/s]; None for a row per observation."""
    model: str = ""
    """Body of the robot: a name, or a file in URDF or another format of robots; empty: a cylinder."""


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """Options of an export, besides the recordings."""

    out: Path
    """File or folder to write; the folder, or the parent folder of the file, exists."""
    force: bool = False
    """True if existing files may be replaced."""
    agent: str | None = None
    """Name of the agent whose actions are exported (default: the first robot that acts)."""
    assets: Sequence[Path] = ()
    """Folders below which recorded asset files are searched."""
    person_detail: PersonDetail = "full"
    """Meshes of people: ``full``, or ``low`` for those with fewer vertices."""
    people: Any = "skin"
    """Rendering style of people, a `h3data.bodies.people.rigid_parts.PeopleStyle`."""
    stand_ins: bool = False
    """True if plain shapes replace missing assets, as in `h3data.replay.posed_recording.PosedRecording`."""
    cameras: Sequence[str] = ()
    """Cameras to render, by name or file."""
    storage: BagStorage = "mcap"
    """File format of the messages in a bag."""
    lidar: int = 0
    """Number of rays of a lidar that is cast into the scene for each robot; 0 for none."""
    stored_cameras: Sequence[str] = ()
    """Cameras whose videos are in the source dataset for all recordings."""
    stored_videos: Callable[[int], Sequence[Any]] = lambda number: ()
    """Videos of a recording in the source dataset, `h3data.recording.parquet.videos.EpisodeVideo` records by number of
    the recording."""
    threads: int = 1
    """Number of threads for rendering."""
    backend: Any = "cpu"
    """Back end that renders, a `h3data.replay.stage.FrameBackend`."""
    progress: Callable[[Iterable[Any], int, str], Iterable[Any]] = lambda items, total, unit: items
    """Function that wraps an iterable to show progress."""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """Result of an export: text for people, data for machines."""

    text: str
    data: Mapping[str, Any] = field(default_factory=dict)
