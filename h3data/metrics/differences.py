"""Differences of the metrics of two runs over the same episodes, in total and per episode."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, did_you_mean
from h3data.metrics.metric import Metric
from h3data.metrics.table import MetricsTable, legend
from h3data.stats import PAdjustment, PairedComparison, adjust_p_values, compare_paired
from h3data.stats.paired_tests import some_of
from h3data.terminal import aligned


@dataclass(frozen=True, kw_only=True, eq=False)
class Differences:
    """Difference ``first - second`` of each metric, episode by episode."""

    profile: str
    metrics: tuple[Metric, ...]
    """Definitions of the metrics."""
    names: tuple[str, str]
    """Labels of the two runs."""
    episode_ids: tuple[str, ...]
    """Names of the pairs (`pairing_names`)."""
    first: dict[str, NDArray[np.float64]]
    """Values of the first run by metric, in the order of ``episode_ids``; NaN = undefined."""
    second: dict[str, NDArray[np.float64]]
    tests: dict[str, PairedComparison]
    """Means, interval, test and effect size by metric."""

    def changed(self, metric: str) -> list[tuple[str, float, float]]:
        """Return ``(episode_id, first, second)`` of episodes whose value differs, largest first, undefined ones last."""
        a, b = self.first[metric], self.second[metric]
        # NaN equals nothing, but undefined in both runs is no change
        rows = np.flatnonzero(~((a == b) | (np.isnan(a) & np.isnan(b))))
        # an episode that only one run defines has no difference: it comes last
        size = np.nan_to_num(np.abs(a[rows] - b[rows]), nan=-1.0)
        # stable: equal differences stay in the order of the episodes
        order = rows[np.argsort(-size, kind="stable")]
        return [(self.episode_ids[k], float(a[k]), float(b[k])) for k in order]

    def to_text(self) -> str:
        """Return a table of the metrics, followed by the episodes that changed most."""
        lines = [["metric", *self.names, "difference", "95% interval", "p", "changed"]]
        for name, test in self.tests.items():
            interval = "" if np.isnan(test.low) else f"[{test.low:+.3f}, {test.high:+.3f}]"
            means = [_number(test.first_mean), _number(test.second_mean), _number(test.difference, "+.3f")]
            changed = f"{len(self.changed(name))} of {len(self.episode_ids)}"
            lines.append([name, *means, interval, _number(test.p_adjusted, ".3g"), changed])
        spelled_out = legend(metric for metric in self.metrics if metric.name in self.tests)
        return "\n".join([aligned(lines), spelled_out, *self.notes, *self._change_lines()])

    @property
    def notes(self) -> list[str]:
        """Caveats about the tests; one that applies to several metrics is listed once."""
        by_note: dict[str, list[str]] = {}
        for name, test in self.tests.items():
            for note in test.notes:
                by_note.setdefault(note, []).append(name)
        return [f"{', '.join(names)}: {note}" for note, names in by_note.items()]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON types; undefined numbers are None."""
        return {
            "profile": self.profile,
            "runs": list(self.names),
            "episodes": len(self.episode_ids),
            "metrics": {
                name: {k: _plain(v) for k, v in asdict(test).items()}
                | {"changed": [[e, _plain(a), _plain(b)] for e, a, b in self.changed(name)]}
                for name, test in self.tests.items()
            },
        }

    def to_json(self, *, indent: int | None = 2) -> str:
        """Return `to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=indent, allow_nan=False)

    def _change_lines(self) -> list[str]:
        lines = []
        # changed episodes that the text names per metric
        most = 3
        for name in self.tests:
            changed = self.changed(name)
            if changed:
                each = [f"{e} {_number(a)} / {_number(b)}" for e, a, b in changed[:most]]
                lines.append(f"  {name}: {', '.join(each)}{', ...' if len(changed) > most else ''}")
        if not lines:
            return ["No episode differs."]
        return [f"Episodes that differ ({self.names[0]} / {self.names[1]})", *lines]


def compare_tables(first: MetricsTable, second: MetricsTable, *, names: tuple[str, str] = ("A", "B")) -> Differences:
    """Pair the episodes of two runs by `pairing_names`; p values are adjusted for all metrics together (Holm).

    Raises:
        InputError: the runs hold different episodes or profiles, or two episodes have the same name; the message names
            them.
    """
    if (first.profile, first.metrics) != (second.profile, second.metrics):
        raise InputError(
            f"Runs with different metrics cannot be paired: {first!r} and {second!r}.", code="H3-METRIC-004"
        )
    ours, theirs = pairing_names(first, second)
    for name, ids in zip(names, (ours, theirs), strict=True):
        if repeated := _repeated(ids):
            raise InputError(
                f"Episode ids of {name} are not unique, so they cannot be paired: {some_of([*map(repr, repeated)])}.",
                code="H3-METRIC-008",
            )
    missing = [i for i in ours if i not in set(theirs)]
    extra = [i for i in theirs if i not in set(ours)]
    if missing or extra:
        parts = [
            f"only {name} has {len(ids)}: {some_of([*map(repr, ids)])}"
            for name, ids in zip(names, (missing, extra), strict=True)
            if ids
        ]
        raise InputError(
            f"The runs hold different episodes; {'; '.join(parts)}. Pair runs over the same set.", code="H3-METRIC-005"
        )
    place = {episode: k for k, episode in enumerate(theirs)}
    # the second run may hold the same episodes in another order
    order = np.array([place[episode] for episode in ours], np.int64)
    return Differences(
        profile=first.profile,
        metrics=first.metrics,
        names=names,
        episode_ids=ours,
        first=dict(first.columns),
        second={name: column[order] for name, column in second.columns.items()},
        tests=compare_runs(first, second),
    )


def compare_runs(
    first: MetricsTable,
    second: MetricsTable,
    *,
    metrics: Sequence[str] | None = None,
    adjust: PAdjustment = "holm",
    confidence: float = 0.95,
    seed: int = 0,
) -> dict[str, PairedComparison]:
    """Compare every metric (or ``metrics``) of two tables over the same episodes; p values are adjusted together."""
    if first.profile != second.profile:
        raise InputError(
            f"Two profiles cannot be compared: {first.profile!r} and {second.profile!r}.", code="H3-METRIC-006"
        )
    names = list(metrics) if metrics is not None else list(first.columns)
    unknown = [n for n in names if n not in first.columns]
    if unknown:
        near = did_you_mean(unknown[0], first.columns)
        raise InputError(
            f"No metric {', '.join(map(repr, unknown))}.{near} There are: {', '.join(first.columns)}.",
            code="H3-METRIC-007",
        )
    ours, theirs = pairing_names(first, second)
    for ids, which in ((ours, "first"), (theirs, "second")):
        if repeated := _repeated(ids):
            raise InputError(
                f"Expected each episode once; the {which} run repeats {some_of(sorted(repeated))}.",
                code="H3-METRIC-009",
            )
    results = {
        name: compare_paired(
            dict(zip(ours, map(float, first.columns[name]), strict=True)),
            dict(zip(theirs, map(float, second.columns[name]), strict=True)),
            confidence=confidence,
            seed=seed,
        )
        for name in names
    }
    # together: of ten independent metrics of equal runs, one has a p below .07 in every second comparison
    adjusted = adjust_p_values([r.p for r in results.values()], method=adjust)
    return {name: replace(r, p_adjusted=float(p)) for (name, r), p in zip(results.items(), adjusted, strict=True)}


def pairing_names(first: MetricsTable, second: MetricsTable) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names that identify the same episode in two runs, one name per row of each table.

    They are the episodes' ids. Where ids repeat, as in evaluations of a robot with several partners, the partner is
    added (``3 with both``); where these repeat too, the policy as well (``3 complement with both``).
    """
    names = first.episode_ids, second.episode_ids
    if any(map(_repeated, names)):
        # the shortest names that are unique in both runs: they are what tables and messages show
        names = _with_partners(first), _with_partners(second)
    if any(map(_repeated, names)):
        names = _with_partners(first, policies=True), _with_partners(second, policies=True)
    return names


def _with_partners(table: MetricsTable, *, policies: bool = False) -> tuple[str, ...]:
    return tuple(
        f"{e.episode_id}{f' {e.policy}' if policies and e.policy else ''}{f' with {e.partner}' if e.partner else ''}"
        for e in table.episodes
    )


def _repeated(names: Sequence[str]) -> list[str]:
    return [name for name, times in Counter(names).items() if times > 1]


def _number(value: float, spec: str = ".3f") -> str:
    return "undefined" if np.isnan(value) else f"{value:{spec}}"


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
