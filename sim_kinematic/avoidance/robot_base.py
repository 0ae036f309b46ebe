"""A robot's own size and limits on the floor: what drives, what others avoid, and where it fits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from h3data.bodies import Robot
from h3data.errors import SceneError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.motion.spec import HOME_BASE, BaseSpec

_RULES = BaseSpec()


@dataclass(frozen=True, kw_only=True)
class RobotBase(BaseSpec):
    """The base of a robot other than ``quad_arm``, whose hull `hull_of` cannot take for granted."""

    hull_offsets_m: tuple[float, ...]
    """Discs of the base's radius along x that cover the whole robot at rest."""


def base_of(robot: Robot, rules: BaseSpec) -> BaseSpec:
    """Returns a task's rules for bases with the discs, limits and hull of one robot.

    The discs of `HOME_BASE` stand for the robot's own discs, those of `BaseSpec` for its profile ``habitat``, where it has one.
    What the rules set to another value than the default stays: they ask for something special. For ``quad_arm`` the result
    is ``rules`` itself.
    """
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
    if hull == AVOIDANCE.robot.offsets_m and all(getattr(rules, name) == value for name, value in own.items()):
        return rules
    return RobotBase(**{**vars(rules), **own, "hull_offsets_m": hull})


def hull_of(base: BaseSpec) -> tuple[float, ...]:
    """Returns the offsets along x of the discs that cover a whole robot [m]."""
    return base.hull_offsets_m if isinstance(base, RobotBase) else AVOIDANCE.robot.offsets_m


def footprint_of(base: BaseSpec) -> Footprint:
    """Returns a robot as other agents see it: its hull, a little wider than its base."""
    return Footprint(hull_of(base), base.disc_radius_m + AVOIDANCE.robot_margin_m)


def wider_by(base: BaseSpec) -> float:
    """Returns by how much a base's discs are wider than those of ``quad_arm`` [m]."""
    return base.disc_radius_m - _RULES.disc_radius_m


def floor_of(robot: Robot, base: BaseSpec, scene: Scene, free: FreeSpace) -> FreeSpace:
    """Returns the floor on which a robot finds its paths: ``free``, unless its base is wider than the agents' radius there.

    Raises:
        SceneError: The base is so wide that it fits nowhere.
    """
    return free if base.disc_radius_m <= free.radius_m else _wider_floor(robot, base.disc_radius_m, scene, free)


@lru_cache(maxsize=16)
def _wider_floor(robot: Robot, radius_m: float, scene: Scene, free: FreeSpace) -> FreeSpace:
    try:
        floor = FreeSpace.from_scene(
            scene,
            radius_m=radius_m,
            height_m=free.height_m,
            max_climb_m=free.max_climb_m,
            cell_m=free.cell_m,
            floor_y=free.floor_y,
        )
    except SceneError:
        floor = None
    if floor is None or not len(floor.polygon.geoms):
        raise SceneError(
            f"A base with discs of {radius_m:g} m fits nowhere in {scene.name}. Hint: a smaller base_radius_m in the "
            f"robot.toml of {robot.name}. File: {robot.file}"
        )
    return floor
