"""Verification of tasks in words by playing them: a person alone, then a robot and a person, each with the expert."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from h3data.policies import resolve_policy
from h3data.tasks import WorldRollout
from sim_kinematic.agents.roster import kinds_of
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


def rows_of_kinds(played: Sequence[tuple[str, PlayedTask, PlayedTask]]) -> list[list[str]]:
    """The cells of a table of verified tasks, its head first: a row per type of task, and one for all."""
    rows = [["type", "tasks", "alone", "steps", "pair", "steps", "faster"]]
    kinds = dict.fromkeys(kind for kind, *_ in played)
    for name, some in [(k, [p for p in played if p[0] == k]) for k in kinds] + [("all", list(played))]:
        (a, n), (b, m) = _means([alone for _, alone, _ in some]), _means([pair for *_, pair in some])
        rows.append([name, str(len(some)), f"{a:.2f}", f"{n:.0f}", f"{b:.2f}", f"{m:.0f}", f"{n / m:.2f}"])
    return rows


def _means(played: Sequence[PlayedTask]) -> tuple[float, float]:
    """Share of successes, and mean number of steps."""
    return sum(p.success for p in played) / len(played), sum(p.steps for p in played) / len(played)
