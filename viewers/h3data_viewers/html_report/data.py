"""Data of a report: every episode is read once, measured, stored in a few kilobytes, and grouped into runs.

Episodes are grouped by entries of `Episode.info`: ``policy``, ``partner`` (or the human's body), ``population``
(``train-pop`` or ``zsc-pop``), ``participant`` and ``condition``. Episodes of all participants in one condition are one
run. Other episodes without a policy are grouped by condition.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, did_you_mean
from h3data.metrics import MetricsTable, Profile, tabulate
from h3data.metrics.batch import Part, Spread, parts_of
from h3data.metrics.episode import for_each_partner, shared_by
from h3data.metrics.paper.profiles import PROFILES, REARRANGEMENT_PROFILE
from h3data.metrics.registry import profile_for
from h3data.progress import progress
from h3data.recording import Recording, open_recording
from h3data.recording.finding import find_sources
from h3data.stats import over_seeds
from h3data_viewers.html_report.episode import ReportEpisode
from h3data_viewers.html_report.evaluations import (
    evaluated_seeds,
    evaluated_zsc,
    holds_results,
    population_beside,
    result_episodes,
    zero_shot_population,
)
from h3data_viewers.html_report.reading import Found, Unread, read_part
from h3data_viewers.html_report.tables import counted

CURVES_FILE = "learning.csv"
"""Name of the file in a dataset's folder with the training curves of its policy: one row per logged update, with a
column ``step``."""
RUN_CURVES_FILE = "curve.parquet"
"""Name of the file with the training curves in the folder of a run of ``h3data train``; it has a column ``decisions``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Episodes of one policy, from one dataset, or from several datasets that hold different episodes."""

    name: str
    policy: str
    task: str
    """Name of the task in the profile: ``social_nav``, ``rearrange``, or a task of another package."""
    profile: Profile
    """Profile that measures the task and defines its layout."""
    episodes: tuple[ReportEpisode, ...]
    table: MetricsTable
    seeds: tuple[str, ...] = ()
    """Policies of the run if they differ only by their training seed; empty for a run of one policy."""

    def means(self, chosen: Sequence[ReportEpisode] | None = None) -> dict[str, Mean]:
        """Return the mean of each metric over ``chosen`` episodes of the run (default: all), by name.

        For a run with several training seeds, each value is the mean of the seeds' means. Without episodes the result
        is empty.
        """
        episodes = self.episodes if chosen is None else tuple(chosen)
        if not episodes:
            return {}
        if not self.seeds:
            table = self.table if chosen is None else tabulate((e.metrics for e in episodes), profile=self.profile.name)
            return {
                name: Mean(mean=s.mean, low=s.low, high=s.high, count=s.count) for name, s in table.summary().items()
            }
        found: dict[str, Mean] = {}
        for name in (metric.name for metric in self.table.metrics):
            values = [[e.metrics.values[name] for e in episodes if e.policy == policy] for policy in self.seeds]
            # the mean of a seed counts once, however many of its episodes define the metric
            known = [kept for each in values if (kept := [v for v in each if not np.isnan(v)])]
            over = over_seeds([float(np.mean(each)) for each in known])
            found[name] = Mean(
                mean=over.mean,
                low=over.mean - over.std,
                high=over.mean + over.std,
                deviation=over.std,
                seeds=over.seeds,
                count=sum(map(len, known)),
            )
        return found

    @property
    def size(self) -> str:
        """Number of episodes in words, such as ``60 episodes``, or ``60 episodes of 3 seeds``."""
        episodes = counted(len(self.episodes), "episode")
        return f"{episodes} of {len(self.seeds)} seeds" if self.seeds else episodes


@dataclass(frozen=True, kw_only=True)
class Mean:
    """Mean of a metric over episodes with its 95% interval, or over the means of training seeds with their spread."""

    mean: float
    low: float
    """Lower end of the interval: one standard deviation below the mean for training seeds, else the 95% bound."""
    high: float
    count: int
    """Number of episodes that define the metric."""
    deviation: float = np.nan
    """Standard deviation of the metric over training seeds (n - 1 in the denominator)."""
    seeds: int = 0
    """Number of training seeds that have a mean; 0 for the mean over the episodes of one policy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportData:
    """Data of a report without its pictures: runs, curves and unmeasured recordings."""

    paths: tuple[Path, ...]
    runs: tuple[Run, ...]
    unmeasured: Mapping[str, tuple[str, ...]]
    """Names of the recordings that could not be measured, by reason."""
    curves: Mapping[str, Mapping[str, NDArray[np.float64]]]
    """Learning curves by dataset name: columns of shape [N], one of which is ``step``."""

    @property
    def episodes(self) -> Iterator[ReportEpisode]:
        """Yield the episodes of all runs."""
        return (episode for run in self.runs for episode in run.episodes)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks of the episodes: the paper's tasks in its order, then others in order of appearance."""
        there, papers = dict.fromkeys(run.task for run in self.runs), [profile.tasks[0] for profile in PROFILES]
        return tuple(sorted(there, key=lambda task: [*papers, task].index(task)))

    def of_task(self, task: str) -> tuple[Run, ...]:
        """Return the runs of one task."""
        return tuple(run for run in self.runs if run.task == task)


def gather(
    paths: Iterable[str | os.PathLike[str]],
    *,
    unseen_partners: Sequence[str] = (),
    seeds: Sequence[str] = (),
    spread: Spread[Found] = map,
) -> ReportData:
    """Read every recording of datasets, logs and folders of these, and measure each by the profile of its task.

    For a folder of ``h3data evaluate`` without recordings, its stored results are used. ``unseen_partners`` names the
    partners of the zero-shot population (default: the option of the evaluation, else the paper's population if all of
    its partners played, else the entries of the recordings). Policies that fit a pattern of ``seeds``, such as
    ``weights:out/s*/policy.npz`` (default: the option of the evaluation), form one run of several training seeds.
    ``spread`` may distribute the reading over processes or machines.

    Raises:
        InputError: there is no recording, or a path is given twice; a partner in ``unseen_partners`` does not occur;
            episodes cannot share a table (`tabulate`); fewer than two policies fit a pattern of seeds.
        FormatError: a file is damaged.
    """
    roots = tuple(map(Path, paths))
    if not roots:
        raise InputError("Expected at least one dataset or recording.", code="H3-RENDER-079")
    twice = [p for k, p in enumerate(roots) if p.resolve() in {q.resolve() for q in roots[:k]}]
    if twice:
        raise InputError(f"Named twice, so its episodes would count twice: {twice[0]}", code="H3-VIEW-004")
    gathered = _Gathered()
    gathered.add(roots, spread)
    curves = {root.name: curve for root in roots if (curve := read_curves(root))}
    if not gathered.count and not curves:
        raise InputError(f"There are no recordings in {', '.join(map(str, roots))}.", code="H3-VIEW-005")
    if named := unseen_partners or evaluated_zsc(roots):
        gathered.name_population(named)
    return ReportData(
        paths=roots,
        runs=_pooled(_runs(gathered.grouped, gathered.profiles, roots), roots, seeds),
        unmeasured={reason: tuple(names) for reason, names in gathered.unmeasured.items()},
        curves=curves,
    )


class _Gathered:
    """Episodes by place of the path, task and policy."""

    def __init__(self) -> None:
        self.grouped: dict[tuple[int, str, str], list[ReportEpisode]] = {}
        self.profiles: dict[tuple[int, str, str], Profile] = {}
        self.evaluated: dict[int, dict[str, None]] = {}
        """Partners that an evaluation played by name, by place."""
        self.unmeasured: dict[str, list[str]] = {}
        self.count = 0

    def add(self, roots: Sequence[Path], spread: Spread[Found]) -> None:
        """Read what lies at the paths, in their order."""
        places: list[int] = []
        parts: list[Part] = []
        for place, root in enumerate(roots):
            # an evaluation that kept no recordings has a row of metrics for each episode
            if holds_results(root):
                for episode, profile in result_episodes(root):
                    self.count += 1
                    self._note_evaluated(place, episode)
                    self._group(place, root, episode, profile)
                continue
            if (root / RUN_CURVES_FILE).is_file():
                continue  # a run of training, which holds no recordings
            of_root = parts_of(list(find_sources([root])))
            parts += of_root
            places += [place] * len(of_root)
        # the bar counts episodes: parts hold one or two thousand
        episodes = sum(1 if part.episodes is None else len(part.episodes) for part in parts)
        bar = progress(total=episodes, desc="read and measure", unit="episode", delay=1.0, leave=False)
        for place, found in zip(places, spread(read_part, parts), strict=True):
            for each in found:
                bar.update(1)
                self.count += 1
                if isinstance(each, Unread):
                    self.unmeasured.setdefault(each.reason, []).append(each.name)
                    continue
                profile = profile_for(each.task, each.info)
                # workers send metrics without their functions, which cannot be pickled; those of the profile have them
                by_id = {metric.id: metric for metric in profile.metrics}
                metrics = replace(
                    each.episode.metrics, metrics=tuple(by_id[metric.id] for metric in each.episode.metrics.metrics)
                )
                for episode in _with_each_partner(replace(each.episode, metrics=metrics), each.info):
                    if shared_by(each.info):
                        self._note_evaluated(place, episode)
                    self._group(place, roots[place], episode, profile)
        bar.close()
        self._drop_parts_of_populations()

    def name_population(self, zsc: Sequence[str]) -> None:
        """Make the episodes with these partners the zero-shot population."""
        partners = sorted({e.partner for episodes in self.grouped.values() for e in episodes if e.partner})
        if strangers := [name for name in zsc if name not in partners]:
            raise InputError(
                f"No episode has the partner {strangers[0]!r}; there are: {', '.join(partners) or 'none'}."
                f"{did_you_mean(strangers[0], partners)}",
                code="H3-VIEW-007",
            )
        for key, episodes in self.grouped.items():
            self.grouped[key] = [
                replace(e, population="zsc" if e.partner in zsc else e.population.replace("zsc", "")) for e in episodes
            ]

    def _note_evaluated(self, place: int, episode: ReportEpisode) -> None:
        self.evaluated.setdefault(place, {})[episode.partner] = None

    def _drop_parts_of_populations(self) -> None:
        """Remove partners from the population ``zsc`` if only a part of it played, as the evaluation's table does."""
        for (place, task, policy), episodes in self.grouped.items():
            parts = self.evaluated.get(place, {})
            zsc = zero_shot_population(tuple(parts)) if task == REARRANGEMENT_PROFILE.tasks[0] else ()
            self.grouped[place, task, policy] = [
                replace(e, population="")
                if e.population == "zsc" and e.partner in parts and e.partner not in zsc
                else e
                for e in episodes
            ]

    def _group(self, place: int, root: Path, episode: ReportEpisode, profile: Profile) -> None:
        # in a study the condition is compared, whoever played it
        policy = episode.condition if episode.studied else episode.policy or episode.condition or root.stem or "unnamed"
        # by the place of the path too: two datasets of one policy may be two versions of it
        key = (place, episode.metrics.task, policy)
        if self.profiles.setdefault(key, profile) is not profile:
            raise InputError(
                f"Episodes of {episode.metrics.task!r} by {policy!r} in {root} ask for two metrics profiles, "
                f"{self.profiles[key].name} and {profile.name}. Hint: report them separately.",
                code="H3-VIEW-008",
            )
        self.grouped.setdefault(key, []).append(episode)


def _with_each_partner(episode: ReportEpisode, info: Mapping[str, Any]) -> list[ReportEpisode]:
    """Return the episode once for each of its partners (``info["partners"]`` of ``--save-recordings``)."""
    if not shared_by(info):
        return [episode]
    return [
        replace(
            episode,
            partner=metrics.partner,
            population=population_beside(metrics.partner, metrics.task),
            metrics=replace(metrics, episode_id=f"{metrics.episode_id} with {metrics.partner}"),
        )
        for metrics in for_each_partner(episode.metrics, info)
    ]


def same_episodes(first: Run, second: Run) -> bool:
    """Return whether two runs have the same episodes: equal ids, scenes and seeds, and the same participant if any."""
    a, b = (
        {e.metrics.episode_id: (e.metrics.scene, e.seed, e.participant) for e in run.episodes}
        for run in (first, second)
    )
    # equal dictionaries are not enough: an id that comes twice would be lost in both
    return first.task == second.task and a == b and len(a) == len(first.episodes) == len(second.episodes)


def read_whole(episode: ReportEpisode) -> Recording:
    """Return the recording of an episode with its bodies and its scene, as needed for rendering."""
    opened = open_recording(episode.source)
    return opened if isinstance(opened, Recording) else opened.recording(episode.index)


def read_curves(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Read the numeric columns [N] of the training log in a folder, including ``step``.

    Returns:
        Columns by name; empty if the folder holds neither `CURVES_FILE` nor `RUN_CURVES_FILE`.

    Raises:
        InputError: the file is not a table of numbers, or has no column ``step``.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    log, run = ((folder / name).absolute() for name in (CURVES_FILE, RUN_CURVES_FILE))  # relative, a colon makes a URI
    if log.is_file():
        path, read, steps = log, csv.read_csv, "step"
    elif run.is_file():
        path, read, steps = run, parquet.read_table, "decisions"
    else:
        return {}
    try:
        table = read(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"Expected a table of numbers with a column {steps} ({error}): {path}", code="H3-VIEW-009"
        ) from error
    numeric = {
        name: np.asarray(table[name].to_numpy(), np.float64)
        for name in table.column_names
        if pa.types.is_integer(table[name].type) or pa.types.is_floating(table[name].type)
    }
    if steps not in numeric or len(numeric) < 2:
        raise InputError(
            f"Expected columns of numbers, one of them {steps}; got {', '.join(map(repr, table.column_names))}: {path}",
            code="H3-VIEW-006",
        )
    return {"step": numeric.pop(steps), **numeric}


# --- inside -----------------------------------------------------------------------------------------------------------
def _runs(
    grouped: Mapping[tuple[int, str, str], Sequence[ReportEpisode]],
    profiles: Mapping[tuple[int, str, str], Profile],
    roots: Sequence[Path],
) -> tuple[Run, ...]:
    """Return one run for each policy.

    Datasets of one policy are separate runs if they have the same episodes or other rules; the dataset is then part of
    the run's name.
    """
    places: dict[tuple[str, str], list[int]] = {}
    for place, task, policy in grouped:
        places.setdefault((task, policy), []).append(place)
    merged: list[tuple[str, str, str, Profile, Sequence[ReportEpisode]]] = []
    for (place, task, policy), episodes in grouped.items():
        where = places[task, policy]
        parts = [grouped[k, task, policy] for k in where]
        alike = all(profiles[k, task, policy] is profiles[place, task, policy] for k in where)
        name = policy
        if alike and _one_row(parts):
            if place != where[0]:
                continue
            episodes = [e for part in parts for e in part]
        else:
            short = [roots[k].name or str(roots[k]) for k in where]
            root = roots[place].name or str(roots[place])
            name = f"{policy} ({root if short.count(root) == 1 else roots[place]})"
        merged.append((name, task, policy, profiles[place, task, policy], episodes))
    return tuple(
        Run(
            name=name,
            policy=policy,
            task=task,
            profile=profile,
            episodes=tuple(episodes),
            table=tabulate((e.metrics for e in episodes), profile=profile.name),
        )
        for name, task, policy, profile, episodes in merged
    )


def _pooled(runs: Sequence[Run], roots: Sequence[Path], patterns: Sequence[str]) -> tuple[Run, ...]:
    """Return the runs, those of training seeds as one in the place of the first."""
    told = evaluated_seeds(roots)
    for pattern in patterns:
        told[pattern] = tuple(
            dict.fromkeys(run.policy for run in runs if fnmatchcase(run.policy.partition("@")[0], pattern))
        )
        if len(told[pattern]) < 2:
            policies = sorted({run.policy for run in runs})
            raise InputError(
                f"Expected several policies that fit {pattern!r}, got {len(told[pattern])}; there are: {', '.join(policies)}.",
                code="H3-VIEW-010",
            )
    out = list(runs)
    for pattern, policies in told.items():
        for task in dict.fromkeys(run.task for run in runs):
            members = [run for run in out if run.task == task and run.policy in policies and not run.seeds]
            names = tuple(run.policy for run in members)
            if len(members) < 2 or len(set(names)) < len(names):
                continue  # datasets of one policy that hold the same episodes stay apart, so that they can be compared
            episodes = tuple(episode for run in members for episode in run.episodes)
            # training seeds play the same episodes, and a table refuses an episode that comes twice
            unique = (replace(e.metrics, uid=f"{e.metrics.uid} {e.policy}") for e in episodes)
            first = members[0]
            out[out.index(first)] = Run(
                name=pattern,
                policy=pattern,
                task=task,
                profile=first.profile,
                episodes=episodes,
                seeds=names,
                table=tabulate(unique, profile=first.profile.name),
            )
            out = [run for run in out if run not in members]
    return tuple(out)


def _one_row(parts: Sequence[Sequence[ReportEpisode]]) -> bool:
    """Return whether datasets of a policy have the same rules, and no episode twice with one partner or participant."""
    # the same episode with another partner or participant is another sample
    keys = [{(e.metrics.episode_id, e.metrics.scene, e.seed, e.partner, e.participant) for e in part} for part in parts]
    rules = {frozenset(e.metrics.protocol_deviations for e in part) for part in parts}
    return sum(map(len, keys)) == len(set().union(*keys)) and len(rules) == 1
