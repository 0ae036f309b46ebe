"""Evaluations in a folder, with results of each episode, tables of all results, and optional recordings.

``episodes/000012.json`` has the rows of one episode, and ``recordings/000012`` is a dataset with its recordings.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from h3data.errors import InputError
from h3data.plugins import own_version
from h3data.recording import Recording
from h3data.render.light.sources import LightMode
from h3data_pipelines.jobs.cross_play import CrossPlayTable, Row, cross_play_table
from h3data_pipelines.jobs.episode_files import FileJobs, notes_on, requested_jobs
from h3data_pipelines.jobs.episodes import Choices, check_numbers, with_skills
from h3data_pipelines.jobs.evaluations import (
    ALL,
    Evaluation,
    chosen_names,
    failed_evaluation,
    files_of,
    play_evaluation,
    write_recordings,
)
from h3data_pipelines.jobs.policy_table import PolicyTable, policy_table
from h3data_pipelines.jobs.result_files import check_options, results_of, write_table

RECORDINGS = "recordings"
"""Name of the folder of recordings in the folder of an evaluation."""


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """Request for an evaluation, with its policies, partners and episodes."""

    task: str
    policies: tuple[str, ...] = (ALL,)
    """Policies of robots, or ``all``. ``weights:PATTERN`` stands for all files that match, which share one row."""
    partners: tuple[str, ...] = (ALL,)
    """Policies of people, or ``all``."""
    unseen_partners: tuple[str, ...] = ()
    """Partners over which the zero-shot mean is taken (default: the paper's four planners, if all play)."""
    scenes: tuple[str, ...] = ("h3-homes/test",)
    episodes_file: Path | None = None
    """Episodes to play instead of those of ``scenes``."""
    assets: tuple[Path, ...] = ()
    """Asset folders for scenes and objects of an episode file."""
    allow_missing: bool = False
    """True if scenes of an episode file may lack objects."""
    episodes: int | None = None
    homes: int = 4
    seed: int = 0
    robot: str | None = None
    human: str | None = None
    motion: str | None = None
    rules: str | None = None
    """Name of a set of rules."""
    human_speed: float | None = None
    max_steps: int | None = None
    skills: str = ""
    """Learned skills of robots in rearrangement (`sim_kinematic.policies.skills.names.recorded_skills`), or ``oracle``;
    empty for skills that know the whole state."""
    overrides: tuple[tuple[str, Any], ...] = ()
    """Single fields of the task's rules, by name."""
    light: LightMode | None = None
    """Light in the colours that policies observe; None for the light in which each policy was trained."""
    uids: tuple[str, ...] = ()
    """Identity that each episode must have (`h3data_pipelines.jobs.evaluations.episode_uid`), in order; empty if any is
    allowed.
    """

    def jobs(self) -> list[Evaluation]:
        """Return the jobs of all episodes, or raise an `InputError` that names an invalid option."""
        return self.evaluations()[0]

    def evaluations(self) -> tuple[list[Evaluation], FileJobs]:
        """Return all evaluations and the missing data, or raise an `InputError` for an invalid option."""
        from sim_kinematic.policies.assignment import policy_names, resolve_policy
        from sim_kinematic.policies.learned import in_light
        from sim_kinematic.tasks.registry import find_task

        check_numbers(
            episodes=self.episodes,
            homes=self.homes,
            max_steps=self.max_steps,
            seed=self.seed,
            human_speed=self.human_speed,
        )
        task = find_task(self.task)
        named = chosen_names(self.policies, policy_names(task, "robot"))
        policies = tuple(dict.fromkeys(in_light(name, self.light) for name in named))
        crosses = "human" in task.defaults and task.usage.crosses_partners
        partners: tuple[str, ...] = ()
        if crosses or self.partners != (ALL,):
            partners = chosen_names(self.partners, policy_names(task, "human"))
        if strangers := [name for name in self.population if name not in partners]:
            raise InputError(
                f"--unseen-partners: expected partners that are evaluated ({', '.join(partners) or 'none'}), got "
                f"{', '.join(strangers)}.",
                code="H3-JOB-049",
            )
        choices = Choices(
            task=self.task,
            policy=policies[0],
            partner=partners[0] if partners else None,
            robot=self.robot,
            human=self.human,
            motion=self.motion,
            rules=self.rules,
            human_speed=self.human_speed,
            max_steps=self.max_steps,
            overrides=self.overrides,
        )
        choices = with_skills(choices, self.skills)
        for kind, names in (("robot", policies), ("human", partners)):
            for name in names:
                resolve_policy(task, kind, name, choices.spec())
        base = requested_jobs(self, choices, default_scenes=EvaluationRequest.scenes)
        uids = self.uids or (None,) * len(base.jobs)
        return [Evaluation(job, policies, partners, uid=uid) for job, uid in zip(base.jobs, uids, strict=True)], base

    @property
    def seeds(self) -> dict[str, tuple[str, ...]]:
        """Policies that share one row of the table, by their recorded names, for each pattern."""
        from sim_kinematic.policies.learned import in_light, stamped

        found = {name: files_of(name) for name in self.policies}
        return {
            pattern: tuple(dict.fromkeys(in_light(stamped(file), self.light) for file in files))
            for pattern, files in found.items()
            if len(files) > 1
        }

    @property
    def population(self) -> tuple[str, ...]:
        """Names in ``unseen_partners``, in which the digest of their weights names learned policies."""
        from sim_kinematic.policies.learned import stamped

        return tuple(dict.fromkeys(map(stamped, self.unseen_partners)))


@dataclass(frozen=True, kw_only=True, eq=False)
class EvaluationResult:
    """Result of an evaluation."""

    folder: Path
    table: PolicyTable | CrossPlayTable
    rows: tuple[dict[str, Any], ...]
    """Rows of the result: one for each policy, partner and episode, with the metrics in ``values``."""
    episodes: int
    new: int
    """Number of episodes that were played now; the other results existed already."""
    failed: tuple[str, ...]
    """Episodes that raised an error, with episode number, seed, names and error."""
    left_out: tuple[str, ...] = ()
    """Episodes of the file that cannot be played, with the reason."""
    warnings: tuple[str, ...] = ()
    """Warnings about stand-ins for missing assets."""
    job: dict[str, Any]
    """Job that was requested."""
    created_by: tuple[str, ...]

    def to_text(self) -> str:
        """Return the tables and a list of failures as text."""
        return self.table.to_text() + "".join(f"\nfailed {line}" for line in self.failed) + notes_on(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON types."""
        return {
            "episodes": self.episodes,
            "new": self.new,
            "failed": list(self.failed),
            **({"left_out": list(self.left_out)} if self.left_out else {}),
            **({"warnings": list(self.warnings)} if self.warnings else {}),
            **self.table.to_dict(),
            "job": self.job,
            "created_by": list(self.created_by),
        }


def evaluate_task(
    request: EvaluationRequest,
    out: Path,
    *,
    save_recordings: bool = False,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    executor: str = "local",
    progress: Callable[..., Any] | None = None,
) -> EvaluationResult:
    """Play every policy with every partner in the same episodes, and write results, tables and recordings to ``out``.

    Episodes that already have results in ``out`` are not played again.

    Args:
        request: Policies and episodes to evaluate.
        out: A new folder, or the folder of an interrupted evaluation with the same options.
        save_recordings: True saves recordings, as datasets in ``out/recordings``.
        resume: True requires ``out`` to hold an evaluation, which is continued.
        force: True deletes results in ``out`` first.
        workers: Number of processes.
        executor: Executor that starts the processes: ``local``, ``ray`` or ``ray://host:port``.
        progress: Function that creates a progress bar, called with ``total``, ``initial``, ``desc`` and ``unit``.

    Raises:
        InputError: an option is invalid, or the folder contains results of other options or other files.
        FormatError: a file among the results is not a result.
    """
    check_options(resume=resume, force=force, workers=workers, executor=executor)
    jobs, asked = request.evaluations()
    recordings = out / RECORDINGS
    if save_recordings:
        jobs = [replace(job, keep=True) for job in jobs]
    kept = {job.base.index: recordings / f"{job.base.index:06d}" for job in jobs}
    made_by, origins = f"h3data {own_version()}", {job.base.index: job.base.origin for job in jobs}

    def prepare() -> None:
        if force:
            shutil.rmtree(recordings, ignore_errors=True)
        if save_recordings:
            recordings.mkdir(exist_ok=True)

    def store(played: tuple[dict[str, Any], list[Recording]]) -> dict[str, Any]:
        found, of_pairs = played
        index = found["job"]["episode"]["index"]
        if save_recordings:
            write_recordings(of_pairs, kept[index])
        return {**found, "created_by": made_by, "origin": origins[index]}

    played, new = results_of(
        jobs,
        out,
        play_evaluation,
        lost=lambda job, fault: (failed_evaluation(job, fault), []),
        store=store,
        prepare=prepare,
        is_whole=lambda job: not save_recordings or kept[job.base.index].is_dir(),
        resume=resume,
        force=force,
        workers=workers,
        executor=executor,
        progress=progress,
    )
    rows = [row for result in played for row in result["rows"]]
    result = EvaluationResult(
        folder=out,
        table=_table(jobs[0], rows, request.population, request.seeds),
        rows=tuple(rows),
        episodes=len(jobs),
        new=new,
        failed=tuple(
            f"episode {r['job']['episode']['index']} (seed {r['job']['episode']['seed']}), {f}"
            for r in played
            for f in r["failed"]
        ),
        left_out=asked.left_out,
        warnings=asked.warnings,
        job=_asked(request, jobs[0]),
        created_by=tuple(sorted({r.get("created_by", "unknown") for r in played})),
    )
    write_table(out, result.to_text(), result.to_dict())
    return result


def _asked(request: EvaluationRequest, job: Evaluation) -> dict[str, Any]:
    """Return everything that decides the table: task, rules, policies, and the digest of the set of scenes."""
    asked = job.to_json()
    own = {"index", "seed", "scene", "source", "human", "drawn_with"}
    rules = {name: value for name, value in asked.pop("episode").items() if name not in own}
    origin = job.base.origin or {}
    of_set = {name: origin.get(name) for name in ("set", "split", "sha256")}
    file = {"episodes_file": {name: origin[name] for name in ("file", "sha256")}} if "file" in origin else {}
    return {
        "task": request.task,
        **asked,
        **rules,
        "scenes": ",".join(request.scenes),
        "set": of_set if of_set["set"] else None,
        "seed": request.seed,
        "human": request.human,
        **file,
        **({"zsc": list(request.population)} if request.unseen_partners else {}),
    }


def _table(
    job: Evaluation, rows: list[dict[str, Any]], zsc: Sequence[str], seeds: dict[str, tuple[str, ...]]
) -> PolicyTable | CrossPlayTable:
    from h3data.metrics.registry import profile_for

    task = job.base.found_task
    if task.usage.crosses_partners:
        return cross_play_table((Row(**row) for row in rows), zsc, seeds)
    if job.partners:
        rows = [{**row, "policy": f"{row['policy']} with {row['partner']}"} for row in rows]
        seeds = {
            f"{pattern} with {partner}": tuple(f"{policy} with {partner}" for policy in policies)
            for pattern, policies in seeds.items()
            for partner in job.partners
        }
    if len({row.get("card") for row in rows}) > 1:  # one row for each card, below those of all
        by_card = sorted(rows, key=lambda row: row["card"])
        rows = rows + [{**row, "policy": f"{row['card']}: {row['policy']}"} for row in by_card]
    return policy_table(profile_for(task.name, {}, task.profile or None), rows, seeds)
