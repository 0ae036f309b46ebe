"""Stored episodes of social navigation: drawn from a seed or read from a file, then played as they are.

In the paper's evaluation the starts and the person's path are the same for all policies (appendix, social navigation), but
Habitat does not store them (spec/habitat.md 1.2). Here an episode is a record, `SocialNavEpisode`, whoever made it.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np

from h3data.errors import InputError, SceneError
from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode
from h3data.habitat.scene_names import open_free_space, open_scene
from h3data.scene import FreeSpace, Scene, scene_digest
from h3data.scene.scene_sets import SceneEntry, SceneSet, SceneSource
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, make_roster
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.tasks.social_nav import SocialNav, plan_of
from sim_kinematic.tasks.task import Episode

SNAP_M = 0.05
"""A stored point may be this far off the free floor: files round to a centimetre, navigation meshes to a cell."""


def stored_episode(episode: Episode) -> SocialNavEpisode:
    """The record of an episode, with every goal that the person can reach in its time.

    Depends on scene, seed and rules alone; `episode_from` gives the same episode back, bit for bit.
    """
    robot, human = episode.starts.tolist()
    return SocialNavEpisode(
        robot_start=tuple(robot),
        human_start=tuple(human),
        human_goals=tuple((float(x), float(z)) for x, z in plan_of(episode).goals),
        floor_y=float(episode.free.floor_y),
        max_steps=episode.spec.max_steps,
        seed=episode.seed,
        robot=f"robot/{episode.roster[ROBOT].model}",
        human=f"humanoid/{episode.roster[HUMAN].model}",
        scene_sha256=scene_digest(episode.scene),
        scene_source=dict(episode.scene.source),
        rules=msgspec.to_builtins(asdict(episode.spec)),
    )


def set_episode(scenes: SceneSet, entry: SceneEntry, index: int, *, seed: int = 0) -> SocialNavEpisode:
    """Episode ``index`` in one scene of a set: a pure function, so that a set of 37,000 is a list of 37 homes.

    ``seed`` 0 gives the set's own episodes. The scene and its map are made at the first call and kept.

    Raises:
        SceneError: the scene has no two starts so far apart.
    """
    return drawn_episode(
        entry.source, seed=scenes.episode_seed(entry.id, index, seed=seed),
        spec=SocialNavSpec(spawn_distance_m=scenes.social_nav.spawn_distance_m),
    )  # fmt: skip


def drawn_episode(source: SceneSource, *, seed: int, spec: SocialNavSpec, robot: str | None = None) -> SocialNavEpisode:
    """Samples the episode of a seed in a scene under these rules, for one robot."""
    free = open_free_space(source, spec.agent_radius_m, spec.agent_height_m)
    scene, body = open_scene(source), robot or ROBOT_BODY
    return stored_episode(SocialNav().episode(scene, seed=seed, spec=spec, free=free, robot=body))


def episode_from(
    episode: SocialNavEpisode, scene: Scene, *, spec: SocialNavSpec | None = None, free: FreeSpace | None = None,
    human: str | None = None, robot: str | None = None,
) -> Episode:  # fmt: skip
    """The episode that a record stores, in its scene.

    ``spec`` and the bodies ``human`` and ``robot`` stand in for the record's own; ``free`` saves building the map again.

    Raises:
        SceneError: a start or a goal is not on the free floor, or they are not on one island: it is another scene.
        InputError: the episode's rules or bodies are none that we know.
    """
    spec = spec or rules_of(episode)
    free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
    points = _on_free_floor(free, episode)
    robot_name = robot or episode.robot.removeprefix("robot/") or ROBOT_BODY
    human_name = human or episode.human.removeprefix("humanoid/") or HUMAN_BODY
    headings = np.array([[episode.robot_start[2]], [episode.human_start[2]]])
    goals = [[float(x), float(z)] for x, z in points[2:]]
    return Episode(
        scene=scene, free=free, seed=episode.seed, spec=spec, starts=np.hstack([points[:2], headings]),
        roster=make_roster(("robot", "human"), robot=robot_name, human=human_name),
        extra={"human_goals": goals} if goals else {},
    )  # fmt: skip


def rules_of(episode: SocialNavEpisode) -> SocialNavSpec:
    """The rules that an episode names; what it does not name is as in the paper."""
    rules: dict[str, Any] = {"max_steps": episode.max_steps, "human": {}, **episode.rules}
    try:
        spec = msgspec.convert(rules, SocialNavSpec)
    except msgspec.ValidationError as fault:
        raise InputError(f"The rules of the episode cannot be used: {str(fault).replace('`', '')}") from None
    if spec.max_steps < 1 or not 0 < spec.human.speed_mps <= 4:
        raise InputError(
            f"The rules of the episode cannot be used: expected max_steps from 1 and a walking speed above 0 and at most "
            f"4 m/s, got {spec.max_steps} and {spec.human.speed_mps}."
        )
    return spec


def _on_free_floor(free: FreeSpace, episode: SocialNavEpisode) -> np.ndarray:
    """Robot, human and goals [2 + G, 2]; those that rounding has put beside the free floor are moved onto it."""
    points = np.array([episode.robot_start[:2], episode.human_start[:2], *episode.human_goals], np.float64)
    off = ~free.is_navigable(points)
    points[off] = free.snap(points[off], max_distance_m=SNAP_M)
    names = ["robot_start", "human_start", *(f"human_goals[{k}]" for k in range(len(points) - 2))]
    lost = [name for name, point in zip(names, points, strict=True) if np.isnan(point).any()]
    if lost:
        raise SceneError(
            f"{', '.join(lost[:4])}: more than {SNAP_M} m off the free floor of this scene. Expected the scene for which "
            "the episode was made."
        )
    if len(set(free.island(points).tolist())) > 1:
        raise SceneError("The starts and goals of the episode are not on one island of this scene's free floor.")
    return points
