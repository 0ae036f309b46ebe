"""Sources of episodes: homes by name, which are opened at first use, and episodes that are sampled in them by seeds.

`in_words` describes an environment's episodes in one line, for its ``repr``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from h3data.bodies import Robot
from h3data.errors import InputError, SceneError
from h3data.progress import progress
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data.scene.sources import SceneSource
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, AgentSpec, make_roster
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.task import Task

Scenes = str | os.PathLike[str] | Scene | Sequence[str | os.PathLike[str] | Scene]


class Home:
    """Scene for episodes, together with its free floor."""

    def __init__(self, source: Scene | SceneSource, radius_m: float, height_m: float) -> None:
        self.source, self._size = source, (radius_m, height_m)

    @cached_property
    def scene(self) -> Scene:
        """Scene, opened at first use."""
        return self.source if isinstance(self.source, Scene) else open_scene(self.source)

    @cached_property
    def free(self) -> FreeSpace:
        """Free floor of the scene, computed or read from the cache at first use."""
        radius, height = self._size
        if isinstance(self.source, Scene):
            return FreeSpace.from_scene(self.source, radius_m=radius, height_m=height)
        return open_free_space(self.source, radius, height)

    @property
    def is_ready(self) -> bool:
        """Return whether the scene has been opened and its floor computed."""
        return "free" in vars(self) and "scene" in vars(self)


class EpisodeSource:
    """Source of episodes of a task in several homes, each determined by a run's seed and the episode's index."""

    def __init__(
        self,
        task: Task,
        scenes: Scenes,
        *,
        spec: Any = None,
        agents: str | Sequence[str | Robot] | None = None,
        robot: str | Path | Robot = ROBOT_BODY,
        human: str = HUMAN_BODY,
    ) -> None:
        """Look up scenes and agents; the scenes are opened at first use.

        Args:
            task: task of the episodes.
            scenes: names as on the command line (``h3-homes/train``, ``small:3``), a `Scene`, or several.
            spec: rules (default: the task's).
            agents: agents of every episode (default: the task's roster).
            robot: body of robots named by their kind.
            human: body of people named by their kind.

        Raises:
            InputError: There are no such scenes or agents.
        """
        self.task, self.scenes = task, scenes
        self.spec = task.Spec() if spec is None else spec
        self.roster: tuple[AgentSpec, ...] = make_roster(
            task.agents if agents is None else agents, robot=robot, human=human
        )
        size = self.spec.agent_radius_m, self.spec.agent_height_m
        self.homes = tuple(Home(source, *size) for source in scene_sources(scenes))

    def home_of(self, seed: int, index: int) -> int:
        """Return the number of the home of episode ``index`` in the run ``seed``."""
        return int(generator(seed, "scene", step=index).integers(len(self.homes))) if len(self.homes) > 1 else 0

    def sample(self, seed: int, index: int) -> Episode:
        """Return the episode ``index`` of the run ``seed``.

        Raises:
            SceneError: None of 20 homes and seeds has room for an episode.
        """
        fault: SceneError | None = None
        # number of homes and seeds that are tried before a source gives up, as some homes have no room for
        # some episodes
        attempts = 20
        for attempt in range(attempts):
            # another seed changes home and episode; another index would give a later episode of the run twice
            run = seed if attempt == 0 else episode_seed(seed, attempt)
            home = self.homes[self.home_of(run, index)]
            try:
                return _sampled(self.task, home.scene, home.free, episode_seed(run, index), self.spec, self.roster)
            # only for lack of room: wrong input would fail in every home
            except SceneError as error:
                fault = error
        assert fault is not None
        raise fault

    def prepare(self, runs: Sequence[tuple[int, int]]) -> None:
        """Open the homes of some episodes, with a progress bar."""
        # each home once, in the order in which the episodes need them
        numbers = dict.fromkeys(self.home_of(seed, index) for seed, index in runs)
        missing = [self.homes[k] for k in numbers if not self.homes[k].is_ready]
        if not missing:
            return
        with progress(desc="homes", total=len(missing), unit="home", delay=1.0, leave=False) as made:
            for home in missing:
                _ = home.scene, home.free
                made.update()


@lru_cache(maxsize=64)
def _sampled(task: Task, scene: Scene, free: FreeSpace, seed: int, spec: Any, roster: tuple[AgentSpec, ...]) -> Episode:
    """Return an episode, which is sampled once however often it is played."""
    return task.sample(scene, free, seed, spec, roster)


def scene_sources(scenes: Scenes) -> list[Scene | SceneSource]:
    """Return the scenes that are named, as on the command line, or given, one after the other.

    Raises:
        InputError: There are no such scenes.
    """
    listed = list(scenes) if isinstance(scenes, list | tuple) else [scenes]
    sources: list[Scene | SceneSource] = []
    for one in listed:
        if isinstance(one, Scene):
            sources.append(one)
        elif isinstance(one, str | os.PathLike):
            sources += [named.source for named in named_scenes(os.fspath(one))]
        else:
            raise InputError(f"Expected scenes as names or Scene, got {type(one).__name__}.", code="H3-TASK-059")
    if not sources:
        raise InputError("Expected at least one scene, got none.", code="H3-TASK-058")
    return sources


def in_words(
    task: str,
    scenes: Scenes,
    count: int,
    agents: Mapping[str, str],
    *,
    beside: Mapping[str, str] | None = None,
    worlds: int = 1,
) -> str:
    """Return a description of an environment in one line.

    An example is ``social_nav, 37 scenes of h3-homes/train, robot quad_arm beside human female_0, 64 worlds``.

    Args:
        task: Name of the task.
        scenes: Scenes as given to the environment.
        count: Number of scenes.
        agents: Models, by kind, of the agents that act.
        beside: Models, by kind, of the agents that a policy moves.
        worlds: Number of worlds.
    """
    who = " and ".join(f"{kind} {model}" for kind, model in agents.items())
    others = " and ".join(f"{kind} {model}" for kind, model in (beside or {}).items())
    return (
        f"{task}, {_scenes_in_words(scenes, count)}, {who}{' beside ' + others if others else ''}, {worlds} "
        f"world{'s' if worlds > 1 else ''}"
    )


def _scenes_in_words(scenes: Scenes, count: int) -> str:
    # largest number of scenes that are named
    most = 3
    listed: list[Any] = list(scenes) if isinstance(scenes, list | tuple) else [scenes]
    names = [scene.name if isinstance(scene, Scene) else os.fspath(scene) for scene in listed]
    named = ", ".join(names[:most]) + (", ..." if len(names) > most else "")
    return f"scene {named}" if count == 1 else f"{count} scenes of {named}"
