"""``h3data evaluate``: every robot, in rearrangement with every partner, over the same episodes, and the paper's numbers
beside."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro

from h3data.errors import FormatError, InputError
from h3data.progress import progress
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_folder, write_text
from h3data_pipelines.jobs.cross_play import CrossPlayTable, Row, cross_play_table
from h3data_pipelines.jobs.episodes import Choices, make_jobs
from h3data_pipelines.jobs.evaluations import ALL, Evaluation, chosen_names, play_evaluation
from h3data_pipelines.jobs.policy_table import PolicyTable, policy_table
from h3data_pipelines.jobs.running import run_jobs


@dataclass(frozen=True)
class Evaluate:
    """Play policies in the same episodes and print their metrics beside the paper's.

    S, SPS, F, CR, BYR, TD and FD of social_nav; SR, RE, CR and RC with every partner of rearrange, with 95% intervals. Each
    episode is a small file in the output folder: an interrupted evaluation goes on where it was.

    Examples:
        h3data evaluate rearrange --scenes h3-homes/test -o out/zsc
        h3data evaluate rearrange --policies complement,still --partners both,object_1 --episodes 20 -o out/pairs
        h3data evaluate social_nav --scenes h3-homes/test --workers 2 -o out/social_nav
        h3data evaluate social_nav --policies heuristic_expert,weights:net.npz --episodes 20 -o out/mine
        h3data evaluate rearrange --scenes medium --homes 2 --episodes 8 --workers 2 -o out/pairs
    """

    task: tyro.conf.Positional[str]
    """social_nav: find a walking person and follow her; rearrange: help her to bring two objects to their goals."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the table (table.txt, table.json) and the results of each episode (episodes/)."""
    policies: str = ALL
    """Robots, separated by commas. social_nav: heuristic_expert, plain_expert, sampling_expert, future_oracle,
    learned_follower, random, stand_still or weights:FILE; rearrange: complement, greedy_nearest, same_object, still; or all."""
    partners: str = ALL
    """rearrange: partners, separated by commas: plan_pop_1 to plan_pop_4, both, object_1, object_2, still; or all."""
    scenes: str = "h3-homes/test"
    """As of h3data generate."""
    episodes: int | None = None
    """How many (default: all of a set, else 10)."""
    homes: int = 4
    """Number of different homes of a preset that the episodes go round."""
    seed: int = 0
    """Everything random follows from it."""
    human: str | None = None
    """Built-in body of the person, or any: each episode draws one (default: female_0)."""
    human_speed: float | None = None
    """Walking speed of the person [m/s] (default: the paper's 2.5)."""
    max_steps: int | None = None
    """Length limit of an episode (default: 1500; rearrange: 750)."""
    workers: int = 1
    """Processes."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        for name, value in (("--episodes", self.episodes), ("--homes", self.homes), ("--workers", self.workers)):
            if value is not None and value < 1:
                raise InputError(f"{name} must be at least 1, got {value}.")
        jobs = self.jobs()
        folder = self.out / "episodes"
        claim_folder(self.out, force=self.force or folder.is_dir())  # with episodes/ it is an evaluation to go on with
        folder.mkdir(exist_ok=True)
        if self.force:
            for file in folder.glob("[0-9]*.json"):
                file.unlink()
        files = {job.base.index: folder / f"{job.base.index:06d}.json" for job in jobs}
        wanted = [job for job in jobs if not _is_done(files[job.base.index], job)]
        made_by, origins = f"h3data {version('h3data')}", {job.base.index: job.base.origin for job in jobs}
        bar = progress(total=len(jobs), initial=len(jobs) - len(wanted), desc="evaluate", unit="episode")
        with bar, closing(run_jobs(play_evaluation, wanted, workers=self.workers)) as results:
            for result in results:
                index = result["job"]["episode"]["index"]
                write_text(files[index], json.dumps({**result, "created_by": made_by, "origin": origins[index]}) + "\n")
                bar.update()
        results = [json.loads(files[job.base.index].read_text(encoding="utf-8")) for job in jobs]
        rows = [row for result in results for row in result["rows"]]
        failed = [
            f"episode {r['job']['episode']['index']} (seed {r['job']['episode']['seed']}), {f}"
            for r in results
            for f in r["failed"]
        ]
        table = self._table(jobs[0], rows)
        text = table.to_text() + "".join(f"\nfailed {line}" for line in failed)
        data = {
            "episodes": len(jobs), "new": len(wanted), "failed": failed, **table.to_dict(), "job": self._asked(jobs[0]),
            "created_by": sorted({r.get("created_by", "unknown") for r in results}),
        }  # fmt: skip
        write_text(self.out / "table.txt", text + "\n")
        write_text(self.out / "table.json", json.dumps(data, indent=2) + "\n")
        return Outcome(text=text, data=data, exit_code=1 if failed else 0)

    def _asked(self, job: Evaluation) -> dict[str, Any]:
        """What the table is of: the task, the rules, who plays, and the digest of the set of scenes."""
        asked = job.to_json()
        own = {"index", "seed", "scene", "source", "human", "drawn_with"}
        rules = {name: value for name, value in asked.pop("episode").items() if name not in own}
        of_set = {name: (job.base.origin or {}).get(name) for name in ("set", "split", "sha256")}
        return {
            "task": self.task,
            **asked,
            **rules,
            "scenes": self.scenes,
            "set": of_set if of_set["set"] else None,
            "seed": self.seed,
            "human": self.human,
        }

    def jobs(self) -> list[Evaluation]:
        """All episodes, or an `InputError` that names the bad option."""
        from sim_kinematic.policies.assignment import policy_names
        from sim_kinematic.tasks.registry import find_task

        task = find_task(self.task)
        policies = chosen_names("--policies", self.policies, policy_names(task, "robot"))
        crosses = "human" in task.defaults and task.crosses_partners
        partners: tuple[str, ...] = ()
        if crosses or self.partners != ALL:
            partners = chosen_names("--partners", self.partners, policy_names(task, "human"))
        choices = Choices(
            task=self.task,
            policy=policies[0],
            partner=partners[0] if partners else None,
            human=self.human,
            human_speed=self.human_speed,
            max_steps=self.max_steps,
        )
        for kind, names in (("robot", policies), ("human", partners)):
            for name in names:
                task.check_policy(kind, name, choices.spec())
        base = make_jobs(choices, self.scenes, homes=self.homes, episodes=self.episodes, seed=self.seed)
        return [Evaluation(job, policies, partners) for job in base]

    def _table(self, job: Evaluation, rows: list[dict[str, Any]]) -> PolicyTable | CrossPlayTable:
        from h3data.metrics.registry import profile_for

        task = job.base.found_task
        if task.crosses_partners:
            return cross_play_table(Row(**row) for row in rows)
        if job.partners:
            rows = [{**row, "policy": f"{row['policy']} with {row['partner']}"} for row in rows]
        return policy_table(profile_for(task.name, {"profile": task.profile}), rows)


def _is_done(file: Path, job: Evaluation) -> bool:
    """Whether the results of this very job are there, none of them failed; others' are refused."""
    if not file.is_file():
        return False
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        was, failed = found["job"], found["failed"]
    except (ValueError, KeyError, TypeError):
        raise FormatError(f"This is no result of h3data evaluate. Remove it, or choose another -o: {file}") from None
    if was != job.to_json():
        raise InputError(
            f"The folder holds results with other options. Use the same ones, --force, or another -o: {file}"
        )
    return not failed
