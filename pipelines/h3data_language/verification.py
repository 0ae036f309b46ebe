"""Verification of tasks in words by playing them: a person alone, then a robot and a person, each with the expert."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from h3data.policies import AssignedPolicy, resolve_policy
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data.scene.scene_sets import find_scene_set
from h3data.scene.sources import SceneSource
from h3data.tasks import WorldRollout
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.runner import run


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


class TaskPlace(NamedTuple):
    """One task that is sampled: its number in a run, its seed, and the home."""

    number: int
    seed: int
    source: SceneSource


class VerifiedTask(NamedTuple):
    """One task that has been played."""

    number: int
    uid: str
    """Identity of the episode, whoever plays it."""
    kind: str
    instruction: str
    alone: PlayedTask
    pair: PlayedTask


def tasks_in(scenes: str, *, episodes: int, seed: int) -> list[tuple[TaskPlace, ...]]:
    """Tasks as ``h3data generate language`` samples them, those of one home together.

    Raises:
        InputError: there are no such scenes.
    """
    label, _, which = scenes.partition("#")
    known = find_scene_set(label)
    if known is not None:
        known = replace(known, scenes=(known.entry(which),)) if which else known
        places = [(n, *known.place(n)) for n in range(episodes)]
        found = [TaskPlace(n, known.episode_seed(e.id, k, seed=seed), e.source) for n, e, k in places]
    else:
        named = named_scenes(scenes)
        found = [TaskPlace(n, episode_seed(seed, n), named[n % len(named)].source) for n in range(episodes)]
    by_home: dict[SceneSource, list[TaskPlace]] = {}
    for place in found:
        by_home.setdefault(place.source, []).append(place)
    return [tuple(some) for some in by_home.values()]


def verify_home(task: Any, places: Sequence[TaskPlace]) -> list[VerifiedTask]:
    """Sample and play the tasks of one home.

    Raises:
        SceneError: the home has nothing for a task.
    """
    spec, found = task.Spec(), []
    scene = open_scene(places[0].source)
    free = open_free_space(places[0].source, spec.agent_radius_m, spec.agent_height_m)
    for place in places:
        episode = task.episode(scene, free=free, seed=place.seed, spec=spec)
        uid = task.codec.uid(episode, [AssignedPolicy(None, "", member.kind) for member in episode.roster])
        words, kind = task.codec.instruction(episode), str(episode.extra["kind"])
        found.append(VerifiedTask(place.number, uid, kind, words, *verify_task(task, episode)))
    return found


def digest_of(tasks: Sequence[VerifiedTask]) -> str:
    """SHA-256 of the identities of some tasks in the order of their numbers."""
    return hashlib.sha256("\n".join(t.uid for t in sorted(tasks)).encode()).hexdigest()


def rows_of_kinds(tasks: Sequence[VerifiedTask]) -> list[list[str]]:
    """The cells of a table of verified tasks, its head first: a row per type of task, and one for all."""
    rows = [["type", "tasks", "alone", "steps", "pair", "steps", "faster"]]
    kinds = dict.fromkeys(task.kind for task in tasks)
    for name, some in [(k, [t for t in tasks if t.kind == k]) for k in kinds] + [("all", list(tasks))]:
        (a, n), (b, m) = _means([t.alone for t in some]), _means([t.pair for t in some])
        rows.append([name, str(len(some)), f"{a:.2f}", f"{n:.0f}", f"{b:.2f}", f"{m:.0f}", f"{n / m:.2f}"])
    return rows


def _means(played: Sequence[PlayedTask]) -> tuple[float, float]:
    """Share of successes, and mean number of steps."""
    return sum(p.success for p in played) / len(played), sum(p.steps for p in played) / len(played)
