"""Episodes of social navigation: sampled from a seed, stored as records, and read back.

In the paper's evaluation the starts and the person's path are the same for all policies (appendix, social navigation), but
Habitat does not store them. Here every episode is a record, `SocialNavEpisode`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies.names import split_walk
from h3data.errors import InputError, SceneError
from h3data.geometry import Array
from h3data.plugins import names_from_data
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode
from h3data.scene import FreeSpace, Scene, scene_digest
from sim_kinematic.agents.roster import ROBOT_BODY, make_roster, with_body
from sim_kinematic.agents.stands import discs_fit
from sim_kinematic.agents.waypoint_walker import HumanPlan, human_plan
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.tasks.codec import SNAP_M
from sim_kinematic.tasks.episode import Episode, rules_dict


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Start poses of robot and person."""

    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    human_heading: float

    @property
    def places(self) -> Array:
        """Places ``(x, z, heading)`` of robot and person, [2, 3]."""
        return np.array([[*self.robot_xz, self.robot_heading], [*self.human_xz, self.human_heading]])

    @classmethod
    def of(cls, places: Array) -> Starts:
        """Start from an array [2, 3] whose first row is the robot's and second the person's."""
        robot, human = np.asarray(places, np.float64)
        return cls(robot_xz=robot[:2], robot_heading=float(robot[2]), human_xz=human[:2], human_heading=float(human[2]))


def sample_pair_starts(
    free: FreeSpace, seed: int, spec: SocialNavSpec, *, fits: Callable[[Array, float], bool] | None = None
) -> Starts:
    """Sample starts at least ``spec.spawn_distance_m`` apart on one island of the free floor.

    ``fits`` tests the robot at ``(xz [2], heading)`` (`sim_kinematic.agents.stands.robot_fits`); without it only the base of
    the rules is kept free of obstacles.

    Raises:
        SceneError: The scene has no two such places.
    """
    rng = generator(seed, "spawn")
    base_fits = partial(discs_fit, free, spec.robot)
    farthest, misfits = 0.0, 0
    for _ in range(200):
        robot_xz, human_xz = free.sample(rng, 2)
        # drawn for rejected pairs too, so that the tests do not shift the draws of later pairs
        robot_heading, human_heading = rng.uniform(-np.pi, np.pi, 2)
        apart = float(np.hypot(*(robot_xz - human_xz)))
        farthest = max(farthest, apart)
        if apart < spec.spawn_distance_m:
            continue
        if not np.isfinite(free.geodesic(robot_xz, human_xz)):
            continue
        if (fits or base_fits)(robot_xz, robot_heading):
            return Starts(
                robot_xz=robot_xz,
                robot_heading=float(robot_heading),
                human_xz=human_xz,
                human_heading=float(human_heading),
            )
        misfits += 1
    narrow = (
        f" At {misfits} of these pairs the robot did not fit: "
        "base_discs_m and base_radius_m of its robot.toml say its size."
    )
    raise SceneError(
        f"Found no start poses {spec.spawn_distance_m} m apart with a free base in 200 attempts (the farthest pair was "
        f"{farthest:.1f} m apart).{narrow if misfits else ''} Hint: a smaller spawn_distance=, or a larger home.",
        code="H3-TASK-048",
    )


def goals_of(episode: Episode) -> tuple[tuple[float, float], ...]:
    """Return the points ``(x, z)`` that the person walks to first; without any, all are sampled by the seed."""
    return tuple((float(x), float(z)) for x, z in episode.extra.get("human_goals", ()))


def plan_of(episode: Episode) -> HumanPlan:
    """Return the plan of the scripted person for an episode of the greatest length."""
    x, z, heading = episode.starts[HUMAN]
    return human_plan(
        episode.free,
        np.array([x, z]),
        float(heading),
        episode.seed,
        episode.spec.human,
        episode.spec.max_steps,
        goals_of(episode),
    )


def stored_episode(episode: Episode) -> SocialNavEpisode:
    """Return the record of an episode, with every goal that the person can reach in its time.

    The record follows from scene, seed and rules alone, and `episode_from` makes the same episode of it, bit for bit.
    """
    robot, human = episode.starts.tolist()
    return SocialNavEpisode(
        robot_start=tuple(robot),
        human_start=tuple(human),
        human_goals=tuple((float(x), float(z)) for x, z in plan_of(episode).goals),
        floor_y=float(episode.free.height_at(episode.starts[ROBOT, :2])),
        max_steps=episode.spec.max_steps,
        seed=episode.seed,
        robot=f"robot/{episode.roster[ROBOT].model}",
        human=f"humanoid/{split_walk(episode.roster[HUMAN].model)[0]}",
        scene_sha256=scene_digest(episode.scene),
        scene_source=dict(episode.scene.source),
        rules=msgspec.to_builtins(rules_dict(episode.spec)),
    )


def episode_from(
    episode: SocialNavEpisode,
    scene: Scene,
    *,
    spec: SocialNavSpec | None = None,
    free: FreeSpace | None = None,
    human: str | None = None,
    robot: str | None = None,
) -> Episode:
    """Return the episode that a record stores, in its scene.

    ``spec`` and the bodies ``human`` and ``robot`` stand in for the record's own; ``free`` saves building the map again.

    Raises:
        SceneError: A start or a goal is not on the free floor, or they are not on one island: the scene is another one.
        InputError: There are no such rules or bodies.
    """
    spec = spec or rules_of(episode)
    free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
    points = _on_free_floor(free, episode)
    robot_name = robot or episode.robot.removeprefix("robot/") or ROBOT_BODY
    human_name = with_body(human, episode.human.removeprefix("humanoid/"))
    headings = np.array([[episode.robot_start[2]], [episode.human_start[2]]])
    goals = [[float(x), float(z)] for x, z in points[2:]]
    # the user may name any robot, a file only those that are built in, installed or trusted
    with nullcontext() if robot else names_from_data():
        roster = make_roster(("robot", "human"), robot=robot_name, human=human_name)
    return Episode(
        scene=scene,
        free=free,
        seed=episode.seed,
        spec=spec,
        starts=np.hstack([points[:2], headings]),
        roster=roster,
        extra={"human_goals": goals} if goals else {},
    )


def rules_of(episode: SocialNavEpisode) -> SocialNavSpec:
    """Return the rules that an episode names; what it does not name is as in the paper."""
    # empty entries give the paper's base and walker, where the spec's defaults are the natural ones
    rules: dict[str, Any] = {"max_steps": episode.max_steps, "robot": {}, "human": {}, **episode.rules}
    try:
        spec = msgspec.convert(rules, SocialNavSpec)
    except msgspec.ValidationError as fault:
        raise InputError(
            f"The rules of the episode cannot be used: {str(fault).replace('`', '')}", code="H3-TASK-052"
        ) from None
    if spec.max_steps < 1 or not 0 < spec.human.speed_mps <= 4:
        raise InputError(
            f"The rules of the episode cannot be used: expected max_steps from 1 and a walking speed above 0 and at most "
            f"4 m/s, got {spec.max_steps} and {spec.human.speed_mps}.",
            code="H3-TASK-049",
        )
    return spec


def _on_free_floor(free: FreeSpace, episode: SocialNavEpisode) -> np.ndarray:
    """Return starts and goals [2 + G, 2]; those that rounding has put beside the free floor are moved onto it."""
    points = np.array([episode.robot_start[:2], episode.human_start[:2], *episode.human_goals], np.float64)
    off = ~free.is_navigable(points)
    points[off] = free.snap(points[off], max_distance_m=SNAP_M)
    names = ["robot_start", "human_start", *(f"human_goals[{k}]" for k in range(len(points) - 2))]
    lost = [name for name, point in zip(names, points, strict=True) if np.isnan(point).any()]
    if lost:
        raise SceneError(
            f"{', '.join(lost[:4])}: more than {SNAP_M} m off the free floor of this scene. Expected the scene for which "
            "the episode was made.",
            code="H3-TASK-050",
        )
    if len(set(free.island(points).tolist())) > 1:
        raise SceneError(
            "The starts and goals of the episode are not on one island of this scene's free floor.", code="H3-TASK-051"
        )
    return points
