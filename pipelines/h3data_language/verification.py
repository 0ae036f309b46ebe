"""Verification of tasks in words by playing them: a person alone, then a robot and a person, each with the expert."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from h3data.errors import SceneError
from h3data.policies import AssignedPolicy, resolve_policy
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data.scene.scene_sets import find_scene_set
from h3data.scene.sources import SceneSource
from h3data.tasks import WorldRollout
from h3data_language.task import Language
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.runner import run

TRIES = 20
"""So many episodes of a home in sequence may be no task."""


class PlayedTask(NamedTuple):
    """The result of playing one task with some agents."""

    success: bool
    complete: float
    """Share of the task that was completed."""
    steps: int


def play_task(task: Any, episode: Any, policy: str = "language_expert") -> PlayedTask:
    """Play an episode to its end, all of its agents with the policy of a name."""
    kinds = kinds_of(episode.roster)
    policies = [resolve_policy(task, kind, policy)(episode, number) for number, kind in enumerate(kinds)]
    rollout = WorldRollout.of(task, episode, policies)
    run(rollout)
    return PlayedTask(bool(rollout.outcome.success[0]), float(rollout.memory["complete"]), rollout.step)


def verify_task(task: Any, episode: Any) -> tuple[PlayedTask, PlayedTask]:
    """Play an episode by its first person alone, and by all of its agents together."""
    alone = episode.only(kinds_of(episode.roster).index("human"))
    return play_task(task, alone), play_task(task, episode)


class TaskHome(NamedTuple):
    """The tasks of a run that are in one home."""

    name: str
    """Identifier of the home in its set, or its name."""
    source: SceneSource
    numbers: tuple[int, ...]
    """Numbers of its tasks in the run."""
    seed_of: Callable[[int], int]
    """Seed of each of its episodes, by their index in the home."""
    skipped: tuple[int, ...] = ()
    """Indexes of episodes that the set skips already."""


class SkippedTask(NamedTuple):
    """One episode that is no task."""

    home: str
    episode: int
    """Index of the episode in the home."""
    reason: str


class VerifiedTask(NamedTuple):
    """One task that has been played."""

    number: int
    uid: str
    """Identity of the episode, whoever plays it."""
    kind: str
    instruction: str
    alone: PlayedTask
    pair: PlayedTask


def tasks_in(scenes: str, *, episodes: int, seed: int) -> list[TaskHome]:
    """Tasks as ``h3data generate language`` samples them, by home.

    Raises:
        InputError: there are no such scenes.
    """
    label, _, which = scenes.partition("#")
    known = find_scene_set(label)
    if known is not None:
        entries = (known.entry(which),) if which else known.scenes
        skipped = {} if seed else known.skipped.get(Language.name, {})
        seeds = [partial(known.episode_seed, e.id, seed=seed) for e in entries]
        homes = [TaskHome(e.id, e.source, (), s, skipped.get(e.id, ())) for e, s in zip(entries, seeds, strict=True)]
    else:
        named = named_scenes(scenes)
        homes = [
            TaskHome(e.name, e.source, (), partial(_seed_in_turn, seed, k, len(named))) for k, e in enumerate(named)
        ]
    return [h._replace(numbers=tuple(range(k, episodes, len(homes)))) for k, h in enumerate(homes[:episodes])]


def _seed_in_turn(seed: int, place: int, homes: int, index: int) -> int:
    """Seed of an episode of a home, where the episodes of a run go round the homes."""
    return episode_seed(seed, index * homes + place)


def verify_home(task: Any, home: TaskHome) -> tuple[list[VerifiedTask], list[SkippedTask]]:
    """Sample and play the tasks of one home; an episode that is no task, or is not completed, makes room for the next.

    There are fewer tasks than numbers if `TRIES` episodes in sequence are none.
    """
    spec = task.Spec()
    found: list[VerifiedTask] = []
    skipped: list[SkippedTask] = []
    scene = open_scene(home.source)
    free = open_free_space(home.source, spec.agent_radius_m, spec.agent_height_m)
    tries, index = 0, -1
    while len(found) < len(home.numbers) and tries < TRIES:
        index += 1
        if index in home.skipped:
            continue
        tries += 1
        try:
            episode = task.episode(scene, free=free, seed=home.seed_of(index), spec=spec)
        except SceneError as fault:
            skipped.append(SkippedTask(home.name, index, f"could not be sampled [{fault.code}]"))
            continue
        uid = task.codec.uid(episode, [AssignedPolicy(None, "", member.kind) for member in episode.roster])
        words, kind = task.codec.instruction(episode), str(episode.extra["kind"])
        alone, pair = verify_task(task, episode)
        if failing := [
            who for who, played in (("a person alone", alone), ("robot and person", pair)) if not played.success
        ]:
            skipped.append(SkippedTask(home.name, index, f"not completed by {' or '.join(failing)}"))
            continue
        found.append(VerifiedTask(home.numbers[len(found)], uid, kind, words, alone, pair))
        tries = 0
    return found, skipped


def digest_of(tasks: Sequence[VerifiedTask]) -> str:
    """SHA-256 of the identities of some tasks in the order of their numbers."""
    return hashlib.sha256("\n".join(t.uid for t in sorted(tasks)).encode()).hexdigest()


def rows_of_kinds(tasks: Sequence[VerifiedTask]) -> list[list[str]]:
    """The cells of a table of verified tasks, its head first: a row per type of task, and one for all.

    The last two are the steps of the person alone over those of robot and person, and the 95% interval of this ratio of means,
    by resampling of tasks.
    """
    rows = [["type", "tasks", "steps alone", "steps of both", "faster", "95% interval"]]
    kinds = dict.fromkeys(task.kind for task in tasks)
    for name, some in [(k, [t for t in tasks if t.kind == k]) for k in kinds] + [("all", list(tasks))]:
        steps = np.array([[t.alone.steps, t.pair.steps] for t in some], np.float64)
        sampled = steps[np.random.default_rng(0).integers(len(steps), size=(10_000, len(steps)))].mean(1)
        low, high = np.quantile(sampled[:, 0] / sampled[:, 1], (0.025, 0.975))
        alone, pair = steps.mean(0)
        faster = [f"{alone / pair:.2f}", f"[{low:.2f}, {high:.2f}]"]
        rows.append([name, str(len(some)), f"{alone:.0f}", f"{pair:.0f}", *faster])
    return rows


def skip_table(skipped: Sequence[SkippedTask]) -> str:
    """The table of a scene set that makes `SceneSet.place` skip some episodes, as TOML; empty if there are none."""
    by_home: dict[str, list[int]] = {}
    for each in sorted(skipped):
        by_home.setdefault(each.home, []).append(each.episode)
    lines = [f"{home} = {indexes}" for home, indexes in by_home.items()]
    return "\n".join([f"[skipped.{Language.name}]", *lines]) if lines else ""
