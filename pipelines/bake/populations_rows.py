"""The table "ours | paper" of rearrangement beside populations, from the folders of populations_table.sh.

``python -m bake.populations_rows OUT`` prints it as Markdown. Each row is a robot, each value the mean over its training seeds,
episodes and partners with a 95% interval. Seeds and episodes are resampled independently (a crossed bootstrap), an episode
with all its partners, since robots of all seeds play the same episodes and plays of one episode are not independent.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.metrics import Metric
from h3data.metrics.paper.published import published_results
from h3data.metrics.report_layout import PublishedRow
from h3data.stats.intervals import wilson_interval
from h3data_pipelines.jobs.cross_play import METRICS
from sim_kinematic.policies.rearrange import POPULATIONS

RESAMPLES = 10_000
WALKS = {
    "oracle": "Oracle skills, people as the paper's (2.5 m/s, E = 750)",
    "paper": "People as the paper's (2.5 m/s, E = 750)",
    "natural": "Natural people (1.3 m/s, E = 1,500)",
}
ROBOTS = {
    "untrained": "untrained",
    "learn_single": "Learn-Single",
    **{f"plan_pop_{k}": f"Plan-Pop {k}" for k in range(1, 5)},
    "learn_pop": "Learn-Pop",
    "plan_pop_3_learned_skills": "Plan-Pop 3, learned skills",
    "plan_pop_3_no_gps": "Plan-Pop 3, no humanoid GPS",
    "plan_pop_3_no_primitives": "Plan-Pop 3, no primitives",
}
"""Titles by run, in the order of the rows; other runs come last under their own names."""
SHOWN = (("train", "SR"), ("train", "RE"), ("zsc", "SR"), ("zsc", "RE"), ("zsc", "CR"), ("zsc", "RC"))
"""Columns of the table as partners and metric."""
TITLES = {"train": "train-pop", "zsc": "ZSC"}


@dataclass(frozen=True, kw_only=True)
class SeedResults:
    """Results of the robot of one training seed."""

    run: str
    seed: int
    zsc: frozenset[str]
    """Partners of the zero-shot population."""
    plays: tuple[dict[str, Any], ...]
    """Rows of ``h3data evaluate``."""
    missing: int
    """Number of plays that failed with an error."""


def read_results(folder: Path) -> SeedResults:
    """Return the results in a folder ``RUN.SEED`` of a finished evaluation.

    Raises:
        FormatError: the folder has no table of ``h3data evaluate``, or the table is of another task.
    """
    run, _, seed = folder.name.rpartition(".")
    try:
        table = json.loads((folder / "table.json").read_text(encoding="utf-8"))
        found = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("episodes/[0-9]*.json"))]
        return SeedResults(
            run=run,
            seed=int(seed),
            zsc=frozenset(table["job"]["zsc"]),
            plays=tuple(row for episode in found[: table["episodes"]] for row in episode["rows"]),
            missing=len(table["failed"]),
        )
    except (KeyError, TypeError, ValueError) as fault:
        raise FormatError(
            f"Expected an evaluation of rearrange with --unseen-partners ({fault!r}). Folder: {folder}"
        ) from None


def learned_beside(run: str, seed: int) -> Callable[[str], bool]:
    """Return whether a partner, by its name in the evaluation, is of the population that a robot was trained with."""
    population = run.partition("_no_")[0].removesuffix("_learned_skills")
    if population in POPULATIONS:
        return lambda partner: partner in POPULATIONS[population]
    own, shipped = f"/{population}.{seed}/partner_", f"{population}_partner_{seed}"
    return lambda partner: own in partner or (population == "learn_single" and partner == shipped)


def values_of(results: Sequence[SeedResults], metric: Metric, partners: str) -> NDArray[np.float64]:
    """Return means over partners of a metric by seed and episode, [S, E]; NaN where it is undefined.

    Args:
        results: Results of one run, by seed.
        metric: Name of the metric.
        partners: ``train`` or ``zsc``.
    """
    episodes = sorted({play["index"] for one in results for play in one.plays})
    found = np.full((len(results), len(episodes)), np.nan)
    for s, one in enumerate(results):
        counts = one.zsc.__contains__ if partners == "zsc" else learned_beside(one.run, one.seed)
        by_episode: dict[int, list[float]] = {}
        for play in one.plays:
            value = play["values"].get(metric.name)
            if counts(play["partner"]) and value is not None:
                by_episode.setdefault(play["index"], []).append(value)
        for e, index in enumerate(episodes):
            if index in by_episode:
                found[s, e] = np.mean(by_episode[index])
    return found


def crossed_interval(values: NDArray[np.float64], *, binary: bool) -> tuple[float, float, float]:
    """Return mean of ``values`` [S, E] and its 95% interval over seeds and episodes.

    Where all values of a metric of 0 and 1 are the same, a bootstrap has no width: there it is Wilson's interval of as
    many trials as there are episodes.
    """
    defined = ~np.isnan(values)
    if not defined.any():
        return float("nan"), float("nan"), float("nan")
    mean = float(values[defined].mean())
    if binary and mean in (0.0, 1.0):
        trials = int(defined.any(0).sum())
        return mean, *wilson_interval(round(mean * trials), trials)
    rng, filled = np.random.default_rng(0), np.where(defined, values, 0.0)
    seeds, episodes = (
        rng.multinomial(n, np.full(n, 1 / n), size=RESAMPLES).astype(float) for n in values.shape
    )  # how often each is in a resample
    sums, counts = (np.einsum("rs,se,re->r", seeds, part, episodes, optimize=True) for part in (filled, defined * 1.0))
    low, high = np.quantile(sums[counts > 0] / counts[counts > 0], (0.025, 0.975))
    return mean, float(low), float(high)


def markdown(out: Path) -> str:
    """Return tables of all folders ``WALK/RUN.SEED`` in a folder; unfinished evaluations are only named.

    Raises:
        InputError: no evaluation in the folder is finished.
    """
    blocks, unfinished = [], []
    for walk, title in WALKS.items():
        runs: dict[str, list[SeedResults]] = {}
        for folder in sorted(out.glob(f"{walk}/*.[0-9]*/")):
            if (folder / "table.json").exists():
                runs.setdefault(folder.name.rpartition(".")[0], []).append(read_results(folder))
            else:
                unfinished.append(f"{walk}/{folder.name}")
        if runs:
            blocks.append(_table(title, runs))
    if not blocks:
        raise InputError(f"Expected folders of populations_table.sh (paper/RUN.SEED/table.json). Folder: {out}")
    return "\n\n".join([*blocks, *([f"Unfinished: {', '.join(unfinished)}."] if unfinished else [])])


def _table(title: str, runs: dict[str, list[SeedResults]]) -> str:
    missing = sum(one.missing for results in runs.values() for one in results)
    head = ["robot", "seeds", "episodes", *(f"{name} {TITLES[of]}" for of, name in SHOWN)]
    head += [f"paper: SR / RE {title}" for title in TITLES.values()]
    lines = [f"{title}, SR and RE in %:", "", _row(head), _row(["---"] * len(head))]
    order = {run: k for k, run in enumerate(ROBOTS)}
    for run in sorted(runs, key=lambda run: (order.get(run, len(order)), run)):
        results = runs[run]
        cells = [_cell(results, name, of) for of, name in SHOWN]
        episodes = len({play["index"] for one in results for play in one.plays})
        published = published_results().rearrange.row_of(run)
        about = [ROBOTS.get(run, run), str(len(results)), str(episodes)]
        lines.append(_row([*about, *cells, *(_published(published, of) for of in TITLES)]))
    return "\n".join([*lines, *(["", f"{missing} plays raised and are left out."] if missing else [])])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(results: Sequence[SeedResults], name: str, partners: str) -> str:
    metric = next(m for m in METRICS if m.name == name)
    mean, low, high = crossed_interval(values_of(results, metric, partners), binary=metric.binary)
    if np.isnan(mean):
        return "-"
    factor, digits = {"SR": (100, 0), "RE": (1, 0)}.get(name, (1, 2))
    return f"{factor * mean:.{digits}f} [{factor * low:.{digits}f}, {factor * high:.{digits}f}]"


def _published(row: PublishedRow | None, population: str) -> str:
    if row is None:
        return ""
    values = row.with_partners(population)
    return f"{values['SR'][0]:.1f} / {values['RE'][0]:.0f}"


if __name__ == "__main__":
    sys.stdout.write(markdown(Path(sys.argv[1])) + "\n")
