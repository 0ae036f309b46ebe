"""``h3data evaluate social_nav``: every robot policy in the same episodes, its metrics beside the paper's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from h3data.errors import InputError
from h3data.metrics import metrics_of
from h3data.metrics.table import aligned, set_up_lines
from h3data_pipelines.jobs.cross_play import NOTHING, CellValue, cell_value, or_none
from h3data_pipelines.jobs.episode_jobs import Changes, Job, seeded_jobs, set_jobs
from h3data_pipelines.jobs.failed_episodes import reason_of
from h3data_viewers.html_report.report_paper import paper_results

METRICS = tuple(metric.name for metric in metrics_of("paper", "social_nav"))


@dataclass(frozen=True)
class PoliciesJob:
    """One episode for all policies."""

    base: Job
    policies: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """What decides the results."""
        fields = self.base.to_json()
        del fields["policy"]
        return {"episode": fields, "policies": list(self.policies)}


def social_nav_jobs(
    scenes: str, *, homes: int, episodes: int | None, seed: int, policies: Sequence[str], human: str | None,
    human_speed: float | None, max_steps: int | None,
) -> list[PoliciesJob]:  # fmt: skip
    """The episodes of a set, all by default, or drawn ones (10) in other scenes.

    Raises:
        InputError: a policy or a scene is unknown, or there are fewer episodes.
    """
    from h3data.habitat.scene_names import named_scenes
    from h3data.scene.scene_sets import find_scene_set
    from sim_kinematic.motion.spec import SocialNavSpec
    from sim_kinematic.policies.social_nav import policy_by_name, policy_name

    if not policies:
        raise InputError("--policies: expected at least one name, or all.")
    for name in policies:
        policy_by_name(name)
    policies = tuple(dict.fromkeys(map(policy_name, policies)))
    changes = Changes(policy=policies[0], human=human, human_speed=human_speed, max_steps=max_steps)
    label, _, which = scenes.partition("#")
    found = find_scene_set(label)
    if found is not None:
        chosen = replace(found, scenes=(found.entry(which),)) if which else found
        base = set_jobs(chosen, episodes=episodes, seed=seed, changes=changes)
    else:
        base = seeded_jobs(
            named_scenes(scenes, homes=homes), episodes=10 if episodes is None else episodes, seed=seed,
            spec=SocialNavSpec(), changes=changes,
        )  # fmt: skip
    return [PoliciesJob(job, policies) for job in base]


def play_policies(job: PoliciesJob) -> dict[str, Any]:
    """The metrics of every policy in one episode. What raises is listed as failed."""
    from h3data.metrics import measure
    from sim_kinematic.tasks.social_nav import simulate_social_nav

    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    try:
        world = job.base.world()
    except Exception as fault:
        return {"job": job.to_json(), "rows": [], "failed": [reason_of(fault)]}
    for policy in job.policies:
        try:
            measured = measure(simulate_social_nav(world, policy=policy))
        except Exception as fault:
            failed.append(f"{policy}: {reason_of(fault)}")
        else:
            values = {name: or_none(value) for name, value in measured.values.items()}
            rows.append({"policy": policy, "values": values, "set_up": measured.set_up})
    return {"job": job.to_json(), "rows": rows, "failed": failed}


@dataclass(frozen=True, kw_only=True)
class PolicyTable:
    """Policies by metrics."""

    cells: dict[tuple[str, str], CellValue]
    """By policy and metric."""
    set_ups: tuple[str, ...] = ()
    """Of each result: in what its rules differ from the paper's."""

    def to_text(self) -> str:
        """Our rows with intervals, the paper's below; without ours there is nothing to compare."""
        if not self.cells:
            return NOTHING
        paper = paper_results().social_nav
        policies = tuple(dict.fromkeys(policy for policy, _ in self.cells))
        ours = [[policy, *(self._shown(policy, metric) for metric in METRICS)] for policy in policies]
        published = [[row.name, *(_published(row.values.get(m, ())) for m in METRICS)] for row in paper.rows]
        lines = aligned(
            [["Mean [95 % interval]", *METRICS], *ours, ["Habitat 3.0, as published", *METRICS], *published]
        )
        return "\n".join([lines, f"{paper.source}.", *set_up_lines(self.set_ups)])

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON types; NaN becomes None."""
        return {
            "cells": [
                {
                    "policy": policy, "metric": metric, "mean": or_none(c.mean), "low": or_none(c.low),
                    "high": or_none(c.high), "episodes": c.count,
                }
                for (policy, metric), c in self.cells.items()
            ]
        }  # fmt: skip

    def _shown(self, policy: str, metric: str) -> str:
        cell = self.cells[policy, metric]
        if not cell.count:
            return "-"
        interval = f" [{cell.low:.2f}, {cell.high:.2f}]" if cell.low == cell.low else ""
        return f"{cell.mean:.2f}{interval}"


def policy_table(rows: Iterable[dict[str, Any]]) -> PolicyTable:
    """The table of the rows that `play_policies` makes."""
    rows = list(rows)
    return PolicyTable(
        cells={
            (policy, metric): cell_value(metric, [r["values"].get(metric) for r in rows if r["policy"] == policy])
            for policy in dict.fromkeys(r["policy"] for r in rows)
            for metric in METRICS
        },
        set_ups=tuple(r.get("set_up", "") for r in rows),
    )


def _published(value: tuple[float, ...]) -> str:
    return " ± ".join(f"{v:.2f}" for v in value) or "-"
