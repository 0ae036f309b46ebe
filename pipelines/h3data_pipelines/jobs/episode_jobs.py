"""Episodes to simulate, one job each: from presets and scenes with a seed, from scene sets, from episode files."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import msgspec

from h3data.errors import H3DataError, InputError
from h3data.recording import Recording
from h3data.scene.scene_sets import SceneSet, SceneSource
from h3data_pipelines.jobs.failed_episodes import failed_recording

if TYPE_CHECKING:
    from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode
    from h3data.habitat.scene_names import NamedScene
    from sim_kinematic.motion.spec import SocialNavSpec
    from sim_kinematic.tasks.social_nav import SocialNavWorld

J = TypeVar("J")
R = TypeVar("R")
ANY_BODY = "any"
"""As the name of a body: each episode draws one of the built-in ones."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One episode to simulate: all that a worker needs to know."""

    index: int
    seed: int
    scene: str
    """As the command line names it."""
    source: SceneSource
    policy: str
    human: str | None
    """Body instead of the episode's."""
    spec: SocialNavSpec
    drawn_with: SocialNavSpec | None = None
    """Rules with which a set's starts and goals are drawn, whatever ``spec`` changes of them."""
    stored: SocialNavEpisode | None = None
    """Starts and goals from a file."""
    origin: dict[str, Any] | None = None
    """Which episode of which set or file it is; ends up in the recording."""

    @property
    def task(self) -> str:
        return "social_nav"

    def to_json(self) -> dict[str, Any]:
        """What decides the episode, as JSON gives it back; a stored one is known by its ``origin``."""
        fields = json.loads(msgspec.json.encode(replace(self, stored=None, origin=None)))
        return {name: value for name, value in fields.items() if name not in ("stored", "origin")}

    def world(self) -> SocialNavWorld:
        """Scene, starts and rules, ready to run."""
        from h3data.habitat.scene_names import open_free_space, open_scene
        from sim_kinematic.tasks.social_nav import SocialNavWorld
        from sim_kinematic.tasks.social_nav_episodes import drawn_episode, world_of

        scene = open_scene(self.source)
        free = open_free_space(self.source, self.spec.agent_radius_m, self.spec.agent_height_m)
        episode = self.stored
        if self.drawn_with is not None:
            episode = drawn_episode(self.source, seed=self.seed, spec=self.drawn_with)
        if episode is None:
            human = self.human or "female_0"
            return SocialNavWorld.create(scene, seed=self.seed, spec=self.spec, free=free, human=human)
        return world_of(episode, scene, spec=self.spec, free=free, human=self.human)

    def record(self) -> Recording:
        """Play it."""
        from sim_kinematic.tasks.social_nav import simulate_social_nav

        return simulate_social_nav(self.world(), policy=self.policy, episode_id=f"{self.index:06d}")


# --- where they come from ---------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class Changes:
    """What the user asks for; None leaves it to the episode, or to the paper."""

    policy: str
    human: str | None = None
    human_speed: float | None = None
    max_steps: int | None = None

    def body(self, seed: int) -> str | None:
        """Whose body the person has in an episode with this seed."""
        return drawn_body(seed) if self.human == ANY_BODY else self.human

    def applied(self, spec: SocialNavSpec) -> SocialNavSpec:
        """``spec`` with them."""
        if self.human_speed is not None:
            spec = replace(spec, human=replace(spec.human, speed_mps=self.human_speed))
        return spec if self.max_steps is None else replace(spec, max_steps=self.max_steps)


def drawn_body(seed: int, person: int = 0) -> str:
    """The built-in body that an episode draws for one of its people."""
    from h3data.bodies import humanoid_names
    from sim_kinematic.motion.randomness import generator

    names = humanoid_names()
    return names[int(generator(seed, "body", world=person).integers(len(names)))]


def seeded_jobs(
    scenes: tuple[NamedScene, ...], *, episodes: int, seed: int, spec: SocialNavSpec, changes: Changes
) -> list[Job]:
    """Episodes that go round the scenes, everything random drawn from ``seed``."""
    from sim_kinematic.motion.randomness import episode_seed

    return [
        Job(
            index=i, seed=drawn, scene=scenes[i % len(scenes)].name, source=scenes[i % len(scenes)].source,
            policy=changes.policy, human=changes.body(drawn), spec=changes.applied(spec),
        )
        for i in range(episodes)
        for drawn in [episode_seed(seed, i)]
    ]  # fmt: skip


def set_jobs(scenes: SceneSet, *, episodes: int | None, seed: int, changes: Changes) -> list[Job]:
    """The first ``episodes`` episodes of a set, all of them by default; with another ``seed`` than 0, others."""
    from sim_kinematic.motion.spec import SocialNavSpec

    rules = SocialNavSpec(spawn_distance_m=scenes.social_nav.spawn_distance_m)
    return [
        Job(
            index=e.index, seed=e.seed, scene=e.scene, source=e.source, policy=changes.policy, human=changes.body(e.seed),
            spec=changes.applied(rules), drawn_with=rules, origin=e.origin,
        )
        for e in set_episodes(scenes, episodes=episodes, seed=seed)
    ]  # fmt: skip


def set_episodes(scenes: SceneSet, *, episodes: int | None, seed: int) -> Iterator[Draw]:
    """The first ``episodes`` episodes of a set."""
    for i in range(chosen_count(episodes, scenes.episodes, scenes.label)):
        entry, index = scenes.place(i)
        origin = {
            "set": scenes.name, "split": scenes.split, "scene": entry.id, "episode": index, "seed": seed,
            "sha256": scenes.sha256,
        }  # fmt: skip
        drawn = scenes.episode_seed(entry.id, index, seed=seed)
        yield Draw(i, drawn, f"{scenes.label}#{entry.id}", entry.source, origin)


@dataclass(frozen=True)
class Draw:
    """One episode that is drawn from its seed, whatever the task."""

    index: int
    seed: int
    scene: str
    """As the command line names it."""
    source: SceneSource
    origin: dict[str, Any] | None
    """Which episode of which set it is."""


def drawn_episodes(
    scenes: str, *, episodes: int | None, seed: int, homes: int = 4, assets: Sequence[str | Path] = (),
    allow_missing: bool = False,
) -> list[Draw]:  # fmt: skip
    """Episodes in the scenes that ``scenes`` means: all of a set by default, else 10.

    Raises:
        InputError: no such scenes, or a set has fewer episodes.
    """
    from h3data.habitat.scene_names import named_scenes
    from h3data.scene.scene_sets import find_scene_set
    from sim_kinematic.motion.randomness import episode_seed

    label, _, which = scenes.partition("#")
    found = find_scene_set(label)
    if found is not None:
        chosen = replace(found, scenes=(found.entry(which),)) if "#" in scenes else found
        return list(set_episodes(chosen, episodes=episodes, seed=seed))
    named = named_scenes(scenes, homes=homes, assets=assets, allow_missing=allow_missing)
    places = [named[i % len(named)] for i in range(10 if episodes is None else episodes)]
    return [Draw(i, episode_seed(seed, i), place.name, place.source, None) for i, place in enumerate(places)]


def file_jobs(path: Path, *, episodes: int | None, changes: Changes) -> list[Job]:
    """The first ``episodes`` episodes of a Habitat episode file that carries starts and goals of ours.

    Raises:
        FormatError: damaged. InputError: it has no starts and goals. SceneError: a scene is not found.
    """
    from h3data.habitat.episodes.episode_files import read_episodes
    from h3data.habitat.episodes.episode_scenes import scene_of_episode
    from h3data.habitat.episodes.social_nav_episodes import read_social_nav
    from sim_kinematic.tasks.social_nav_episodes import rules_of

    found = read_episodes(path).episodes
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    jobs = []
    for i, episode in enumerate(found[: chosen_count(episodes, len(found), path.name)]):
        stored = read_social_nav(episode)
        if stored is None:
            raise InputError(
                f"Episode {episode.episode_id!r} says neither where robot and person start nor where she walks, as "
                f"Habitat's own files do not. Expected one that h3data wrote (h3data scenes export): {path}"
            )
        origin = {"file": path.name, "sha256": digest, "episode": i, "episode_id": str(episode.episode_id)}
        job = Job(
            index=i, seed=stored.seed, scene=episode.scene_id,
            source=scene_of_episode(episode, stored, path.parent), policy=changes.policy,
            human=changes.body(stored.seed), spec=changes.applied(rules_of(stored)), stored=stored, origin=origin,
        )  # fmt: skip
        jobs.append(job)
    return jobs


def chosen_count(wanted: int | None, there: int, label: str) -> int:
    """How many of the episodes that there are: all of them, or as many as are wanted."""
    if there < 1:
        raise InputError(f"There are no episodes in {label}.")
    if wanted is not None and wanted > there:
        raise InputError(f"--episodes must be at most {there}, which is all of {label}; got {wanted}.")
    return there if wanted is None else wanted


# --- running them -----------------------------------------------------------------------------------------------------
class AnyJob(Protocol):
    """One episode of any task."""

    @property
    def index(self) -> int: ...

    @property
    def seed(self) -> int: ...

    @property
    def scene(self) -> str: ...

    @property
    def task(self) -> str: ...

    @property
    def origin(self) -> dict[str, Any] | None: ...

    def to_json(self) -> dict[str, Any]: ...

    def record(self) -> Recording: ...


def simulate_job(job: AnyJob) -> Recording:
    """One episode, or `failed_recording` of it. Depends on the job alone, so any process may run it."""
    try:
        recording = job.record()
    except MemoryError:
        raise
    except Exception as fault:
        recording = failed_recording(job, fault)
    info = {**recording.episode.info, "job": job.to_json()}
    if job.origin is not None:
        info["origin"] = job.origin
    return replace(recording, episode=replace(recording.episode, info=info))


def simulate_jobs(jobs: Sequence[AnyJob], *, workers: int) -> Generator[Recording]:
    """Recordings in the order of ``jobs``, by this process or by several."""
    yield from run_jobs(simulate_job, jobs, workers=workers)


def run_jobs(work: Callable[[J], R], jobs: Sequence[J], *, workers: int) -> Generator[R]:
    """What ``work`` makes of each job, in their order, by this process or by several."""
    if workers <= 1 or len(jobs) <= 1:
        yield from map(work, jobs)
        return
    # spawn: forked children would share the thread pools of numba and torch
    size = min(workers, len(jobs), os.cpu_count() or 1)
    with ProcessPoolExecutor(size, mp_context=get_context("spawn"), initializer=_start_worker) as pool:
        try:
            with _ctrl_c_held():  # workers inherit that, for as long as they live
                results = pool.map(work, jobs)
            yield from results
        except BrokenProcessPool:
            raise H3DataError(
                "A worker process died, perhaps for lack of memory. Finished episodes are kept: go on with --resume and "
                "fewer --workers."
            ) from None


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """It takes effect at the end of the block; processes that are started in it never see any."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    """Do not outlive the parent."""
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
