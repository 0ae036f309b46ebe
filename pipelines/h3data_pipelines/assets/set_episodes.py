"""Stored episodes of social navigation, sampled in the homes of a scene set."""

from __future__ import annotations

from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode
from h3data.scene.open import open_free_space, open_scene
from h3data.scene.scene_sets import SceneEntry, SceneSet
from h3data.scene.sources import SceneSource
from sim_kinematic.agents.roster import ROBOT_BODY
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.tasks.social_nav import SocialNav


def set_episode(scenes: SceneSet, entry: SceneEntry, index: int, *, seed: int = 0) -> SocialNavEpisode:
    """Sample episode ``index`` in one scene of a set.

    The episode depends on nothing but its arguments, so that a set of 37,000 episodes is stored as a list of 37 homes.

    ``seed`` 0 gives the set's own episodes. The scene and its map are built at the first call and cached.

    Raises:
        SceneError: the scene has no two starts at the required distance.
    """
    return sampled_episode(
        entry.source,
        seed=scenes.episode_seed(entry.id, index, seed=seed),
        spec=SocialNavSpec(spawn_distance_m=scenes.social_nav.spawn_distance_m),
    )


def sampled_episode(
    source: SceneSource, *, seed: int, spec: SocialNavSpec, robot: str | None = None
) -> SocialNavEpisode:
    """Sample the episode with a seed in a scene under some rules, for one robot."""
    free = open_free_space(source, spec.agent_radius_m, spec.agent_height_m)
    scene, body = open_scene(source), robot or ROBOT_BODY
    task = SocialNav()
    return task.codec.record(task.episode(scene, seed=seed, spec=spec, free=free, robot=body))
