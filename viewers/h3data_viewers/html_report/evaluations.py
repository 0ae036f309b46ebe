"""Results of ``h3data evaluate``, which have no recordings: a row of metrics for each policy, partner and episode.

They include the population of each partner, and the partners given as ``--unseen-partners``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import FormatError
from h3data.metrics import EpisodeMetrics, Profile
from h3data.metrics.paper.profiles import REARRANGEMENT_PROFILE
from h3data.metrics.registry import profile_for
from h3data_viewers.html_report.episode import ReportEpisode


def holds_results(root: Path) -> bool:
    """Return whether a folder was written by an evaluation without recordings."""
    return (root / "table.json").is_file() and (root / "episodes").is_dir() and not (root / "recordings").is_dir()


def evaluated_zsc(roots: Sequence[Path]) -> tuple[str, ...]:
    """Return the partners of the zero-shot population that all of these evaluations name.

    The result is empty if they name no such partners, if they disagree, or if a path is not an evaluation.
    """
    told: set[tuple[str, ...]] = set()
    for root in roots:
        try:
            job = json.loads((root / "table.json").read_text(encoding="utf-8"))["job"]
            told.add(tuple(map(str, job.get("zsc", ()))))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return ()
    # evaluations that disagree have no population in common
    return told.pop() if len(told) == 1 else ()


def evaluated_seeds(roots: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Return the policies that share a row of these evaluations' tables, by the pattern that names them."""
    found: dict[str, tuple[str, ...]] = {}
    for root in roots:
        try:
            table = json.loads((root / "table.json").read_text(encoding="utf-8"))
            # tasks with partners have a row, and so a name, for each pair of a policy and a partner
            ends = [f" with {partner}" for partner in table["job"].get("partners") or ()]
            for cell in table.get("seeds", ()):
                names = [str(seed["policy"]) for seed in cell["seeds"]]
                pattern = str(cell["policies"])
                for end in ends:
                    if pattern.endswith(end):
                        pattern, names = pattern.removesuffix(end), [name.removesuffix(end) for name in names]
                found[pattern] = tuple(dict.fromkeys([*found.get(pattern, ()), *names]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    return found


def population_beside(partner: str, task: str) -> str:
    """Return the population to which an evaluation's partner belongs: ``train``, ``zsc`` or empty.

    The value becomes `ReportEpisode.population`.
    """
    from sim_kinematic.policies.rearrange import population_of

    return population_of(partner).removesuffix("-pop") if task == REARRANGEMENT_PROFILE.tasks[0] else ""


def zero_shot_population(partners: Sequence[str]) -> tuple[str, ...]:
    """Return the paper's largest zero-shot population whose members are all among ``partners``; else nothing."""
    from sim_kinematic.policies.rearrange import zsc_populations

    return (zsc_populations(partners) or ((),))[-1]


def result_episodes(root: Path) -> Iterator[tuple[ReportEpisode, Profile]]:
    """Yield every result of an evaluation, with the profile of its metrics.

    Raises:
        FormatError: a file is not a result of ``h3data evaluate``.
    """
    try:
        task = str(json.loads((root / "table.json").read_text(encoding="utf-8"))["job"]["task"])
    except (ValueError, KeyError, TypeError):
        raise FormatError(f"Expected the table of h3data evaluate: {root / 'table.json'}", code="H3-VIEW-011") from None
    for file in sorted((root / "episodes").glob("[0-9]*.json")):
        try:
            result = json.loads(file.read_text(encoding="utf-8"))
            for row in result["rows"]:
                yield _episode(file, row, result["job"]["episode"], task)
        except (ValueError, KeyError, TypeError) as fault:
            raise FormatError(f"Expected a result of h3data evaluate ({fault!r}): {file}", code="H3-VIEW-012") from None


def _episode(file: Path, row: Mapping[str, Any], asked: Mapping[str, Any], task: str) -> tuple[ReportEpisode, Profile]:
    profile = profile_for(task, {})
    partner = str(row.get("partner", ""))
    # the partner too: each plays the same episodes
    name = f"{row['index']:06d}" + (f" with {partner}" if partner else "")
    metrics = EpisodeMetrics(
        episode_id=name,
        uid=f"{file}: {row['policy']} {name}",
        profile=profile.name,
        metrics=profile.metrics,
        values={m.name: np.nan if (v := row["values"].get(m.name)) is None else float(v) for m in profile.metrics},
        notes={},
        rows=0,
        task=profile.tasks[0] if profile.tasks else task,
        scene=str(asked.get("scene") or ""),
        protocol_deviations=str(row.get("set_up", "")),
    )
    episode = ReportEpisode(
        source=file,
        index=int(row["index"]),
        metrics=metrics,
        seed=int(asked.get("seed", 0)),
        policy=str(row["policy"]),
        partner=partner,
        population=population_beside(partner, task),
        participant="",
        condition="",
        distance_m=np.zeros(0, np.float32),
        tracks=(),
        recorded=False,
    )
    return episode, profile
