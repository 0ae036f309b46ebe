"""Command ``h3data robots``, which lists and renders robots and computes the reach of their hands."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import tyro

from h3data.bodies import Robot, guess_robot_settings, load_robot, robot_names, solve_ik
from h3data.bodies.robots.robot_files import SETTINGS_NAME
from h3data.bodies.robots.robot_settings import RobotSettings
from h3data.commands.command import ForceFlag, Group, JsonFlag, Outcome, claim_file
from h3data.errors import H3DataError, InputError

log = logging.getLogger(__name__)

UpChoice = Annotated[
    Literal["z", "y"], tyro.conf.arg(help="Axis of a URDF's base frame that points up; Habitat's own robots have y.")
]


@dataclass(frozen=True)
class RobotsShow:
    """Render robots from several sides, at rest and with the hand on a circle; without -o, only list them.

    Examples:
        h3data robots show
        h3data robots show -o robots.jpg
        h3data robots show lift_arm my_robot/my_robot.urdf --views 8 -o two.png
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of robots, or .urdf files (default: all built-in robots)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """PNG or JPEG file to write."""
    views: int = 6
    """Number of views at equally spaced headings."""
    width: int = 1600
    """Width of the picture [pixels]."""
    up: UpChoice = "z"
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Render the robots, and return their names and sizes."""
        from h3data.render.image_files import write_image

        robots = [load_robot(name, up=self.up) for name in self.names] or _usable_robots(self.up)
        rows = [_row(robot) for robot in robots]
        if self.out is None:
            return Outcome(text="\n".join(_line(row) for row in rows), data={"robots": rows})
        if not 1 <= self.views <= 24 or not 200 <= self.width <= 8000:
            raise InputError(
                f"Expected --views 1 to 24 and --width 200 to 8000, got {self.views} and {self.width}.",
                code="H3-BODY-139",
            )
        if self.out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise InputError(f"Expected a file name that ends in .png or .jpg, got: {self.out}", code="H3-BODY-125")
        target = claim_file(self.out, force=self.force)
        image = self._draw(robots)
        write_image(target, image)
        height, width = image.shape[:2]
        data = {"file": str(target), "width": width, "height": height, "robots": rows}
        return Outcome(text=f"wrote {target} ({width}x{height}, {len(robots)} robots)", data=data)

    def _draw(self, robots: list[Robot]) -> Any:
        from h3data_pipelines.assets.turntable import turntable

        strips = []
        for robot in robots:
            strips.append(turntable(robot, views=self.views, width=self.width))
            if robot.hand_link >= 0:
                strips.append(turntable(robot, views=self.views, width=self.width, reaching=True))
        return np.concatenate(strips)


@dataclass(frozen=True)
class RobotsReach:
    """Find joint positions that bring a robot's hand or a link to a point.

    The point is in the robot's root frame (x forward, y up, z right) [m]. The exit code is 1 if the point is out of
    reach; then the nearest posture is printed.

    Examples:
        h3data robots reach quad_arm 0.8 0.5 0.1
        h3data robots reach lift_arm -0.1 0.9 0.6 --json
        h3data robots reach my_robot.urdf 0.4 0 0.2 --link tool0
    """

    name: tyro.conf.Positional[str]
    """Built-in robot or .urdf file."""
    point: tyro.conf.Positional[tuple[float, float, float]]
    """Point to reach, x y z in the robot's root frame [m]."""
    link: str = ""
    """Link whose origin is moved to the point (default: the robot's hand, at the point where it holds things)."""
    up: UpChoice = "z"
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Solve the inverse kinematics and return the joint positions."""
        robot = load_robot(self.name, up=self.up)
        if not self.link and robot.hand_link < 0:
            raise InputError(f"Robot {robot.name} has no hand: name one of its links with --link.", code="H3-BODY-140")
        link = self.link or robot.links[robot.hand_link].name
        offset = (0.0, 0.0, 0.0) if self.link else robot.hand_position
        found = solve_ik(robot, link, self.point, offset=offset)
        moved = {n: float(v) for n, v in zip(robot.joint_names, found.joint_pos, strict=True)}
        at_limit = [n for n, clamped in zip(robot.joint_names, found.clamped, strict=True) if clamped]
        lines = [f"{n:<24} {v:9.4f}" + ("  at its limit" if n in at_limit else "") for n, v in moved.items()]
        lines.append(f"{'reached' if found.reached else 'out of reach'}: {1000 * found.position_error_m:.2f} mm left")
        data = {
            "link": link,
            "joint_pos": moved,
            "reached": bool(found.reached),
            "position_error_m": float(found.position_error_m),
            "clamped": at_limit,
        }
        return Outcome(text="\n".join(lines), data=data, exit_code=0 if found.reached else 1)


@dataclass(frozen=True)
class RobotsInit:
    """Write a robot.toml for a URDF with guesses about its base, arm, hand, cameras and posture, which you can edit.

    A robot.toml next to the URDF is used whenever the URDF is loaded. h3data docs robots explains its fields.

    Examples:
        h3data robots init fetch.urdf
        h3data robots init my_robot/my_robot.urdf -o my_robot/robot.toml --force
    """

    urdf: tyro.conf.Positional[Path]
    """The .urdf file."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write (default: robot.toml next to the URDF)."""
    up: UpChoice = "z"
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the settings file with guesses from the URDF."""
        settings = guess_robot_settings(self.urdf, up=self.up)
        target = claim_file(self.out or self.urdf.with_name(SETTINGS_NAME), force=self.force)
        reference = self.urdf.name if target.parent.resolve() == self.urdf.parent.resolve() else self.urdf.resolve()
        settings = msgspec.structs.replace(settings, urdf=str(reference))
        header = "# What a URDF cannot say about a robot, guessed by h3data; h3data docs robots explains the fields.\n"
        target.write_text(header + encode_settings(settings), encoding="utf-8")
        hand = f"hand {settings.hand_link}" if settings.hand_link else "no hand found"
        discs = f"{len(settings.base_discs_m)} base discs of {settings.base_radius_m} m"
        text = f"wrote {target}: {discs}, {hand}, cameras: {', '.join(c.name for c in settings.cameras) or 'none'}"
        return Outcome(text=text, data={"file": str(target), "settings": msgspec.to_builtins(settings)})


ROBOTS = Group(
    "Robots: show the included ones or any URDF, compute what a hand reaches, write a robot.toml.",
    {"show": RobotsShow, "reach": RobotsReach, "init": RobotsInit},
)


def _usable_robots(up: Literal["z", "y"]) -> list[Robot]:
    """Return all robots with a name; warn about those of installed packages that cannot be loaded, and leave them out."""
    robots = []
    for name in robot_names():
        try:
            robots.append(load_robot(name, up=up))
        except H3DataError as fault:
            log.warning("Ignored: %s", fault)
    return robots


def _row(robot: Robot) -> dict[str, Any]:
    triangles = sum(len(link.mesh.faces) for link in robot.links if link.mesh is not None)
    joints = {
        name: [_finite(low), _finite(high)]
        for name, low, high in zip(robot.joint_names, robot.lower, robot.upper, strict=True)
    }
    return {
        "name": robot.name,
        "links": len(robot.links),
        "joints": joints,
        "triangles": triangles,
        "base_height_m": robot.base_height_m,
        "cameras": [c.name for c in robot.cameras],
    }


def _finite(limit: float) -> float | None:
    return float(limit) if np.isfinite(limit) else None


def _line(row: dict[str, Any]) -> str:
    cameras = ", ".join(row["cameras"]) or "none"
    return (
        f"{row['name']:<12} {row['links']:>3} links {len(row['joints']):>3} joints {row['triangles']:>6} triangles  "
        f"cameras: {cameras}"
    )


def encode_settings(settings: RobotSettings) -> str:
    """Return the text of a ``robot.toml`` with all fields that differ from their defaults, and the base's discs."""
    lines: list[str] = []
    tables: list[str] = []
    for name, value in msgspec.structs.asdict(settings).items():
        default = next(f.default for f in msgspec.structs.fields(RobotSettings) if f.name == name)
        if isinstance(value, tuple) and value and isinstance(value[0], msgspec.Struct):
            for one in value:
                tables += ["", f"[[{name}]]", *(f"{k} = {_toml(v)}" for k, v in msgspec.structs.asdict(one).items())]
        elif value != default or name.startswith("base_discs"):
            if name == "base_profiles":
                tables += [
                    "",
                    "[base_profiles]",
                    *(f"{_toml(k)} = {_toml(v)}" for k, v in settings.base_profiles.items()),
                ]
            else:
                lines.append(f"{name} = {_toml(value)}")
    return "\n".join([*lines, *tables, ""])


def _toml(value: Any) -> str:
    """Return a number, a text, or a list of them in TOML: JSON, which is a part of it, does."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)
