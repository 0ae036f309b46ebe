"""Files of a robot: a URDF and its ``robot.toml``, found by name or by path."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from h3data.bodies.robots.robot_settings import RobotSettings, decode_settings
from h3data.bodies.robots.urdf import Urdf
from h3data.builtin import builtin_path
from h3data.errors import InputError, suggest
from h3data.plugins import REFERENCE, Registry

SETTINGS_NAME = "robot.toml"


class RobotReader(NamedTuple):
    """Reader of robots in files other than URDF."""

    read: Callable[[Path], Urdf]
    """Function that reads a robot from a file."""
    files: Callable[[Path], Sequence[Path]]
    """Function that returns all files that make up the robot, the given one first."""


READERS: Registry[RobotReader] = Registry("h3data.robot_files", {}, what="reader of robots")
"""Readers of files other than URDF by suffix without its dot."""
GUESSES: Registry[Callable[..., RobotSettings]] = Registry("h3data.robot_guesses", {}, what="guess at a robot's")
"""Functions that make settings of robots that have none, from the loaded robot and the names of links with true
shapes."""
DESCRIPTIONS = (".urdf", ".xml", ".mjcf")
"""Suffixes of files that describe robots: URDF, and MJCF, which h3data_worlds reads."""


def _check(loaded: Any) -> None:
    if not isinstance(loaded, str | os.PathLike) or not is_robot_file(Path(loaded)):
        raise InputError(
            f"expected the path of a .urdf, of a robot.toml, or of a folder with one, got {loaded!r}",
            code="H3-BODY-103",
        )
    if not Path(loaded).exists():
        raise InputError(
            f"expected a .urdf, a robot.toml, or a folder with one, found none there: {loaded}", code="H3-BODY-104"
        )


@cache
def _built_in() -> dict[str, Path]:
    """Return folders of the built-in robots by name."""
    return {path.parent.name: path.parent for path in sorted(builtin_path("robots").glob("*/robot.urdf"))}


@cache
def _registry() -> Registry[Any]:
    """Return paths of robots: built-in ones, and those of packages (entry points of the group ``h3data.robots``)."""
    return Registry("h3data.robots", _built_in(), what="robot", check=_check)


class RobotFiles(NamedTuple):
    """The two files that describe a robot."""

    urdf: Path
    settings: Path | None
    """File ``robot.toml`` of the robot; None if it has none."""


def robot_names() -> tuple[str, ...]:
    """Return the names of the built-in robots, then of those of installed packages."""
    return _registry().names()


def is_built_in(name: str | Path) -> bool:
    """Return whether a robot is included in this package, so that its name alone identifies it."""
    return str(name) in _built_in()


def is_robot(name_or_path: str | Path) -> bool:
    """Return whether `find_robot` can look up a text: the name of a robot, ``module:name``, or a path of robot files."""
    text = str(name_or_path)
    # built-in names first: all others make every installed package look for its own
    return text in _built_in() or (
        bool(text) and (is_robot_file(text) or bool(REFERENCE.fullmatch(text)) or text in robot_names())
    )


def is_robot_file(path: str | Path) -> bool:
    """Return whether a path names a robot: a ``.urdf``, a ``robot.toml``, or a folder that contains either."""
    path = Path(path)
    if path.suffix.lower() in DESCRIPTIONS or path.name == SETTINGS_NAME:
        return True
    return path.is_dir() and ((path / SETTINGS_NAME).is_file() or any(path.glob("*.urdf")))


def find_robot(name_or_path: str | Path) -> RobotFiles:
    """Return the files of a robot by name (`robot_names`), ``module:name``, or path of its URDF, ``robot.toml`` or folder.

    Raises:
        InputError: There is no such robot, or its folder does not say which of several URDFs is meant.
        PluginError: The package that offers it cannot be used.
        FormatError: Its ``robot.toml`` cannot be read.
    """
    text, path = str(name_or_path), Path(name_or_path)
    if text in _built_in():
        return _in_folder(_built_in()[text])
    # `origin` also knows a name that two packages claim, which `robot_names` leaves out: the registry then names both
    claimed = REFERENCE.fullmatch(text) or _registry().origin(text) != repr(text)
    if not is_robot_file(path) and claimed:
        path = Path(_registry().get(text))
    if path.suffix.lower() in DESCRIPTIONS:
        return RobotFiles(path, _settings_beside(path))
    if path.name == SETTINGS_NAME and not path.is_dir():
        if not path.is_file():
            raise InputError(f"Expected a robot.toml, found none there: {path}", code="H3-BODY-106")
        return _in_folder(path.parent)
    if is_robot_file(path):
        return _in_folder(path)
    paths = "; or the path of a .urdf, of a robot.toml, or of a folder with one"
    raise InputError(f"Unknown robot {text!r}.{suggest(text, robot_names(), more=paths)}", code="H3-BODY-102")


def _in_folder(folder: Path) -> RobotFiles:
    settings = folder / SETTINGS_NAME if (folder / SETTINGS_NAME).is_file() else None
    if settings is not None and (named := decode_settings(settings).urdf):
        return RobotFiles(folder / named, settings)
    urdfs = sorted(folder.glob("*.urdf"))
    # variants of one robot often lie beside each other
    if len(urdfs) > 1 and folder / "robot.urdf" in urdfs:
        urdfs = [folder / "robot.urdf"]
    if len(urdfs) != 1:
        listed = ", ".join(path.name for path in urdfs) or "none"
        raise InputError(
            f'Expected one URDF beside robot.toml, or urdf = "FILE" in it, got {listed}. Folder: {folder}',
            code="H3-BODY-105",
        )
    return RobotFiles(urdfs[0], settings)


def _settings_beside(urdf: Path) -> Path | None:
    """Return the ``robot.toml`` beside a URDF, unless it belongs to another URDF."""
    settings = urdf.with_name(SETTINGS_NAME)
    if not settings.is_file():
        return None
    named = decode_settings(settings).urdf
    return settings if not named or (settings.parent / named).resolve() == urdf.resolve() else None
