"""Initial states of navigation, picking and placing, for training and evaluating learned skills.

The states are taken from episodes of rearrangement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.scene import FreeSpace
from sim_kinematic.agents.robots.arm_clearance import arm_clearance
from sim_kinematic.agents.stands import nearest_stand, robot_fits, robot_stands
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode

Skill = Literal["nav", "pick", "place"]
SKILL_NAMES: tuple[Skill, ...] = get_args(Skill)
CANDIDATES, ROUNDS = 64, 8
"""Number of floor points that are compared at once for one start, and number of such attempts before the start is given
up."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkillStart:
    """Initial state of a robot at rest that has to carry out one skill."""

    skill: Skill
    target: int
    """Number of the object that the skill handles."""
    holds: bool
    """True if the object is in the robot's hand."""
    point: Array
    """Position of the object, or of its goal, in the world, [3] [m]."""
    stand_xz: Array
    """Place nearest to the start, by the path there, from which the hand reaches the point, [2] [m]."""
    xz: Array
    """Position of the robot on the floor, [2] [m]."""
    heading: float
    objects: Array
    """Positions of the objects, [K, 3] [m]; the position of an object in the hand has no meaning."""


def draw_starts(
    episode: RearrangeEpisode,
    skill: Skill,
    count: int,
    rng: np.random.Generator,
    *,
    robot: int = 0,
    path_m: tuple[float, float] | None = None,
    any_spot: bool = False,
    rules: SkillSpec | None = None,
) -> list[SkillStart]:
    """Sample up to ``count`` initial states of a robot in an episode for one skill, fewer if there is no room.

    Args:
        episode: Episode with the home, the objects and their goals.
        skill: Name of the skill; navigation leads to an object or, with the object in the hand, to its goal.
        count: Number of starts.
        rng: Random number generator.
        robot: Number of the agent.
        path_m: Least and greatest length of the path to the nearest stand [m]; None: as in evaluation.
        any_spot: True if objects may also be picked at their goals and placed at their starts, for variety.
        rules: Rules of the skills.
    """
    body = episode.roster[robot].robot
    base, floor = episode.bases[robot], episode.floor(robot)
    fits = robot_fits(body, episode.spec.robot, episode.scene, episode.free)
    clearance = arm_clearance(episode.scene, body, episode.free.floor_y)
    judged = rules or SkillSpec()
    lengths = (judged.nav_start_m, np.inf) if skill == "nav" else (judged.arm_start_m, judged.arm_most_m)
    least, most = path_m or lengths
    lies = np.array([target.start[:3] for target in episode.targets])
    found: list[SkillStart] = []
    spots = [(k, at_goal) for k in range(len(lies)) for at_goal in (False, True)]
    if not any_spot:
        spots = [(k, at_goal) for k, at_goal in spots if skill == "nav" or at_goal == (skill == "place")]
    # stands with a clear arm depend on the spot alone, and spots come again and again
    stands: dict[tuple[int, bool], Array] = {}
    # each spot comes equally often, in a random order
    for number in rng.permutation(count):
        k, at_goal = spots[number % len(spots)]
        point = np.asarray(episode.targets[k].goal if at_goal else lies[k], np.float64)
        if (k, at_goal) not in stands:
            ring = robot_stands(floor, body, base, point)
            stands[k, at_goal] = ring[[clearance.is_open(stand, point) for stand in ring]] if len(ring) else ring
        place = _place(floor, stands[k, at_goal], rng, least, most, fits)
        if place is None:
            continue
        stand = stands[k, at_goal][nearest_stand(floor, stands[k, at_goal], place[:2])[0]]
        objects = lies.copy()
        objects[k] = point
        found.append(
            SkillStart(
                skill=skill,
                target=k,
                holds=skill == "place" or (skill == "nav" and at_goal),
                point=point,
                stand_xz=stand[:2].copy(),
                xz=place[:2],
                heading=float(place[2]),
                objects=objects,
            )
        )
    return found


def _place(
    floor: FreeSpace,
    stands: Array,
    rng: np.random.Generator,
    least: float,
    most: float,
    fits: Callable[[Array, float], bool],
) -> NDArray[np.float64] | None:
    """Return a place ``(x, z, heading)`` [3] at some distance from the nearest of the stands; None: none was found."""
    if not len(stands):
        return None
    # one field from all stands measures every candidate, where geodesics would take a search each
    field = floor.distance_field(stands[:, :2])
    for _ in range(ROUNDS):
        points = floor.sample(rng, CANDIDATES)
        headings = rng.uniform(-np.pi, np.pi, CANDIDATES)
        lengths = field.distance(points)
        # whether the body fits is asked one by one, so only where the length is right
        for k in np.flatnonzero((lengths >= least) & (lengths <= most)).tolist():
            if fits(points[k], float(headings[k])):
                return np.append(points[k], headings[k])
    return None
