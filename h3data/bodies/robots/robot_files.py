"""Files of a robot: a URDF and its ``robot.toml``, found by name or by path."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from h3data.bodies.robots.robot_settings import decode_settings
from h3data.builtin import builtin_path
from h3data.errors import InputError, did_you_mean

SETTINGS_NAME = "robot.toml"


class RobotFiles(NamedTuple):
    """The two files that describe a robot."""

    urdf: Path
    settings: Path | None
    """Its ``robot.toml``; None if it has none."""


def robot_names() -> tuple[str, ...]:
    """Names of the built-in robots, sorted."""
    return tuple(sorted(path.parent.name for path in builtin_path("robots").glob("*/robot.urdf")))


def is_robot_file(path: str | Path) -> bool:
    """Whether a path is that of a robot by its name: a ``.urdf``, a ``robot.toml``, or a folder that holds either."""
    path = Path(path)
    if path.suffix.lower() == ".urdf" or path.name == SETTINGS_NAME:
        return True
    return path.is_dir() and ((path / SETTINGS_NAME).is_file() or any(path.glob("*.urdf")))


def find_robot(name_or_path: str | Path) -> RobotFiles:
    """Returns the files of a robot by name (`robot_names`), or by the path of its URDF, its ``robot.toml`` or its folder.

    Raises:
        InputError: There is no such robot, or its folder does not say which of several URDFs is meant.
        FormatError: Its ``robot.toml`` cannot be read.
    """
    if str(name_or_path) in robot_names():
        return _in_folder(builtin_path("robots") / str(name_or_path))
    path = Path(name_or_path)
    if path.suffix.lower() == ".urdf":
        return RobotFiles(path, _settings_beside(path))
    if path.name == SETTINGS_NAME and not path.is_dir():
        if not path.is_file():
            raise InputError(f"Expected a robot.toml, found none there: {path}")
        return _in_folder(path.parent)
    if is_robot_file(path):
        return _in_folder(path)
    raise InputError(
        f"No built-in robot {str(name_or_path)!r}.{did_you_mean(str(name_or_path), robot_names())} There are: "
        f"{', '.join(robot_names()) or 'none'}; or give the path of a .urdf, of a robot.toml, or of a folder with one."
    )


def _in_folder(folder: Path) -> RobotFiles:
    settings = folder / SETTINGS_NAME if (folder / SETTINGS_NAME).is_file() else None
    if settings is not None and (named := decode_settings(settings).urdf):
        return RobotFiles(folder / named, settings)
    urdfs = sorted(folder.glob("*.urdf"))
    if len(urdfs) > 1 and folder / "robot.urdf" in urdfs:
        urdfs = [folder / "robot.urdf"]
    if len(urdfs) != 1:
        listed = ", ".join(path.name for path in urdfs) or "none"
        raise InputError(f'Expected one URDF beside robot.toml, or urdf = "FILE" in it, got {listed}. Folder: {folder}')
    return RobotFiles(urdfs[0], settings)


def _settings_beside(urdf: Path) -> Path | None:
    """Returns the ``robot.toml`` beside a URDF, unless it belongs to another URDF."""
    settings = urdf.with_name(SETTINGS_NAME)
    if not settings.is_file():
        return None
    named = decode_settings(settings).urdf
    return settings if not named or (settings.parent / named).resolve() == urdf.resolve() else None
