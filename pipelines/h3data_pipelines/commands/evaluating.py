"""``h3data evaluate``: every robot, in rearrangement with every partner, over the same episodes, and the paper's numbers
beside."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from h3data.errors import FormatError, InputError, did_you_mean
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_folder, write_text
from h3data_pipelines.jobs.cross_play import CrossPlayTable, Row, cross_play_table
from h3data_pipelines.jobs.episode_jobs import run_jobs
from h3data_pipelines.jobs.failed_episodes import reason_of
from h3data_pipelines.jobs.rearrange_jobs import RearrangeJob, rearrange_jobs, rules
from h3data_pipelines.jobs.social_nav_evaluating import (
    PoliciesJob,
    PolicyTable,
    play_policies,
    policy_table,
    social_nav_jobs,
)

ALL = "all"
TASKS = ("social_nav", "rearrange")


@dataclass(frozen=True)
class Evaluate:
    """Play every robot in the same episodes and print its metrics with 95 % intervals, beside the paper's: S, SPS, F, CR,
    BYR, TD and FD of social_nav; SR, RE, CR and RC with every partner of rearrange. Each episode is a small file in the
    output folder: an interrupted evaluation goes on where it was.

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
        jobs, play, tabulate = self._task()
        folder = self.out / "episodes"
        claim_folder(self.out, force=self.force or folder.is_dir())  # with episodes/ it is an evaluation to go on with
        folder.mkdir(exist_ok=True)
        if self.force:
            for file in folder.glob("[0-9]*.json"):
                file.unlink()
        files = {job.base.index: folder / f"{job.base.index:06d}.json" for job in jobs}
        wanted = [job for job in jobs if not _is_done(files[job.base.index], job)]
        made_by, origins = f"h3data {version('h3data')}", {job.base.index: job.base.origin for job in jobs}
        bar = tqdm(total=len(jobs), initial=len(jobs) - len(wanted), desc="evaluate", unit="episode", disable=None)
        with bar, closing(run_jobs(play, wanted, workers=self.workers)) as results:
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
        table = tabulate(rows)
        text = table.to_text() + "".join(f"\nfailed {line}" for line in failed)
        data = {
            "episodes": len(jobs), "new": len(wanted), "failed": failed, **table.to_dict(), "job": self._asked(jobs[0]),
            "created_by": sorted({r.get("created_by", "unknown") for r in results}),
        }  # fmt: skip
        write_text(self.out / "table.txt", text + "\n")
        write_text(self.out / "table.json", json.dumps(data, indent=2) + "\n")
        return Outcome(text=text, data=data, exit_code=1 if failed else 0)

    def _asked(self, job: PoliciesJob | CrossPlayJob) -> dict[str, Any]:
        """What the table is of: the task, the rules, who plays, and the digest of the set of scenes."""
        asked = job.to_json()
        own = {"index", "seed", "scene", "source", "human", "drawn_with"}
        rules = {name: value for name, value in asked.pop("episode").items() if name not in own}
        of_set = {name: (job.base.origin or {}).get(name) for name in ("set", "split", "sha256")}
        return {
            "task": self.task, **asked, **rules, "scenes": self.scenes, "set": of_set if of_set["set"] else None,
            "seed": self.seed, "human": self.human,
        }  # fmt: skip

    def _task(
        self,
    ) -> tuple[Sequence[Any], Callable[[Any], dict[str, Any]], Callable[[list[Any]], PolicyTable | CrossPlayTable]]:
        """Its episodes, what plays one, and what makes a table of the rows of all."""
        if self.task == "social_nav":
            return self.social_nav_jobs(), play_policies, policy_table
        if self.task == "rearrange":
            return self.jobs(), play_pairs, lambda rows: cross_play_table(Row(**row) for row in rows)
        raise InputError(
            f"Unknown task {self.task!r}.{did_you_mean(self.task, TASKS)} Expected social_nav or rearrange."
        )

    def social_nav_jobs(self) -> list[PoliciesJob]:
        """All episodes of social navigation, or an `InputError` that names the bad option."""
        from sim_kinematic.policies.social_nav import POLICIES

        if self.partners != ALL:
            raise InputError("--partners is for rearrange: the person of social_nav walks to her way points.")
        names = tuple(POLICIES) if self.policies == ALL else _listed(self.policies)
        return social_nav_jobs(
            self.scenes, homes=self.homes, episodes=self.episodes, seed=self.seed, policies=names, human=self.human,
            human_speed=self.human_speed, max_steps=self.max_steps,
        )  # fmt: skip

    def jobs(self) -> list[CrossPlayJob]:
        """All episodes of rearrangement, or an `InputError` that names the bad option."""
        from sim_kinematic.policies.rearrange import PARTNERS, ROBOT_POLICIES

        policies = _names("--policies", self.policies, tuple(ROBOT_POLICIES))
        partners = _names("--partners", self.partners, PARTNERS)
        spec = rules(human_speed=self.human_speed, max_steps=self.max_steps)
        base = rearrange_jobs(
            self.scenes, homes=self.homes, episodes=self.episodes, seed=self.seed, policy=policies[0],
            partner=partners[0], human=self.human, spec=spec,
        )  # fmt: skip
        return [CrossPlayJob(job, policies, partners) for job in base]


@dataclass(frozen=True)
class CrossPlayJob:
    """One episode for all pairs."""

    base: RearrangeJob
    policies: tuple[str, ...]
    partners: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """What decides the results."""
        fields = self.base.to_json()
        del fields["policy"], fields["partner"]
        return {"episode": fields, "policies": list(self.policies), "partners": list(self.partners)}


def play_pairs(job: CrossPlayJob) -> dict[str, Any]:
    """The metrics of every pair in one episode. A pair, or an episode, that raises is listed as failed."""
    from h3data.metrics import measure
    from sim_kinematic.policies.rearrange import partner_plan
    from sim_kinematic.tasks.rearrange.simulate import simulate_rearrange, solo_steps_of

    rows: list[Row] = []
    failed: list[str] = []
    try:
        world = job.base.world()
        solo = solo_steps_of(world)
    except Exception as fault:
        return {"job": job.to_json(), "rows": [], "failed": [reason_of(fault)]}
    plans = {partner: partner_plan(partner, world.seed) for partner in job.partners}
    for policy in job.policies:
        played: dict[str, Row] = {}  # partners with one plan do the same
        for partner, plan in plans.items():
            try:
                if plan not in played:
                    recording = simulate_rearrange(world, policy=policy, partner=plan, solo_steps=solo)
                    measured = measure(recording)
                    values = {name: None if value != value else value for name, value in measured.values.items()}
                    played[plan] = Row(
                        index=job.base.index, policy=policy, partner=plan, plan=plan,
                        ended=recording.episode.info["ended"], solo_steps=solo, values=values,
                        state_hash=str(recording.columns["state_hash"][-1]), set_up=measured.set_up,
                    )  # fmt: skip
                rows.append(Row(**{**asdict(played[plan]), "partner": partner}))
            except Exception as fault:
                failed.append(f"{policy} with {partner}: {reason_of(fault)}")
    return {"job": job.to_json(), "rows": [asdict(row) for row in rows], "failed": failed}


def _is_done(file: Path, job: CrossPlayJob | PoliciesJob) -> bool:
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


def _names(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    from sim_kinematic.policies.learned import is_learned, stamped

    names = known if text == ALL else _listed(text)
    strangers = [name for name in names if name not in known and not is_learned(name)]
    if strangers or not names:
        near = did_you_mean(strangers[0], known) if strangers else ""
        raise InputError(
            f"{option}: expected some of {', '.join(known)}, weights:FILE, or all; got {', '.join(strangers) or 'none'}.{near}"
        )
    return tuple(map(stamped, names))


def _listed(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(filter(None, (n.strip() for n in text.split(",")))))
