"""Rules by which the report leaves out participants and episodes.

The rules are in the study file before the first participant arrives, and refer to measures of participants and
episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from h3data_studies.design import Design, Exclude
from h3data_studies.flow import CHECK
from h3data_studies.overview import PlayedEpisode, played
from h3data_studies.store import Participant

FOCUS = "focus"
"""Name of the log rows that record when participants turned to another window."""
PARTICIPANT_MEASURES = {
    "failed_checks": "checks that were not passed in the last attempt",
    "check_retries": "answers to checks that had to be given again",
    "practice_attempts": "attempts at the practice",
    "minutes": "minutes from consent to the end",
    "away_s": "seconds in another window",
    "away_count": "how often they turned to another window",
    "unsuccessful": "share of episodes that did not end with success",
    "late": "share of steps that came late",
}
TRIAL_MEASURES = {
    "seconds": "simulated seconds",
    "away_s": "seconds in another window",
    "away_count": "how often they turned to another window",
    "late": "share of steps that came late",
}
STEP_S = 1 / 30


def participant_measures(person: Participant) -> dict[str, float]:
    """Return all `PARTICIPANT_MEASURES` of a participant."""
    rows, episodes = person.progress.rows, played(person)
    steps = sum(e.steps + e.slipped for e in episodes)
    return {
        "failed_checks": sum(len(row.get("wrong", ())) for key, row in rows.items() if key.startswith("form/")),
        "check_retries": sum(key.startswith(f"{CHECK}/") for key in rows),
        "practice_attempts": person.progress.attempts,
        "minutes": person.used / 60,
        "away_s": _away_s(person),
        "away_count": _away_count(person),
        "unsuccessful": sum(e.ended != "success" for e in episodes) / max(len(episodes), 1),
        "late": sum(e.slipped for e in episodes) / max(steps, 1),
    }


def trial_measures(person: Participant, episode: PlayedEpisode) -> dict[str, float]:
    """Return all `TRIAL_MEASURES` of an episode."""
    return {
        "seconds": episode.steps * STEP_S,
        "away_s": _away_s(person, episode.row),
        "away_count": _away_count(person, episode.row),
        "late": episode.late,
    }


@dataclass(frozen=True)
class Exclusions:
    """Participants and episodes that the rules of a study exclude."""

    people: dict[str, str]
    """Reasons for the exclusion of participants, by participant."""
    trials: dict[tuple[str, str], str]
    """Reasons for the exclusion of episodes, by participant and row of the episode (`PlayedEpisode.row`)."""
    counts: dict[str, int]
    """Number of excluded participants, or of excluded episodes of the remaining participants, by rule. Several rules
    can exclude the same one."""


def exclusions(design: Design, people: Sequence[Participant]) -> Exclusions:
    """Return the participants and episodes that the rules of a study exclude."""
    counts = {rule.name: 0 for rule in design.exclude}

    def reasons(of: str, measured: dict[str, float]) -> str:
        found = [rule for rule in design.exclude if rule.of == of and _holds(rule, measured[rule.what])]
        for rule in found:
            counts[rule.name] += 1
        return "; ".join(f"rule {rule.name} ({rule.what} is {measured[rule.what]:g})" for rule in found)

    out = {person.id: why for person in people if (why := reasons("participant", participant_measures(person)))}
    trials = {
        (person.id, episode.row): why
        for person in people
        if person.id not in out
        for episode in played(person)
        if (why := reasons("trial", trial_measures(person, episode)))
    }
    return Exclusions(out, trials, counts)


def rule_text(rule: Exclude) -> str:
    """Return an exclusion rule in words."""
    of = "Participants" if rule.of == "participant" else "Episodes"
    measures = PARTICIPANT_MEASURES if rule.of == "participant" else TRIAL_MEASURES
    bounds = [
        f"{side} {bound:g}" for side, bound in (("above", rule.above), ("below", rule.below)) if bound is not None
    ]
    return f"{of} whose {rule.what} ({measures[rule.what]}) is {' or '.join(bounds)}"


def focus_rows(people: Sequence[Participant]) -> list[list[str | float]]:
    """Return a header and the log of when participants turned to another window and came back, with Unix times [s]."""
    rows: list[list[str | float]] = [["participant", "time", "stage", "away", "why", "seconds"]]
    for person in people:
        rows += [
            [
                person.id,
                round(person.times.get(key, 0.0), 3),
                row["stage"],
                int(row["away"]),
                row["why"],
                row["seconds"],
            ]
            for key, row in person.progress.rows.items()
            if key.startswith(f"{FOCUS}/")
        ]
    return rows


def _holds(rule: Exclude, value: float) -> bool:
    return (rule.above is not None and value > rule.above) or (rule.below is not None and value < rule.below)


def _away_s(person: Participant, stage: str = "") -> float:
    return sum(row["seconds"] for row in _focus(person, stage))


def _away_count(person: Participant, stage: str = "") -> int:
    return sum(bool(row["away"]) for row in _focus(person, stage))


def _focus(person: Participant, stage: str) -> list[dict[str, float]]:
    rows = [row for key, row in person.progress.rows.items() if key.startswith(f"{FOCUS}/")]
    return [row for row in rows if not stage or row["stage"] == stage]
