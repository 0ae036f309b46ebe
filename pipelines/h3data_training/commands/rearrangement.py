"""Command ``h3data train rearrange``, which trains the high-level policy with a population of partners.

Episodes are played on CPU cores, or in batched worlds on a device.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from h3data.commands.command import Outcome
from h3data.progress import say
from h3data.terminal import counted
from h3data_training.commands.folders import run_folder
from h3data_training.episodes import listed_scenes

if TYPE_CHECKING:
    from h3data_training.populations.settings import PopulationSettings
    from h3data_training.running import RunResult

CHECKPOINT_BYTES = 3 << 20
"""Approximate size of a checkpoint for each learner, with its moments [bytes]."""
STEPS_PER_CPU_S = 900
"""Approximate number of steps of two agents that a core simulates in a second, including learning."""
STEPS_PER_EPISODE = 600
DRAWING_S = 0.55
"""CPU time to sample an episode [s], measured as 652 s for 1,184 episodes in the 37 homes of h3-homes/train."""
WORLD_STEPS_PER_CPU_S = 10_000
"""Number of steps per second of worlds with oracle skills on a CPU, for 256 worlds on one core."""


def plan_rearrange(out: Path, settings: PopulationSettings, *, workers: int | None) -> Outcome:
    """Return the settings and the estimated cost of a run without running it."""
    data = {"settings": settings.as_dict(), "out": str(out), **_cost(settings, workers)}
    text = f"{json.dumps(settings.as_dict(), indent=1)}\n{_plan(settings, workers)}\nNothing has been done."
    return Outcome(text=text, data=data)


def train_rearrange(
    out: Path,
    settings: PopulationSettings,
    *,
    seed: int,
    workers: int | None,
    device: str,
    resume: bool,
    force: bool,
    stop_after: float | None,
    episodes_file: Path | None,
) -> Outcome:
    """Train a policy of rearrangement in a folder, by `h3data_training.populations.run.train`.

    Raises:
        InputError: the folder is not empty, the disk is full, or there is no such device.
    """
    from h3data_training.populations.run import train

    folder = run_folder(
        out,
        force=force,
        resume=resume,
        device=device,
        checkpoint_bytes=CHECKPOINT_BYTES * len(settings.learners),
        keep=episodes_file,
    )
    result = train(
        folder,
        settings,
        seed=seed,
        workers=workers,
        device=device,
        resume=resume,
        stop_after=stop_after,
        episodes_file=episodes_file,
        say=say,
    )
    return Outcome(text=_summary(result, settings), data=result.as_data(), result=result)


def _cost(settings: PopulationSettings, workers: int | None) -> dict[str, float]:
    """Return a rough cost of a run: workers, updates, episodes, steps, CPU seconds and bytes of checkpoints."""
    from h3data_training.populations.pool import default_workers

    count = 1 if settings.oracle else workers or default_workers()
    per_s = WORLD_STEPS_PER_CPU_S if settings.oracle else STEPS_PER_CPU_S
    seconds = settings.episodes * STEPS_PER_EPISODE / per_s
    updates = settings.updates or 60 * settings.minutes * count / seconds
    return {
        "workers": count,
        "updates": round(updates),
        "episodes": round(updates) * settings.episodes,
        "steps": round(updates) * settings.episodes * STEPS_PER_EPISODE,
        "cpu_s": round(updates * seconds),
        "checkpoint_bytes": CHECKPOINT_BYTES * len(settings.learners),
    }


def _plan(settings: PopulationSettings, workers: int | None) -> str:
    cost = _cost(settings, workers)
    length = counted(settings.updates, "update") if settings.updates else f"{settings.minutes:g} minutes"
    homes = len(listed_scenes(settings.scenes))
    drawing = settings.episodes_per_home * homes * DRAWING_S / 60
    return (
        f"{length} with {counted(int(cost['workers']), 'worker')}: {counted(len(settings.learners), 'learner')} "
        f"({', '.join(settings.learners)}), about {cost['episodes']:.0f} episodes, {cost['steps'] / 1e6:.1f} M steps, "
        f"{cost['cpu_s'] / 3600:.2f} CPU hours; drawing the episodes takes another {drawing:.0f} "
        f"minutes of a core for {counted(homes, 'home')} where the file is not there."
    )


def _summary(result: RunResult, settings: PopulationSettings) -> str:
    row = result.last
    figures = (
        f"in the last update success {row['success']:.0%}, contact {row['collided']:.0%}, {row['steps_per_episode']:.0f} steps"
        if row
        else "no update"
    )
    lines = [
        f"{counted(result.updates, 'update')}, {row.get('episodes', 0):.0f} episodes, {result.decisions / 1e3:.0f} k decisions "
        f"in {result.seconds / 60:.1f} minutes (set-up {result.setup_s:.0f} s): {figures}.",
        f"Policy: {result.folder / 'policy.npz'}",
    ]
    if partners := [name for name in settings.learners if name in settings.partners]:
        lines.append(f"Partners: {', '.join(f'{name}.npz' for name in partners)}")
    if not result.done:
        lines.append("The run is not over. Hint: the same command with --resume goes on.")
    else:
        lines.append(f"Hint: h3data evaluate rearrange --policies weights:{result.folder / 'policy.npz'} -o table/")
    return "\n".join(lines)
