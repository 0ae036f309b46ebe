"""Parts of the designs of built-in robots: links with joints, cameras, collision shapes, colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from h3data.mesh.mesh import Mesh

AMBER, IVORY, GRAPHITE, STEEL = (226, 150, 58), (226, 220, 207), (58, 61, 67), (150, 154, 160)
RUBBER, TEAL, GLASS = (34, 35, 38), (64, 186, 176), (20, 26, 34)

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link and the joint that carries it."""

    name: str
    parent: str = ""
    joint: str = ""
    kind: Literal["revolute", "continuous", "prismatic", "fixed"] = "revolute"
    xyz: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 1.0, 0.0)
    limits: tuple[float, float] = (0.0, 0.0)
    mimic: tuple[str, float] | None = None
    """Name of the joint that this joint follows, and the ratio of their motions."""
    mesh: tuple[Mesh, ...] = ()
    collision: tuple[str, ...] = ()
    """URDF text of the collision elements."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Camera on a link of a robot's design."""

    name: str
    link: str
    position: Vector
    forward: Vector = (1.0, 0.0, 0.0)
    up: Vector = (0.0, 0.0, 1.0)
    width: int
    height: int
    hfov_deg: float
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Design:
    """Design of a robot, from which its files are written."""

    name: str
    links: tuple[Link, ...]
    rest: tuple[float, ...]
    """Positions of the joints that neither mimic nor are fixed."""
    body_top_m: float
    """Top of the body above the base frame."""
    base_radius_m: float = 0.25
    base_discs_m: tuple[float, ...] = (0.0,)
    hull_discs_m: tuple[float, ...] = ()
    """Discs that cover the whole resting robot; empty: computed when it is loaded."""
    base_profiles: tuple[tuple[str, tuple[float, ...]], ...] = ()
    hand: tuple[str, Vector]
    hand_forward: Vector = (1.0, 0.0, 0.0)
    reach_bearing_deg: float = 0.0
    legs: tuple[tuple[tuple[str, str, str], Vector], ...] = ()
    cameras: tuple[Camera, ...] = ()


def box_collision(size: Sequence[float], center: Sequence[float] = (0, 0, 0)) -> str:
    """URDF element of a box as collision shape."""
    return _collision(f'<box size="{text(size)}"/>', center, (0, 0, 0))


def capsule_collision(start: Sequence[float], end: Sequence[float], radius: float) -> str:
    """Return a capsule between two points; ``radius`` at both ends."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    way = b - a
    length = float(np.linalg.norm(way))
    pitch = float(np.arctan2(np.hypot(way[0], way[1]), way[2]))
    yaw = float(np.arctan2(way[1], way[0]))
    return _collision(f'<capsule radius="{radius:g}" length="{length:.6g}"/>', (a + b) / 2, (0, pitch, yaw))


def _collision(shape: str, center: Sequence[float] | np.ndarray, rpy: Sequence[float]) -> str:
    return f'<collision><origin xyz="{text(center)}" rpy="{text(rpy)}"/><geometry>{shape}</geometry></collision>'


def text(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers as URDF has them."""
    return " ".join(f"{round(float(v), 6) + 0.0:g}" for v in values)
