"""Size and limits of a robot's base on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.errors import SceneError
from h3data.geometry import IDENTITY_POSE
from h3data.scene import FreeSpace, Scene
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec

CARRIED_M = 0.11
"""Radius of a ball that represents the object that a robot carries [m]. Of the objects in `h3-homes`, only boxes of
books have corners farther from their middle (14 cm)."""
_RULES = BaseSpec()
"""Default rules, from which the rules of a task may differ."""


@dataclass(frozen=True, kw_only=True)
class RobotBase(BaseSpec):
    """Base of a robot other than ``quad_arm``, with its own hull."""

    hull_offsets_m: tuple[float, ...]
    """Positions of discs of the base's radius along the x axis that cover the whole robot at rest [m]."""


def base_of(robot: Humanoid | Robot, rules: BaseSpec) -> BaseSpec:
    """Return a task's rules for bases with the discs, limits and hull of one robot; the rules themselves for a person.

    The discs of `HOME_BASE` stand for the robot's own discs, those of `BaseSpec` for its profile ``habitat``, where it
    has one. Fields that the rules set to another value than the default are not changed. For ``quad_arm`` the result is
    ``rules`` itself.
    """
    if isinstance(robot, Humanoid):
        return rules
    own: dict[str, object] = {}
    discs = {
        HOME_BASE.disc_offsets_m: robot.base_discs,
        _RULES.disc_offsets_m: robot.base_profiles.get("habitat", robot.base_discs),
    }.get(rules.disc_offsets_m)
    if discs is not None and rules.disc_radius_m == _RULES.disc_radius_m:
        own = {"disc_offsets_m": tuple(discs.tolist()), "disc_radius_m": robot.base_radius_m}
    for name in ("max_speed_mps", "max_turn_rad_s"):
        limit = getattr(robot, name)
        if limit is not None and getattr(rules, name) == getattr(_RULES, name):
            own[name] = limit
    hull = tuple(robot.hull_discs.tolist())
    # nothing differs: with a base of another class that has the same values, every cache by base would begin anew
    if hull == AVOIDANCE.robot.offsets_m and all(getattr(rules, name) == value for name, value in own.items()):
        return rules
    return RobotBase(**{**vars(rules), **own, "hull_offsets_m": hull})


def hull_of(base: BaseSpec) -> tuple[float, ...]:
    """Return the offsets along x of the discs that cover a whole robot [m]."""
    return base.hull_offsets_m if isinstance(base, RobotBase) else AVOIDANCE.robot.offsets_m


def footprint_of(base: BaseSpec) -> Footprint:
    """Return a robot as other agents see it: its hull, a little wider than its base."""
    return Footprint(hull_of(base), base.disc_radius_m + AVOIDANCE.robot_margin_m)


def wider_by(base: BaseSpec) -> float:
    """Return the difference in width between a base's discs and those of ``quad_arm`` [m]."""
    return base.disc_radius_m - _RULES.disc_radius_m


def carrying_base_of(robot: Robot, base: BaseSpec) -> BaseSpec:
    """Return a base with one more disc, which covers an object that the folded arm carries.

    The object is represented by a ball of the radius `CARRIED_M`. ``base`` itself is returned if its discs cover the
    object already, or if it is not the base that covers the whole robot, as in the profile ``habitat``. The hand of
    ``quad_arm`` is 5 cm behind the front of its base, so that objects it carried went up to 11 cm into walls.
    """
    if base.disc_offsets_m != tuple(robot.base_discs.tolist()) or robot.hand_link < 0:
        return base
    hand = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0, robot.hand_link]
    ahead, _, aside = hand[:3, 3] + hand[:3, :3] @ robot.hand_position
    spare = max(base.disc_radius_m - CARRIED_M, 0.0)
    offsets = np.array(base.disc_offsets_m)
    if np.hypot(offsets - ahead, aside).min() <= spare:
        return base
    nearest = offsets[np.abs(offsets - ahead).argmin()]
    # the least offset that covers the ball; beside a hand that is too far to the side, as well as a disc can
    needed = ahead - math.copysign(math.sqrt(max(spare**2 - float(aside) ** 2, 0.0)), ahead - nearest)
    return replace(base, disc_offsets_m=(*base.disc_offsets_m, float(needed)))


def floor_of(body: Humanoid | Robot, base: BaseSpec, scene: Scene, free: FreeSpace) -> FreeSpace:
    """Return the floor on which an agent finds its paths: ``free``, unless a robot's base is wider than the radius there.

    Raises:
        SceneError: The base is so wide that it fits nowhere.
    """
    fits = isinstance(body, Humanoid) or base.disc_radius_m <= free.radius_m
    return free if fits else _wider_floor(body, base.disc_radius_m, scene, free)


@lru_cache(maxsize=16)
def _wider_floor(robot: Robot, radius_m: float, scene: Scene, free: FreeSpace) -> FreeSpace:
    # depending on how narrow the home is, such a floor is refused or has no area
    try:
        floor = free.as_in(scene, radius_m=radius_m)
    except SceneError:
        floor = None
    if floor is None or not len(floor.polygon.geoms):
        raise SceneError(
            f"A base with discs of {radius_m:g} m fits nowhere in {scene.name}. Hint: a smaller base_radius_m in the "
            f"robot.toml of {robot.name}. File: {robot.file}",
            code="H3-SIM-025",
        )
    return floor
