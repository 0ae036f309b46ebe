"""Evaluation of learned skills one by one, in the same episodes of rearrangement with the robot alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import InputError
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from h3data_pipelines.jobs.failed_episodes import reason_of
from h3data_pipelines.jobs.result_files import check_options, results_of, write_table

ORDER = ("nav", "pick", "place")


@dataclass(frozen=True)
class SkillJob:
    """Episode in which every skill is tried once."""

    base: Job
    """Job whose rules name the skills."""
    seed: int

    def to_json(self) -> dict[str, Any]:
        """Return all values that determine the results, as JSON types."""
        fields = self.base.to_json()
        for name in ("policy", "partner"):
            fields.pop(name, None)
        return {"episode": fields, "seed": self.seed}


@dataclass(frozen=True, kw_only=True)
class SkillEvaluationResult:
    """Outcomes of all episodes."""

    skills: str
    rows: tuple[dict[str, Any], ...]
    """Rows of the result: one for each skill in each episode."""
    failed: tuple[str, ...]
    """Episodes that raised an error, with the reason."""
    new: int

    def summary(self) -> list[dict[str, Any]]:
        """Return for each skill the success rate with its interval, the steps, and the reasons of failures."""
        from h3data.stats import wilson_interval

        found = []
        for skill in ORDER:
            rows = [row for row in self.rows if row["skill"] == skill]
            if not rows:
                continue
            done = [row for row in rows if row["outcome"] == "done"]
            least, most = wilson_interval(len(done), len(rows))
            reasons = Counter(row["reason"] for row in rows if row["outcome"] != "done")
            found.append(
                {
                    "skill": skill,
                    "episodes": len(rows),
                    "success": len(done) / len(rows),
                    "interval": [least, most],
                    "steps": float(np.mean([row["steps"] for row in done])) if done else None,
                    "path_m": float(np.mean([row["path_m"] for row in rows])),
                    "contact": sum(row["contact"] for row in rows) / max(sum(row["steps"] for row in rows), 1),
                    "failures": dict(reasons.most_common()),
                }
            )
        return found

    def to_text(self) -> str:
        """Return the table, and a list of failures."""
        lines = [f"{'skill':6} {'episodes':>8}  {'success':20} {'steps':>6} {'path m':>7} {'contact':>8}  failures"]
        for row in self.summary():
            least, most = row["interval"]
            success = f"{row['success']:.2f} [{least:.2f}, {most:.2f}]"
            steps = "-" if row["steps"] is None else f"{row['steps']:.0f}"
            failures = ", ".join(f"{reason} {count}" for reason, count in row["failures"].items()) or "none"
            lines.append(
                f"{row['skill']:6} {row['episodes']:>8}  {success:20} {steps:>6} {row['path_m']:>7.1f} {row['contact']:>8.1%}  "
                f"{failures}"
            )
        return "\n".join([*lines, *(f"failed {line}" for line in self.failed)])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON types."""
        return {"skills": self.skills, "table": self.summary(), "failed": list(self.failed), "new": self.new}


def judge_episode(job: SkillJob) -> dict[str, Any]:
    """Return the outcome of every learned skill in one episode; an episode that raises an error is listed as failed."""
    from h3data_pipelines.skill_judging import action_of, judge
    from sim_kinematic.motion.randomness import generator
    from sim_kinematic.policies.skills.names import skills_of
    from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
    from sim_kinematic.tasks.skills.skill_starts import SKILL_NAMES, draw_starts

    rows = []
    try:
        episode = job.base.episode()
        assert isinstance(episode, RearrangeEpisode)
        learned = skills_of(job.base.spec.skills, robot=episode.roster[0].model)
        for skill in SKILL_NAMES:
            rng = generator(job.seed, f"skill_start/{skill}", step=job.base.index)
            for start in draw_starts(episode, skill, 1, rng):
                if action_of(start).skill in learned:
                    result = judge(episode, start, learned)
                    rows.append({"skill": skill, "index": job.base.index, "scene": job.base.scene, **result._asdict()})
    except Exception as fault:
        return lost_episode(job, fault)
    return {"job": job.to_json(), "rows": rows, "failed": ""}


def lost_episode(job: SkillJob, fault: Exception) -> dict[str, Any]:
    """Return the result of an episode that could not be played."""
    return {"job": job.to_json(), "rows": [], "failed": reason_of(fault)}


def evaluate_skills(
    request: EvaluationRequest,
    out: Path,
    *,
    resume: bool = False,
    force: bool = False,
    workers: int = 1,
    executor: str = "local",
    progress: Callable[..., Any] | None = None,
) -> SkillEvaluationResult:
    """Evaluate every learned skill in the same episodes, and write results and a table to ``out``.

    Episodes that have results already are not played again.

    Args:
        request: rearrangement episodes and skills to evaluate.
        out: a new folder, or the folder of an interrupted evaluation with the same options.
        resume: whether ``out`` must hold an evaluation to continue.
        force: whether results in ``out`` are deleted first.
        workers: number of processes.
        executor: executor that starts the processes, as in `h3data_pipelines.jobs.evaluation_runs.evaluate_task`.
        progress: function that creates a progress bar.

    Raises:
        InputError: an option is invalid, or the folder holds other files.
        FormatError: a file among the results cannot be read.
    """
    check_options(resume=resume, force=force, workers=workers, executor=executor)
    jobs = [SkillJob(evaluation.base, request.seed) for evaluation in request.jobs()]
    if not (skills := jobs[0].base.spec.skills):
        raise InputError(
            "Expected --skills: learned, a folder of training runs, or policy files of skills.", code="H3-JOB-047"
        )
    played, new = results_of(
        jobs,
        out,
        judge_episode,
        lost=lost_episode,
        store=lambda result: result,
        resume=resume,
        force=force,
        workers=workers,
        executor=executor,
        progress=progress,
    )
    result = SkillEvaluationResult(
        skills=skills,
        rows=tuple(row for one in played for row in one["rows"]),
        failed=_faults(jobs, played),
        new=new,
    )
    write_table(out, result.to_text(), result.to_dict())
    return result


def _faults(jobs: Sequence[SkillJob], played: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    return tuple(
        f"episode {job.base.index} (seed {job.base.seed}): {one['failed']}"
        for job, one in zip(jobs, played, strict=True)
        if one["failed"]
    )
