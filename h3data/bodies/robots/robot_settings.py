"""Settings of a robot that URDF cannot hold, in ``robot.toml``: posture, base profiles, hand, legs, cameras."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from h3data.bodies.robots.urdf import Urdf
from h3data.errors import FormatError


class CameraSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a robot's camera, a ``[[cameras]]`` table."""

    name: str
    link: str
    position: tuple[float, float, float]
    """Position in the link frame [m]."""
    forward: tuple[float, float, float]
    """Viewing direction in the link frame."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction in the link frame that points up in the image."""
    width: int
    height: int
    hfov_deg: float


class LegSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a robot's leg, a ``[[legs]]`` table."""

    joints: tuple[str, str, str]
    """Names of the joints: hip roll (about x), hip pitch and knee (about y)."""
    foot: tuple[float, float, float]
    """Middle of the foot in the frame of the link that the knee moves [m]."""


class RobotSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a robot in ``robot.toml``."""

    urdf: str = ""
    """Path of the URDF, relative to this file; if empty, ``robot.urdf`` or the only URDF in the same folder."""
    base_height_m: float = 0.0
    body_height_m: float = 0.5
    base_discs_m: tuple[float, ...] = (0.0,)
    """Positions along x of the discs in which the base must stay free of obstacles [m]."""
    base_profiles: dict[str, tuple[float, ...]] = {}
    """Further sets of base discs, by name."""
    base_radius_m: float = 0.25
    hull_discs_m: tuple[float, ...] = ()
    """Positions along x of discs of the base radius that cover the whole robot at rest [m]; computed if empty."""
    max_speed_mps: float | None = None
    """Speed limit of the base [m/s]; None for the limit of the task."""
    max_turn_rad_s: float | None = None
    """Turn rate limit of the base [rad/s]; None for the limit of the task."""
    rest: tuple[float, ...] = ()
    """Joint positions at rest in URDF order [rad or m]; if empty, zeros clipped to the limits."""
    hand_link: str = ""
    """Link that grasps; empty = the robot has no hand."""
    hand_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position at which the hand holds things, in the frame of that link [m]."""
    hand_forward: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction in which the hand reaches for things, in the frame of that link."""
    hand_up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction in the frame of that link that points up when the hand is level."""
    reach_bearing_deg: float | None = None
    """Bearing in which the robot reaches for things [degrees]: 0 is ahead, 90 to the left. The default is the first of
    ahead, right, left and behind in which the arm reaches something."""
    legs: tuple[LegSettings, ...] = ()
    climbs_stairs: bool | None = None
    """True if the robot walks up and down stairs (default: True for robots with legs). For other robots, stairs are walls."""
    cameras: tuple[CameraSettings, ...] = ()


def decode_settings(path: Path) -> RobotSettings:
    """Read a ``robot.toml`` without its URDF; the result is cached until the file changes.

    Raises:
        FormatError: A field is unknown, of another type, or not finite; the message names it.
    """
    status = path.stat()
    return _decoded(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=32)
def _decoded(path: Path, *version: int) -> RobotSettings:
    del version  # only part of the key, as of robots in `load_robot`, which asks for the settings at every reset
    try:
        settings = msgspec.toml.decode(path.read_bytes(), type=RobotSettings)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise FormatError(f"Not a robot description: {error}. File: {path}", code="H3-BODY-111") from error
    # TOML has nan and inf, which msgspec accepts
    broken = [name for name, value in msgspec.to_builtins(settings).items() if not _finite(value)]
    if broken:
        raise FormatError(
            f"Expected finite numbers in a robot description, got nan or inf in {', '.join(broken)}. File: {path}",
            code="H3-BODY-109",
        )
    return settings


def read_settings(path: Path | None, urdf: Urdf) -> RobotSettings:
    """Return the settings in a file, checked against its URDF, or default settings if there is no file."""
    if path is None:
        return RobotSettings()
    settings = decode_settings(path)
    movable, links = {j.name: j for j in urdf.movable}, {link.name for link in urdf.links}
    # a spherical joint has four numbers
    width = sum(j.width for j in urdf.movable)
    faults = []
    if settings.rest and len(settings.rest) != width:
        faults.append(f"rest has {len(settings.rest)} positions, the URDF {width} movable joints")
    faults += [
        f"camera {c.name} is fixed to {c.link!r}, which is no link" for c in settings.cameras if c.link not in links
    ]
    names = [c.name for c in settings.cameras]
    faults += [f"camera {n} is there twice" for n in sorted({n for n in names if names.count(n) > 1})]
    for camera in settings.cameras:
        # 0 for parallel directions and for zeros
        sight = np.cross(camera.forward, camera.up)
        if not (np.linalg.norm(sight) > 1e-6 and 0 < camera.hfov_deg < 180 and min(camera.width, camera.height) > 0):
            faults.append(f"camera {camera.name} has no picture: look at its forward, up, hfov_deg, width and height")
    if settings.hand_link and settings.hand_link not in links:
        faults.append(f"hand_link is {settings.hand_link!r}, which is no link")
    if np.linalg.norm(np.cross(settings.hand_forward, settings.hand_up)) < 1e-6:
        faults.append("hand_forward and hand_up are parallel or zero")
    for name in (name for leg in settings.legs for name in leg.joints):
        if name not in movable or movable[name].width != 1:
            faults.append(f"a leg has the joint {name!r}, which is no movable one")
    if not settings.base_discs_m or settings.base_radius_m <= 0 or not all(settings.base_profiles.values()):
        faults.append("the base has no discs")
    if faults:
        raise FormatError(
            f"The robot description does not fit its URDF: {'; '.join(faults[:8])}. File: {path}", code="H3-BODY-110"
        )
    return settings


def _finite(value: Any) -> bool:
    """Return whether no number in nested lists and tables is NaN or infinite."""
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
