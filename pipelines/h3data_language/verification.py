"""Verification of tasks in words, played by a person alone and by a robot and a person, with the expert."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from h3data.commands.command import write_text
from h3data.errors import SceneError
from h3data.policies import AssignedPolicy, resolve_policy
from h3data.scene.open import named_scenes
from h3data.scene.scene_sets import find_scene_set
from h3data.scene.sources import SceneSource
from h3data.tasks import WorldRollout
from h3data.terminal import counted
from h3data_language.task import Language
from h3data_pipelines.jobs.episodes import Job, dataset_rules
from h3data_pipelines.jobs.failed_episodes import reason_of
from h3data_pipelines.jobs.result_files import RESULTS, check_options, results_of
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.tasks.recorder import run

TRIES = 20
"""Largest number of consecutive episodes of a home that are not suitable as tasks."""


class PlayedTask(NamedTuple):
    """Result of playing one task with some agents."""

    success: bool
    complete: float
    """Share of the task that was completed."""
    steps: int


def play_task(task: Any, episode: Any, policy: str = "language_expert") -> PlayedTask:
    """Play an episode to its end, with a named policy for all of its agents."""
    kinds = kinds_of(episode.roster)
    policies = [resolve_policy(task, kind, policy)(episode, number) for number, kind in enumerate(kinds)]
    rollout = WorldRollout.of(task, episode, policies)
    run(rollout)
    return PlayedTask(bool(rollout.outcome.success[0]), float(rollout.memory["complete"]), rollout.step)


def verify_task(task: Any, episode: Any) -> tuple[PlayedTask, PlayedTask]:
    """Play an episode with its first person alone, and with all of its agents together."""
    alone = episode.only(kinds_of(episode.roster).index("human"))
    return play_task(task, alone), play_task(task, episode)


class TaskHome(NamedTuple):
    """Tasks of a run in one home."""

    name: str
    """Identifier of the home in its set, or its name."""
    source: SceneSource
    numbers: tuple[int, ...]
    """Numbers of the home's tasks among all tasks of the run."""
    place: int
    """Index of the home among all homes of the run."""
    homes: int
    """Number of homes of the run."""
    seed_of: Callable[[int], int]
    """Function that returns the seed of an episode by its index in the home."""
    skipped: tuple[int, ...] = ()
    """Indices of episodes that the set already skips."""

    def candidate(self, index: int) -> TaskCandidate:
        """Return the episode with a given index."""
        base = Job(
            index * self.homes + self.place,
            self.seed_of(index),
            self.name,
            self.source,
            Language.name,
            dataset_rules(Language()),
        )
        return TaskCandidate(base, index)


@dataclass(frozen=True)
class TaskCandidate:
    """Episode of a home that may become a task."""

    base: Job
    index: int
    """Index of the episode in the home."""

    def to_json(self) -> dict[str, Any]:
        """Return everything that determines the result."""
        return {"episode": self.base.to_json(), "index": self.index}


class SkippedTask(NamedTuple):
    """Episode that was rejected as a task."""

    home: str
    episode: int
    """Index of the episode in the home."""
    reason: str


class VerifiedTask(NamedTuple):
    """Task that has been played."""

    number: int
    uid: str
    """Identity of the episode, regardless of who plays it."""
    kind: str
    instruction: str
    alone: PlayedTask
    pair: PlayedTask


class Verification(NamedTuple):
    """Result of verifying the tasks of some homes, and the rejected episodes."""

    tasks: list[VerifiedTask]
    skipped: list[SkippedTask]
    failed: list[str]
    """Episodes that raised an error, with the error; they are played again when the job continues."""
    short: list[str]
    """Homes with fewer tasks than required, with the reason."""
    new: int
    """Number of episodes that were played now."""


def tasks_in(scenes: str, *, episodes: int, seed: int) -> list[TaskHome]:
    """Return the tasks that ``h3data generate language`` samples, by home.

    Raises:
        InputError: there are no such scenes.
    """
    label, _, which = scenes.partition("#")
    known = find_scene_set(label)
    if known is not None:
        entries = (known.entry(which),) if which else known.scenes
        skipped = {} if seed else known.skipped.get(Language.name, {})
        found = [(e.id, e.source, partial(known.episode_seed, e.id, seed=seed), skipped.get(e.id, ())) for e in entries]
    else:
        named = named_scenes(scenes)
        found = [(e.name, e.source, partial(_seed_in_turn, seed, k, len(named)), ()) for k, e in enumerate(named)]
    count = len(found)
    return [
        TaskHome(name, source, tuple(range(k, episodes, count)), k, count, seed_of, tuple(left_out))
        for k, (name, source, seed_of, left_out) in enumerate(found[:episodes])
    ]


def _seed_in_turn(seed: int, place: int, homes: int, index: int) -> int:
    """Return the seed of an episode of a home, where the episodes of a run go round the homes."""
    return episode_seed(seed, index * homes + place)


def verify_candidate(folder: Path, candidate: TaskCandidate) -> dict[str, Any]:
    """Sample and play one episode, and write the result to its file in a folder, where it survives the process."""
    task, base = Language(), candidate.base
    result: dict[str, Any] = {"job": candidate.to_json(), "failed": "", "reason": ""}
    try:
        episode = base.episode()
        alone, pair = verify_task(task, episode)
    except SceneError as fault:
        result["reason"] = f"could not be sampled [{fault.code}]"
    except MemoryError:
        raise
    except Exception as fault:
        return lost_candidate(candidate, fault)
    else:
        played = (("a person alone", alone), ("robot and person", pair))
        if failing := [who for who, one in played if not one.success]:
            result["reason"] = f"not completed by {' or '.join(failing)}"
        result |= {
            "uid": task.codec.uid(episode, [AssignedPolicy(None, "", member.kind) for member in episode.roster]),
            "kind": str(episode.extra["kind"]),
            "instruction": task.codec.instruction(episode),
            "alone": alone._asdict(),
            "pair": pair._asdict(),
        }
    write_text(folder / f"{base.index:06d}.json", json.dumps(result) + "\n")
    return result


def lost_candidate(candidate: TaskCandidate, fault: Exception) -> dict[str, Any]:
    """Return the result of an episode that raised an error, or whose process died."""
    return {"job": candidate.to_json(), "failed": reason_of(fault), "reason": ""}


def verify_homes(
    homes: Sequence[TaskHome],
    out: Path,
    *,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    progress: Callable[..., Any] | None = None,
) -> Verification:
    """Play the episodes of some homes in rounds, until each home has its tasks; ``out`` gets a file for each episode.

    An episode that is not a task, or is not completed, is replaced by the next one of its home. A home gets fewer tasks than
    requested if `TRIES` episodes in sequence fail. Episodes that have a file already are not played again. The options are
    those of `h3data_pipelines.jobs.evaluation_runs.evaluate_task`.
    """
    check_options(resume=resume, force=force, workers=workers, executor="local")
    results: dict[tuple[str, int], dict[str, Any]] = {}
    new = 0
    while True:
        some = [_tasks_of(home, results) for home in homes]
        wanted = [home.candidate(index) for home, (*_, more) in zip(homes, some, strict=True) for index in more]
        if not wanted:
            break
        wanted.sort(key=lambda candidate: candidate.base.index)
        played, played_now = results_of(
            wanted,
            out,
            partial(verify_candidate, out / RESULTS),
            lost=lost_candidate,
            store=lambda result: result,
            resume=resume,
            force=force and not results,
            workers=workers,
            progress=None if progress is None else partial(_next_round, progress, len(results)),
        )
        new += played_now
        results |= {(job.base.scene, job.index): result for job, result in zip(wanted, played, strict=True)}
    return Verification(
        [task for tasks, *_ in some for task in tasks],
        [one for _, skipped, _ in some for one in skipped if one.reason],
        [
            f"episode {one.episode} of {one.home}: {results[one.home, one.episode]['failed']}"
            for _, skipped, _ in some
            for one in skipped
            if not one.reason
        ],
        [
            f"{home.name} has {len(tasks)} of {counted(len(home.numbers), 'task')}: {TRIES} episodes in sequence are none"
            for home, (tasks, *_) in zip(homes, some, strict=True)
            if len(tasks) < len(home.numbers)
        ],
        new,
    )


def _next_round(progress: Callable[..., Any], before: int, *, total: int, initial: int, **_options: str) -> Any:
    """Return the progress of a round after those in which ``before`` episodes were played."""
    return progress(total=before + total, initial=before + initial, desc="verify", unit="episode")


def _tasks_of(
    home: TaskHome, results: Mapping[tuple[str, int], dict[str, Any]]
) -> tuple[list[VerifiedTask], list[SkippedTask], list[int]]:
    """Return the tasks of a home, episodes that are none, and the indexes of episodes whose results are asked next."""
    found: list[VerifiedTask] = []
    skipped: list[SkippedTask] = []
    tries = 0
    left = (index for index in count() if index not in home.skipped)
    while (missing := len(home.numbers) - len(found)) and tries < TRIES:
        index = next(left)
        result = results.get((home.name, index))
        if result is None:
            return found, skipped, [index, *islice(left, missing - 1)]
        tries += 1
        if result["failed"] or result["reason"]:
            skipped.append(SkippedTask(home.name, index, result["reason"]))
            continue
        alone, pair = (PlayedTask(**result[who]) for who in ("alone", "pair"))
        number, instruction = home.numbers[len(found)], result["instruction"]
        found.append(VerifiedTask(number, result["uid"], result["kind"], instruction, alone, pair))
        tries = 0
    return found, skipped, []


def digest_of(tasks: Sequence[VerifiedTask]) -> str:
    """Return the SHA-256 of the identities of tasks in the order of their numbers."""
    return hashlib.sha256("\n".join(t.uid for t in sorted(tasks)).encode()).hexdigest()


def rows_of_kinds(tasks: Sequence[VerifiedTask]) -> list[list[str]]:
    """Return the cells of a table of verified tasks: a heading, a row for each type of task, and one for all tasks.

    The last two columns are the ratio of the mean steps of the person alone to those of robot and person, and its 95%
    interval by resampling of tasks.
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


def skip_table(homes: Sequence[TaskHome], skipped: Sequence[SkippedTask]) -> str:
    """Return the table of a scene set that makes `SceneSet.place` skip some episodes, as TOML; empty if there are none.

    The table includes the episodes that the set already skips, so that it can replace the set's table.
    """
    indexes = {
        home.name: sorted({*home.skipped, *(s.episode for s in skipped if s.home == home.name)}) for home in homes
    }
    lines = [f"{name} = {some}" for name, some in indexes.items() if some]
    return "\n".join([f"[skipped.{Language.name}]", *lines]) if lines else ""
