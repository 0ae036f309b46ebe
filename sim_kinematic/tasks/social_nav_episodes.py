"""Stored episodes of social navigation: drawn from a seed or read from a file, then played as they are.

In the paper's evaluation the starts and the person's path are the same for all policies (appendix, social navigation), but
Habitat does not store them (spec/habitat.md 1.2). Here an episode is a record, `SocialNavEpisode`, whoever made it.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode
from h3data.habitat.scene_names import open_free_space, open_scene
from h3data.scene import FreeSpace, Scene, scene_digest
from h3data.scene.scene_sets import SceneEntry, SceneSet, SceneSource
from sim_kinematic.agents.waypoint_walker import human_plan
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.social_nav import SocialNavWorld, Starts

SNAP_M = 0.05
"""A stored point may be this far off the free floor: files round to a centimetre, navigation meshes to a cell."""


def episode_of(world: SocialNavWorld) -> SocialNavEpisode:
    """The episode that ``world`` is about to play, with every goal that the person can reach in its time.

    Depends on scene, seed and rules alone; `world_of` gives the same world back, bit for bit.
    """
    starts, spec, free = world.starts, world.spec, world.free
    plan = human_plan(
        free, starts.human_xz, starts.human_heading, world.seed, spec.human, spec.max_steps, world.goals
    )  # fmt: skip
    robot_x, robot_z = map(float, starts.robot_xz)
    human_x, human_z = map(float, starts.human_xz)
    return SocialNavEpisode(
        robot_start=(robot_x, robot_z, starts.robot_heading),
        human_start=(human_x, human_z, starts.human_heading),
        human_goals=tuple((float(x), float(z)) for x, z in plan.goals),
        floor_y=float(free.floor_y),
        max_steps=spec.max_steps,
        seed=world.seed,
        robot=f"robot/{world.robot_name}",
        human=f"humanoid/{world.human_name}",
        scene_sha256=scene_digest(world.scene),
        scene_source=dict(world.scene.source),
        rules=msgspec.to_builtins(asdict(spec)),
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


def drawn_episode(source: SceneSource, *, seed: int, spec: SocialNavSpec) -> SocialNavEpisode:
    """The episode that ``seed`` draws in a scene under these rules."""
    free = open_free_space(source, spec.agent_radius_m, spec.agent_height_m)
    return episode_of(SocialNavWorld.create(open_scene(source), seed=seed, spec=spec, free=free))


def world_of(
    episode: SocialNavEpisode, scene: Scene, *, spec: SocialNavSpec | None = None, free: FreeSpace | None = None,
    human: str | None = None,
) -> SocialNavWorld:  # fmt: skip
    """The world that plays a stored episode in its scene.

    ``spec`` and ``human`` (name of a built-in body) stand in for the episode's own; ``free`` saves building the map again.

    Raises:
        SceneError: a start or a goal is not on the free floor, or they are not on one island: it is another scene.
        InputError: the episode's rules or bodies are none that we know.
    """
    spec = spec or rules_of(episode)
    free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
    points = _on_free_floor(free, episode)
    robot_name = episode.robot.removeprefix("robot/") or "quad_arm"
    human_name = human or episode.human.removeprefix("humanoid/") or "female_0"
    return SocialNavWorld(
        scene=scene, free=free, seed=episode.seed, spec=spec, robot=load_robot(robot_name),
        human=load_humanoid(human_name), robot_name=robot_name, human_name=human_name,
        starts=Starts(
            robot_xz=points[0], robot_heading=episode.robot_start[2], human_xz=points[1],
            human_heading=episode.human_start[2],
        ),
        goals=tuple((float(x), float(z)) for x, z in points[2:]),
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
